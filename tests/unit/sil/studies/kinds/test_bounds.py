"""Studies of bounds and latency budgets, their pictures, and the results that are shipped."""

from __future__ import annotations

import csv
import itertools
import json
from pathlib import Path

import numpy as np
import pytest

from can_dbc.errors import InputError
from sil.cli import main
from sil.studies import executor
from sil.studies.kinds.bounds import SHIPPED, TUNED, delay_of, envelope, worst_over
from sil.studies.kinds.budget import BARS, closed, simulated
from sil.studies.load_study import load_study
from sil.studies.policies import FAMILIES

BUDGET = """
name = "two"
kind = "budget"
scenario = "lab_n_b"
[[variant]]
name = "today"
[[variant]]
name = "no filter"
set = { "controller.filter.enabled" = false }
"""

BOUNDS = """
name = "few"
kind = "bounds"
[bounds]
generations = 1
[[sweep]]
path = "bound.delay_s"
values = [0.048, 0.06]
[[load]]
name = "laboratory"
set = { "bound.family" = "laboratory" }
"""


def rows_of(path: Path) -> list[dict[str, str]]:
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def test_a_study_of_budgets(tmp_path: Path) -> None:
    (tmp_path / "two.toml").write_text(BUDGET)
    assert main(["whatif", str(tmp_path / "two.toml"), "--out", str(tmp_path / "out")]) == 0
    today, plain = rows_of(tmp_path / "out" / "results.csv")
    for row in (today, plain):
        spent_s = sum(float(row[simulated(bar)]) for bar in BARS)
        assert spent_s == pytest.approx(float(row["spent_s"]))
        assert float(row["slack_s"]) == pytest.approx(float(row["window_s"]) - spent_s)
        for bar in BARS:
            measured, exact = float(row[simulated(bar)]), float(row[closed(bar)])
            assert measured == pytest.approx(exact, rel=0.03, abs=3e-4)
    assert float(plain[simulated("filter")]) == 0.0 < float(today[simulated("filter")])
    assert (tmp_path / "out" / "budget.png").read_bytes()[:4] == b"\x89PNG"


def test_a_study_of_bounds_and_the_same_bytes_by_two_workers(tmp_path: Path) -> None:
    (tmp_path / "few.toml").write_text(BOUNDS)
    for workers in ("1", "2"):
        command = ["whatif", str(tmp_path / "few.toml"), "--workers", workers, "--json"]
        assert main([*command, "--out", str(tmp_path / workers)]) == 0
    whole = (tmp_path / "1" / "results.csv").read_bytes()
    assert (tmp_path / "2" / "results.csv").read_bytes() == whole
    early, late = rows_of(tmp_path / "1" / "results.csv")
    for row in (early, late):
        assert float(row["clairvoyant_m_s"]) <= float(row["bound_m_s"])
        searches = [float(row["search_1_m_s"]), float(row["search_2_m_s"])]
        assert float(row["bound_m_s"]) == min(searches)
        assert float(row["spread_m_s"]) == max(searches) - min(searches)
        impacts = [float(row["impact_stay_m_s"]), float(row["impact_worst_m_s"])]
        assert float(row["bound_m_s"]) == max(impacts) and float(row["lost_s"]) <= 0.03
    assert (tmp_path / "1" / "bounds.png").read_bytes()[:4] == b"\x89PNG"
    assert json.loads((tmp_path / "1" / "summary.json").read_text())["rows"] == 2


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (BOUNDS.replace('"laboratory" }', '"gear box" }'), "laboratory"),
        (BOUNDS.replace("bound.delay_s", "bound.delay"), "delay_s"),
        (BOUNDS.replace("[0.048, 0.06]", "[true]"), "number of seconds"),
        (BOUNDS.replace("bound.delay_s", "bound.valves"), "all, firmware"),
        (BOUNDS.replace('kind = "bounds"', 'kind = "bound"'), "kind"),
        (BOUNDS.replace('kind = "bounds"', 'kind = "bounds"\nscenario = "lab_n_b"'), "no scenario"),
        (BUDGET.replace('scenario = "lab_n_b"', ""), "scenario ="),
        (BUDGET.replace('"budget"', '"tuning"'), "needs"),
        (BUDGET.replace("lab_n_b", "lab_n_c"), "lab_n_b"),
    ],
)
def test_wrong_studies_are_refused_in_one_line(text: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "wrong.toml"
    path.write_text(text)
    with pytest.raises(InputError, match=message) as refused:
        study = load_study(str(path))
        executor.run_chunk(study, (0, 1))
    assert "\n" not in str(refused.value)


VALVES = {"today": "opens 8, closes 35 ms", "no filter": "opens 8, closes 35 ms"}


@pytest.mark.parametrize("family", FAMILIES)
def test_no_tuned_strategy_is_below_the_bound_at_its_delay(family: str) -> None:
    """Rows with the same valves, at the latest tabulated delay that is no later than theirs."""
    table = [row for row in rows_of(SHIPPED) if row["load"] == family]
    compared = 0
    for row in rows_of(TUNED):
        worst_m_s = worst_over(row, family)
        if worst_m_s is None or row["strategy"] == "oil damper":
            continue
        delay_now_s = delay_of(row, family)
        valves = VALVES.get(row["variant"], "opens 8, closes 5 ms")
        points = [line for line in table if line["variant"] == valves]
        delay_s = np.array([float(line["bound.delay_s"]) for line in points])
        bound_m_s = envelope(delay_s, np.array([float(line["bound_m_s"]) for line in points]))
        before = delay_s <= delay_now_s
        assert worst_m_s >= np.max(bound_m_s[before]), row
        compared += 1
    assert compared >= 20


def test_what_the_shipped_results_say() -> None:
    bounds = {
        (row["variant"], row["load"], float(row["bound.delay_s"])): row for row in rows_of(SHIPPED)
    }
    late = bounds["opens 8, closes 35 ms", "gearbox", 0.048]
    assert float(late["bound_m_s"]) - float(late["clairvoyant_m_s"]) > 0.85
    for valves, delay_s in itertools.product(
        ("opens 8, closes 35 ms", "opens 8, closes 5 ms", "opens 2, closes 2 ms"), (0.0, 0.048)
    ):
        row = bounds[valves, "gearbox", delay_s]
        assert float(row["bound_m_s"]) > float(row["damper_m_s"])
    tuned = {(row["variant"], row["strategy"]): row for row in rows_of(TUNED)}
    plain, mpc = tuned["today", "open loop"], tuned["today", "predictive"]
    bench, truck = "impact_m_s laboratory, 9 bar", "impact_m_s gearbox, 250 N s"
    assert float(mpc[bench]) < 0.5 * float(plain[bench])
    assert float(mpc[truck]) > float(plain[truck])
    for row in rows_of(TUNED):  # what waits for the motion gains no more than the bound allows
        waits = row["strategy"] not in ("oil damper", "synchro brake")
        assert not waits or float(row[truck]) >= float(late["bound_m_s"])
    known = tuned["today", "synchro brake"]
    assert worst_over(known, "gearbox") < float(late["bound_m_s"])  # and what is known ahead, more


@pytest.mark.slow
def test_shipped_rows_come_out_again() -> None:
    """One tuned row and one of the bounds, as the studies make them now."""
    for path, name, number in ((TUNED, "tuning", 15), (SHIPPED, "bounds", 39)):
        study = load_study(name)
        text = executor.header(study) + "".join(executor.run_chunk(study, (number, number + 1)))
        (found,) = csv.DictReader(text.splitlines())
        shipped = rows_of(path)[number]
        assert list(found) == list(shipped)
        for column, value in shipped.items():
            try:
                expected = float(value)
            except ValueError:
                assert found[column] == value
            else:
                if column != "simulations":
                    assert float(found[column]) == pytest.approx(expected, rel=0.02, abs=2e-4)

"""The study `bounds`: stored policies are as soft as they say, a search is stored and continues."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from msgspec import convert
from msgspec.structs import replace

from can_dbc.errors import InputError
from plant.parameters import load
from plant.systems.stroke import simulate
from sil.campaign.campaign import load_campaign
from sil.cli import main
from sil.studies.bounds.judge import NOMINAL, PLAIN, Judge
from sil.studies.bounds.policy import UNIT_S, SwitchingDelays
from sil.studies.bounds.search import SearchProgress
from sil.studies.kinds.bounds import RowKeys, read_progress, write_progress
from sil.studies.load_study import load_study, shipped
from sil.studies.table import read_table

REACHED_M_S = {
    (0.008, 0.035, 0.048): 1.095,
    (0.008, 0.035, 0.01): 1.095,
    (0.008, 0.035, 0.0): 1.095,
    (0.008, 0.005, 0.005): 1.04,
    (0.002, 0.002, 0.005): 0.96,
    (0.002, 0.002, 0.0): 0.855,
}
STORED = shipped()["bounds"].parent / "bounds"
ROW = """
name = "one"
kind = "bounds"
attempts = {attempts}
evaluations = 100
known_evaluations = 100
[[variant]]
name = "8/35 ms; 48 ms"
set = {{ opening_s = 0.008, closing_s = 0.035, delay_s = 0.048 }}
[[load]]
name = "1,300 N"
set = {{ mesh_n = [1300.0] }}
"""


def study_of_one_row(folder: Path, attempts: int) -> Path:
    path = folder / "one.toml"
    path.write_text(ROW.format(attempts=attempts))
    return path


@pytest.mark.parametrize("timing", REACHED_M_S)
def test_stored_policies_are_as_soft_as_has_been_reached(
    timing: tuple[float, float, float],
) -> None:
    names = ("opening_s", "closing_s", "delay_s")
    wanted = RowKeys(**dict(zip(names, timing, strict=True)), mesh_n=[1300.0])
    rows = [convert(each.settings, RowKeys) for each in load_study("bounds").rows()]
    stored = [read_progress(STORED / row.folder) for row in rows if wanted.can_imitate(row)]
    least_m_s = min(each.worst_m_s for progress in stored for each in progress.values())
    assert wanted in rows and least_m_s <= REACHED_M_S[timing]


def test_stored_policies_are_judged_again(tmp_path: Path) -> None:
    path, name = study_of_one_row(tmp_path, 5), "open_8_close_35_delay_48_mesh_1300"
    shutil.copytree(STORED / name, tmp_path / "bounds" / name)
    out = tmp_path / "out"
    assert main(["whatif", str(path), "--rejudge", "--out", str(out)]) == 0
    numbers = read_table(load_study(str(path)), out).numbers
    best = min(each.worst_m_s for each in read_progress(STORED / name).values())
    assert numbers["worst_m_s"][0] == pytest.approx(best, abs=1e-4)
    assert numbers["fine_m_s"][0] == pytest.approx(best, abs=0.01)
    assert numbers["open_m_s"][0] == pytest.approx(1.365, abs=1e-3)
    assert numbers["damper_m_s"][0] == pytest.approx(0.602, abs=1e-3)
    assert "8/35 ms; 48 ms" in (out / "bounds.md").read_text()
    stored = (out / "policies" / name / "campaign.toml").read_text()
    assert stored == (STORED / name / "campaign.toml").read_text()


def test_what_a_row_can_imitate() -> None:
    today, quick = (
        RowKeys(opening_s=a, closing_s=b, delay_s=0.01, mesh_n=[1300.0])
        for a, b in ((0.008, 0.035), (0.002, 0.002))
    )
    later = replace(quick, delay_s=0.017)
    assert quick.can_imitate(today) and not today.can_imitate(quick)
    assert quick.can_imitate(later) and not later.can_imitate(quick)
    assert replace(quick, delay_s=0.016).can_imitate(today) and not later.can_imitate(today)
    assert quick.can_imitate(replace(today, mesh_n=[500.0, 1300.0]))
    assert not quick.can_imitate(replace(today, b_with_f=True))


def test_slower_valves_are_imitated_stop_for_stop() -> None:
    """Quicker valves that move as slower ones, sooner, stop under each load as those do."""
    stop_m_s = []
    for opening_s, closing_s, begin_s in ((0.008, 0.035, 0.12), (0.002, 0.002, 0.12)):
        values = PLAIN.copy()
        values[0, [6, 10]] = begin_s / UNIT_S, (0.04 - closing_s) / UNIT_S
        judge = Judge(
            load("nominal"),
            SwitchingDelays(opening_s, closing_s),
            np.linspace(18.0, 250.0, 9),
            (1300.0,),
            NOMINAL,
        )
        stop_m_s.append(judge.judge(values, (), 1.0).impact_m_s)
    np.testing.assert_allclose(*stop_m_s, atol=1e-4)


@pytest.mark.slow
def test_a_search_is_stored_and_continues(tmp_path: Path) -> None:
    out, name = tmp_path / "out", "open_8_close_35_delay_48_mesh_1300"
    assert main(["whatif", str(study_of_one_row(tmp_path, 1)), "--out", str(out)]) in (0, 1)
    first = read_progress(out / "policies" / name)
    assert [len(each.history) for each in first.values()] == [1, 1]
    shutil.copytree(out / "policies", tmp_path / "bounds")
    path = study_of_one_row(tmp_path, 2)
    assert main(["whatif", str(path), "--out", str(out), "--force"]) in (0, 1)
    second = read_progress(out / "policies" / name)
    for before, after in zip(first.values(), second.values(), strict=True):
        assert after.history[:1] == before.history and len(after.history) == 2
        assert after.worst_m_s <= before.worst_m_s


def test_other_studies_have_nothing_to_judge_again(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["whatif", "faults", "--rejudge"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "does not search" in line


def test_a_policy_is_read_as_it_was_written(tmp_path: Path) -> None:
    policy = read_progress(next(STORED.iterdir()))
    assert policy["cma"].values
    write_progress(tmp_path, policy)
    assert read_progress(tmp_path) == policy
    assert read_progress(tmp_path / "nothing") == {
        "cma": SearchProgress(),
        "linear": SearchProgress(),
    }


@pytest.mark.parametrize(
    "text",
    [
        "[cma]\nvalues = [1.0]\n",
        "[cma]\nvalues = ['x']\n",
        "[other]\nknots_s = []\n",
        "[cma]\nhistory = [[1.0, 2.0, 3.0]]\n",
    ],
)
def test_a_wrong_policy_is_one_line(text: str, tmp_path: Path) -> None:
    (tmp_path / "policy.toml").write_text(text)
    with pytest.raises(InputError, match=r"policy\.toml: .*expected") as raised:
        read_progress(tmp_path)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("folder", sorted(STORED.iterdir()), ids=lambda path: path.name)
def test_the_plant_stops_as_the_label_says(folder: Path) -> None:
    campaign, parameters = load_campaign(folder), load(folder / "model.toml")
    stops_m_s = [float(stroke.label.split(": ")[1].split()[0]) for stroke in campaign.strokes]
    hardest = int(np.argmax(stops_m_s))
    stroke = simulate(parameters, campaign.strokes[hardest].conditions, np.array([0.0, 0.4]))
    assert stroke.impact is not None
    assert stroke.impact.speed_m_s == pytest.approx(stops_m_s[hardest], abs=1e-3)
    best = min(each.worst_m_s for each in read_progress(folder).values())
    assert max(stops_m_s) == pytest.approx(best, abs=1e-3)

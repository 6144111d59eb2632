"""The tuning procedure: same budget for all, reproducible, its best no worse than the defaults."""

from __future__ import annotations

import csv
from pathlib import Path

import pytest

from controller import strategies
from sil.cli import main
from sil.files.overrides import Settings
from sil.simulation.in_memory import run_in_memory
from sil.simulation.load_scenario import Loaded, load
from sil.studies.kinds import tuning
from sil.studies.kinds.tuning import LoadShift, TuningTable


def lab(settings: Settings) -> Loaded:
    return load("lab_n_b", settings=settings)


QUICK: Settings = {
    "sensor.period_s": 0.0025,
    "controller.period_s": 0.0025,
    "controller.filter": False,
    "valve.D_fall": 0.005,
}


def test_cost_is_the_impact_plus_the_time_lost_beyond_what_is_free() -> None:
    reference = LoadShift(0.9, 0.05)
    assert tuning.cost_m_s(LoadShift(0.3, 0.08), reference, 0.034, 10.0) == 0.3
    assert tuning.cost_m_s(LoadShift(0.3, 0.104), reference, 0.034, 10.0) == pytest.approx(0.5)
    assert tuning.cost_m_s(LoadShift(), reference, 0.034, 10.0) == 10.0


@pytest.mark.parametrize("strategy", list(tuning.SPACES))
def test_every_candidate_is_a_setting_that_the_strategy_takes(strategy: str) -> None:
    spread = tuning.spread_values(strategy, 9, 3)
    assert len(spread) == (9 if tuning.SPACES[strategy] else 1)
    assert spread[0] == {}
    assert spread == tuning.spread_values(strategy, 9, 3)
    assert not spread[1:] or spread[1:] != tuning.spread_values(strategy, 9, 4)[1:]
    for parameters in spread:
        record = strategies.parameters(strategy, parameters)
        for name, value in parameters.items():
            low, high = tuning.SPACES[strategy][name]
            assert low <= value <= high
            assert getattr(record, name) == value


def test_the_best_is_no_worse_than_the_defaults_and_runs_again_the_same() -> None:
    reference = [tuning.run_case(lab, "open_loop", {}, QUICK)]
    table = TuningTable(candidates=5, seed=1)
    candidates = tuning.tune(lab, "air_cushion", [QUICK], reference, table)
    assert len(candidates) == 5
    assert [c.cost_m_s for c in candidates] == sorted(c.cost_m_s for c in candidates)
    assert candidates[0].cost_m_s <= next(c for c in candidates if not c.parameters).cost_m_s
    again = tuning.run_case(lab, "air_cushion", candidates[0].parameters, QUICK)
    assert again == candidates[0].arrivals[0]


@pytest.mark.parametrize(
    ("settings", "age_s"),
    [
        ({}, 0.00455),
        ({"sensor.delay_s": 0.01}, 0.01455),
        ({"sensor.period_s": 0.0025, "controller.period_s": 0.0025}, 0.00205),
    ],
)
def test_strategies_with_a_model_know_their_hardware(settings: Settings, age_s: float) -> None:
    hardware = lab({**settings, "valve.D_fall": 0.0123})
    values = list(tuning.hardware_settings("predictive", hardware).values())
    assert values == [0.008, 0.0123, pytest.approx(age_s, abs=1e-9)]
    assert tuning.hardware_settings("air_cushion", lab(settings)) == {}


TUNING = """
name = "small"
kind = "tuning"
scenario = "lab_n_b"
[tuning]
candidates = 3
[[variant]]
name = "quick"
set = { "sensor.period_s" = 0.0025, "controller.period_s" = 0.0025, "controller.filter.enabled" = false, "valve.D_fall" = 0.005 }
[[strategy]]
name = "open loop"
set = { "controller.strategy" = "open_loop" }
[[strategy]]
name = "air cushion"
set = { "controller.strategy" = "air_cushion" }
[[load]]
name = "lab, 9 bar"
[[load]]
name = "lab, 6 bar"
set = { "plant.supply_pressure_pa" = 600000.0 }
"""


def test_a_study_of_tunings_tells_parameters_that_run_again(tmp_path: Path) -> None:
    (tmp_path / "small.toml").write_text(TUNING)
    out = tmp_path / "out"
    assert main(["whatif", str(tmp_path / "small.toml"), "--out", str(out)]) == 0
    with open(out / "results.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["strategy"] for row in rows] == ["open loop", "air cushion"]
    assert rows[0]["best.burst_s"] == ""
    assert float(rows[1]["cost_m_s"]) <= float(rows[1]["default_cost_m_s"])
    assert float(rows[1]["cost_m_s"]) < float(rows[0]["cost_m_s"])
    names = [name for name in rows[1] if name.startswith("best.") and rows[1][name]]
    settings: Settings = {
        **QUICK,
        "controller.strategy": "air_cushion",
        "plant.supply_pressure_pa": 600000.0,
        **{f"controller.strategy_parameters.{n[5:]}": float(rows[1][n]) for n in names},
    }
    shift = run_in_memory(lab(settings)).shifts[-1]
    assert shift.impact_speed_m_s == float(rows[1]["impact_m_s lab, 6 bar"])

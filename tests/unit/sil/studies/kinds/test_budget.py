"""The latency budget of simulated runs against the thesis's sum."""

from __future__ import annotations

import pytest

from sil.files.overrides import Settings
from sil.simulation.load_scenario import load
from sil.studies.kinds.budget import BARS, NoBudgetError, budget_of, column_of


def latency_budget(scenario: str, settings: Settings | None = None) -> dict[str, float]:
    return budget_of(lambda each: load(scenario, settings=each), settings or {})


@pytest.fixture(scope="module")
def today() -> dict[str, float]:
    return latency_budget("lab_n_b")


def test_today_the_stay_is_at_its_stop_long_before(today: dict[str, float]) -> None:
    assert 0.018 < today["window_s"] < 0.023
    assert today["slack_s"] < -0.05
    assert max(BARS, key=lambda bar: today[column_of(bar)]) == "filter"
    assert today["spent_s"] - today[column_of("pressure build-up")] > 0.048


def test_a_shift_that_never_arrives_has_no_budget() -> None:
    with pytest.raises(NoBudgetError, match="never arrives"):
        latency_budget("lab_n_b", {"plant.supply_pressure_pa": 102000.0, "duration_s": 0.4})


def test_in_the_truck_the_part_after_the_block_is_shorter_than_any_reaction() -> None:
    heavy = latency_budget("truck_into_gear_2200n")
    assert heavy["window_s"] > 0.15
    assert heavy["slack_s"] > 0.0 > heavy["last_slack_s"]
    assert 0.005 < heavy["last_part_s"] < 0.040


def test_without_a_block_the_last_part_is_the_whole(today: dict[str, float]) -> None:
    assert today["last_part_s"] == today["window_s"]

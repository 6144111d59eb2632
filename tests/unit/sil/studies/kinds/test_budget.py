"""The latency budget: closed forms, their agreement with simulated runs, and the thesis's sum."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import signal

from controller.settings import FilterConfig
from plant.parameters import load as load_parameters
from sil.files.overrides import Settings
from sil.simulation.load_scenario import load
from sil.studies.kinds import budget as budgets
from sil.studies.kinds.budget import BARS, NoBudgetError, budget_of, simulated


@pytest.mark.parametrize(("order", "fc_hz"), [(1, 22.0), (2, 22.0), (6, 22.0), (8, 5.0)])
def test_group_delay_is_the_slope_of_the_phase(order: int, fc_hz: float) -> None:
    b, a = signal.butter(order, 2.0 * math.pi * fc_hz, analog=True)
    _, response = signal.freqs(b, a, np.array([1e-3, 2e-3]))
    slope_s = -float(np.diff(np.unwrap(np.angle(response)))[0] / 1e-3)
    delay_s = budgets.filter_delay_s(FilterConfig(order=order, fc_hz=fc_hz))
    assert delay_s == pytest.approx(slope_s, rel=1e-6)


def latency_budget(scenario: str, settings: Settings | None = None) -> dict[str, float]:
    return budget_of(lambda each: load(scenario, settings=each), settings or {})


@pytest.mark.parametrize("supply_pa", [6e5, 9e5])
def test_filling_in_closed_form_agrees_with_a_simulated_one(supply_pa: float) -> None:
    parameters = load_parameters("nominal")
    simulated_s = budgets.filling_simulated_s(parameters, supply_pa, 1e5)
    closed_s = budgets.filling_closed_s(parameters, supply_pa, 1e5)
    assert closed_s == pytest.approx(simulated_s, rel=0.01)


@pytest.fixture(scope="module")
def today() -> dict[str, float]:
    return latency_budget("lab_n_b")


def test_today_the_stay_is_at_its_stop_long_before(today: dict[str, float]) -> None:
    assert 0.018 < today["window_s"] < 0.023
    assert today["slack_s"] < -0.05
    assert max(BARS, key=lambda bar: today[simulated(bar)]) == "filter"
    assert today["spent_s"] - today[simulated("pressure build-up")] > 0.048


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

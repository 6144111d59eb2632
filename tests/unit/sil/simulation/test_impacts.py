"""Impacts: what counts, how it is weighed, and that a soft stop no longer hides a blow."""

from __future__ import annotations

import numpy as np
import pytest

from can_dbc.messages import Gear
from sil.simulation import load_scenario, metrics
from sil.simulation.impacts import counted, worst_speed_m_s
from sil.simulation.in_memory import Run, run_in_memory
from tests.support import made_run

BLOW_INSIDE = {
    "controller.strategy_parameters.trigger_m": 0.001,
    "controller.strategy_parameters.lead_s": 0.012,
    "controller.strategy_parameters.burst_s": 0.015,
    "controller.windows.gear_tolerance_m": 0.0015,
    "duration_s": 0.35,
}
"""A cushion that stops the stay softly, after its piston was thrown onto the nut."""


@pytest.fixture(scope="module")
def cushion() -> Run:
    return run_in_memory(load_scenario.load("strategy_air_cushion", settings=BLOW_INSIDE))


def test_only_the_first_contact_of_a_pick_up_is_not_counted() -> None:
    kind = np.array(["collar", "collar", "nut", "stop", "block", "stop"])
    time_s = np.array([0.1, 0.2, 0.15, 0.3, 0.25, np.inf])
    energy_j = np.array([0.1, 0.2, 0.3, 0.4, 0.5, 0.0])
    block = kind == "block"
    found = counted(kind, time_s, energy_j, block, ("collar",))
    assert found.tolist() == [False, True, True, True, False, False]
    assert counted(kind, time_s, energy_j, block, ()).tolist() == [True] * 4 + [False] * 2
    assert counted(kind[:0], time_s[:0], energy_j[:0], block[:0], ("collar",)).tolist() == []
    two_runs = counted(np.array([kind, kind]), np.array([time_s, time_s]), np.array([energy_j] * 2),
                       np.array([block, block]), ("nut",))  # fmt: skip
    assert two_runs.tolist() == [[True, True, False, True, False, False]] * 2


def test_the_hardest_impact_as_a_speed_of_the_stay() -> None:
    assert worst_speed_m_s(np.array(0.5 * 1.1 * 0.9**2), np.array(0.2), 1.1) == pytest.approx(0.9)
    assert worst_speed_m_s(np.array(0.0), np.array(0.2), 1.1) == 0.2


def test_a_blow_inside_is_counted(cushion: Run) -> None:
    shift = cushion.shifts[0]
    assert shift.impact_energy_j == pytest.approx(0.0106, abs=1e-4)
    assert shift.impact_worst_energy_j == pytest.approx(0.281, abs=1e-3)
    assert shift.impact_worst_force_n == pytest.approx((2 * 5e7 * 0.2811) ** 0.5, rel=1e-3)
    assert shift.impact_worst_m_s == pytest.approx((2 * 0.2811 / 1.1) ** 0.5, rel=1e-3)
    worst = max(shift.impacts, key=lambda impact: impact.energy_j)
    assert worst.name == "nut_1_contact"
    lost_j = sum(float(e.values.get("energy_j", 0.0)) for e in cushion.record.events)
    pick_up_j = lost_j - sum(impact.energy_j for impact in shift.impacts)
    assert lost_j == pytest.approx(cushion.balances["impact_j"])
    assert pick_up_j == pytest.approx(0.1197, abs=1e-3)


def test_a_gear_confirmed_before_the_stay_arrives_fails_the_scenario(cushion: Run) -> None:
    assert cushion.shifts[0].confirmed_early_s == pytest.approx(0.0138, abs=5e-4)
    failed = {check.name for check in cushion.checks if not check.passed}
    assert "confirmed before arrival" in failed
    shipped = run_in_memory(load_scenario.load("strategy_air_cushion"))
    assert shipped.shifts[0].confirmed_early_s == 0.0
    assert all(check.passed for check in shipped.checks)


def test_arrival_means_staying() -> None:
    record = made_run.made()
    time_s, position_m = record.truth["time_s"], record.truth["position_m"]
    before = metrics.shifts(record, Gear.NEUTRAL)[0]
    assert before.arrived_s == pytest.approx(0.150)
    position_m[(time_s > 0.16) & (time_s < 0.17)] -= 0.001
    again = metrics.shifts(record, Gear.NEUTRAL)[0]
    assert again.arrived_s == pytest.approx(0.170, abs=2e-4)
    assert again.impact_speed_m_s == before.impact_speed_m_s
    position_m[(time_s > 0.15)] -= 0.001
    assert metrics.shifts(record, Gear.NEUTRAL)[0].arrived_s is None


def test_the_strategies_differ_where_they_are_shipped() -> None:
    runs = [
        run_in_memory(load_scenario.load(f"strategy_{n}")) for n in ("air_cushion", "bang_bang")
    ]
    assert runs[0].trace_sha256 != runs[1].trace_sha256

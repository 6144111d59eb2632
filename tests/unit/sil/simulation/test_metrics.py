"""Figures of merit against a run whose figures are known in advance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from can_dbc.messages import Gear, ShiftRequest
from sil.recording.trace_csv import trace_columns
from sil.report.run_figure import shift_zooms
from sil.simulation import load_scenario, metrics
from sil.simulation.impacts import counted, worst_speed_m_s
from sil.simulation.in_memory import Run, run_in_memory
from tests.support import made_run


def test_crossing_is_linear_between_samples_and_none_when_never_reached() -> None:
    times = np.array([0.0, 1.0, 2.0])
    values = np.array([0.0, 1.0, 3.0])
    assert metrics.crossing(times, values, 2.0, True) == pytest.approx(1.5)
    assert metrics.crossing(times, values, 0.0, True) == 0.0
    assert metrics.crossing(times, values, 3.1, True) is None
    assert metrics.crossing(times, -values, -2.0, False) == pytest.approx(1.5)


def test_held_crossing_is_the_instant_of_the_sample() -> None:
    times = np.array([0.0, 1.0, 2.0])
    assert metrics.held_crossing(times, np.array([0.0, 1.0, 3.0]), 1.1, True) == 2.0
    assert metrics.held_crossing(times, np.array([0.0, 1.0, 3.0]), 3.1, True) is None


@pytest.mark.parametrize("lag", [0.0, 0.03])
def test_phase_averaged_crossing_is_the_mean_over_all_phases(lag: float) -> None:
    """A smooth ramp, sampled every 10 ms at 40 phases: the estimate from one phase is the mean."""

    def line(t: np.ndarray) -> np.ndarray:
        return np.tanh((t - lag - 0.2) / 0.02)

    held, estimates = [], []
    for phase in np.arange(0.0, 0.010, 0.00025):
        times = np.arange(phase, 0.5, 0.01)
        held.append(metrics.held_crossing(times, line(times), -0.5, True))
        estimates.append(metrics.phase_averaged_crossing(times, line(times), -0.5, True))
    exact = 0.2 + lag + 0.02 * np.arctanh(-0.5) + 0.005
    assert np.mean(held) == pytest.approx(exact, abs=2e-4)
    assert np.max(np.abs(np.array(estimates) - exact)) < 6e-4
    assert np.ptp(held) > 0.009


def test_gear_at_knows_the_three_stops_and_nothing_between() -> None:
    stroke = made_run.STROKE
    gears = [metrics.gear_at(x, stroke) for x in (0.0, stroke, -stroke, 0.5 * stroke)]
    assert gears == [Gear.NEUTRAL, Gear.BACKWARD, Gear.FORWARD, Gear.UNKNOWN]


def test_shift_instants() -> None:
    (shift,) = metrics.shifts(made_run.made(), Gear.NEUTRAL)
    assert (shift.from_gear, shift.to_gear) == ("neutral", "backward")
    assert shift.requested_s == 0.1
    assert shift.commanded_s == pytest.approx(0.110 + 2 * 0.00025)
    assert shift.valve_open_s == 0.118
    assert shift.first_motion_s == pytest.approx(0.130, abs=2e-4)
    assert shift.arrived_s == 0.150
    assert shift.confirmed_s == pytest.approx(0.170 + 4 * 0.00025)
    assert shift.blow_end_s == pytest.approx(0.190 + 3 * 0.00025)
    assert shift.shift_time_s == pytest.approx(0.050)
    assert shift.impact_speed_m_s == 0.6425


def test_lags_from_truth_and_from_the_bus_alone() -> None:
    """The estimate is 20 ms old when sent, 1 ms on the bus, held for 10 ms: 26 ms on average."""
    (shift,) = metrics.shifts(made_run.made(), Gear.NEUTRAL)
    for lag in (shift.position_lag_10_s, shift.position_lag_90_s):
        assert lag == pytest.approx(0.026, abs=1.5e-3)
    for lag in (shift.bus_lag_10_s, shift.bus_lag_90_s):
        assert lag == pytest.approx(0.026, abs=1.5e-3)
    assert shift.position_lag_10_held_s == pytest.approx(0.021 + 0.008, abs=2e-4)
    assert shift.position_lag_90_held_s == pytest.approx(0.021 + 0.002, abs=2e-4)


def cut_off_requests(record: made_run.RunRecord) -> made_run.RunRecord:
    asking = {entry.frame.can_id for entry, _ in record.of(ShiftRequest)}
    return replace(record, frames=[f for f in record.frames if f.frame.can_id not in asking])


def test_a_request_that_leads_nowhere_has_no_times() -> None:
    record = made_run.made()
    record.truth["position_m"][:] = 0.0  # type: ignore[index]
    found = metrics.shifts(replace(record, events=[]), Gear.NEUTRAL)
    assert found[0].arrived_s is None and found[0].shift_time_s is None
    assert found[0].position_lag_10_s is None
    assert metrics.summary(found, 0.0, 0, 0)["shift_time_s"] is None


def test_summary_of_the_run() -> None:
    record = made_run.made()
    found, switchings = metrics.shifts(record, Gear.NEUTRAL), metrics.valve_switchings(record)
    figures = metrics.summary(found, 0.004, switchings, len(record.frames))
    assert figures["shift_time_s"] == pytest.approx(0.050)
    assert figures["impact_energy_j"] == 0.2
    assert figures["valve_switchings"] == 2
    assert figures["air_used_kg"] == 0.004
    assert figures["frames"] == 200


@pytest.mark.parametrize("end_s", [0.0002, 0.05, 0.1001, 0.119, 0.14, 0.1505, 0.3])
def test_a_run_that_ended_early_has_the_figures_it_got_to(end_s: float) -> None:
    """Truth may end before the frames do, and the other way round."""
    whole = made_run.made()
    for frames_end_s in (0.0, 0.1003, end_s, 0.4):
        rows = whole.truth["time_s"] <= end_s
        cut = replace(
            whole,
            truth={name: column[rows] for name, column in whole.truth.items()},
            events=[e for e in whole.events if e.time_s <= end_s],
            frames=[f for f in whole.frames if f.arrival_ns <= frames_end_s * 1e9],
        )
        found = metrics.shifts(cut, Gear.NEUTRAL)
        assert len(found) == (frames_end_s >= 0.1003)
        if found and end_s < 0.15:
            assert found[0].arrived_s is None
        metrics.summary(found, None, 0, 0)
        assert trace_columns(cut)["time_s"][-1] <= end_s + 1e-4
        assert shift_zooms(cut, found)


def test_no_request_no_shift() -> None:
    record = made_run.made()
    assert metrics.shifts(cut_off_requests(record), Gear.NEUTRAL) == []
    assert metrics.shifts(record, Gear.BACKWARD)[0].to_gear == "neutral"
    assert [s.to_gear for s in metrics.shifts(record, Gear.BACKWARD)] == ["neutral", "backward"]


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
    loaded = [load_scenario.load(f"strategy_{name}") for name in ("air_cushion", "bang_bang")]
    assert len({run_in_memory(each).trace_sha256 for each in loaded}) == 2

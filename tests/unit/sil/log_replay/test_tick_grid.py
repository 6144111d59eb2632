"""Bit rate, period and phase of the recorded unit's ticks; which of them ran."""

from __future__ import annotations

import random

import pytest

from can_dbc.messages import PositionPulse, SafetyBlow, ValveCommand
from sil.log_replay.recorded_frames import OUTPUTS, Arrival
from sil.log_replay.tick_grid import make_grid, survey
from sil.log_replay.ticks import Span, TickMap, map_ticks
from sil.simulation import load_scenario
from tests.support.golden_logs import arrivals

NAMES = sorted(load_scenario.shipped())
COMPUTATION = 100_000


def moved(log: list[Arrival], by_ns: int, after_ns: int = -1) -> list[Arrival]:
    return [a._replace(time_ns=a.time_ns + by_ns) if a.time_ns > after_ns else a for a in log]


@pytest.mark.parametrize("name", NAMES)
def test_period_bit_rate_and_phase_of_every_golden_log(name: str) -> None:
    scene = load_scenario.load(name).scenario
    found = survey(arrivals(name), None)
    assert found.period_ns == scene.controller.period_ns
    assert found.bitrate in (scene.bus.bitrate, None)
    assert found.skew == 0.0
    grid = make_grid(found, found.period_ns, COMPUTATION)
    assert (grid.origin_ns, grid.exact, grid.fresh) == (0, True, True)


@pytest.mark.parametrize("offset_ns", [1_699_999_999_123_456_000, 7_003_000, 1_234_567_000])
@pytest.mark.parametrize(
    "name", ["lab_n_b", "firmware_2500us", "lost_frames", "late_valve_commands"]
)
def test_the_phase_is_exact_on_another_clock(name: str, offset_ns: int) -> None:
    found = survey(moved(arrivals(name), offset_ns))
    assert found.period_ns is not None
    grid = make_grid(found, found.period_ns, COMPUTATION)
    assert grid.origin_ns == offset_ns
    assert grid.exact


def test_a_log_that_begins_in_the_middle_is_not_taken_for_a_start() -> None:
    found = survey([a for a in arrivals("full_shift") if a.time_ns > 333_000_000])
    assert found.awake
    grid = make_grid(found, 10_000_000, COMPUTATION)
    assert not grid.fresh
    assert grid.origin_ns % 10_000_000 == 0 and 330_000_000 < grid.origin_ns <= 340_000_000


def test_coarse_times_leave_the_phase_uncertain_and_say_so() -> None:
    log = [a._replace(time_ns=a.time_ns // 100_000 * 100_000) for a in arrivals("lab_n_b")]
    found = survey(moved(log, 5_300_000))
    assert found.period_ns == 10_000_000 and found.resolution_ns == 100_000
    grid = make_grid(found, 10_000_000, COMPUTATION)
    assert not grid.exact and "to 0.1 ms" in grid.description
    assert abs(grid.origin_ns - 5_300_000) <= 400_000


def test_a_log_without_the_unit_has_no_tick() -> None:
    assert survey([]).release_ns is None
    with pytest.raises(ValueError, match="no tick"):
        make_grid(survey([]), 10_000_000, COMPUTATION)


def test_a_unit_that_stood_still_keeps_its_period() -> None:
    log = moved(arrivals("firmware_2500us"), 37_000_000, after_ns=300_050_000)
    assert survey(log).period_ns == 2_500_000
    paused = moved(arrivals("full_shift"), 150_000_000, after_ns=500_050_000)
    assert survey(paused).period_ns == 10_000_000


def test_a_recording_in_real_time_with_a_stop_keeps_its_periods() -> None:
    rng = random.Random(7)
    log = [
        a._replace(
            time_ns=a.time_ns + rng.randrange(400_000) + (a.time_ns > 200_000_000) * 47_000_000
        )
        for a in arrivals("full_shift")
    ]
    found = survey(sorted(log, key=lambda a: a.time_ns))
    assert (found.period_ns, found.sensor_period_ns) == (10_000_000, 10_000_000)


def test_pulses_that_arrive_late_and_overtake_each_other_keep_their_period() -> None:
    rng = random.Random(5)
    log = [
        a._replace(time_ns=a.time_ns + rng.randrange(4_000_000, 16_000_000))
        if a.kind is PositionPulse
        else a
        for a in arrivals("full_shift")
    ]
    assert survey(sorted(log, key=lambda a: a.time_ns)).sensor_period_ns == 10_000_000


PERIOD = 10_000_000


def mapped(log: list[Arrival]) -> TickMap:
    return map_ticks(log, make_grid(survey(log), PERIOD, 100_000))


def tick_of_time(arrival: Arrival) -> int:
    return (arrival.time_ns - 300_000) // PERIOD


def test_every_frame_of_a_quiet_run_belongs_to_the_tick_before_it() -> None:
    log = arrivals("full_shift")
    found = mapped(log)
    assert (found.idle, found.off_bus, found.restarts) == ([], [], [])
    answers = [a for a in log if a.kind in OUTPUTS]
    assert len(answers) == 800
    assert [found.tick_of(a) for a in answers] == [tick_of_time(a) for a in answers]
    assert found.last == 159


def test_a_delayed_frame_belongs_to_the_tick_of_its_counter() -> None:
    log = arrivals("late_valve_commands")  # each 15 to 20 ms late
    found = mapped(log)
    ticks = [found.tick_of(a) for a in log if a.kind is ValveCommand]
    assert ticks == list(range(len(ticks)))
    assert not found.idle and not found.off_bus


def test_silence_with_running_counters_is_off_the_bus() -> None:
    found = mapped(arrivals("bus_off"))
    assert found.off_bus == [Span(16, 36)] and not found.idle
    assert found.receives(159_999_999) and not found.receives(160_000_000)
    assert not found.receives(359_999_999) and found.receives(360_000_000)


def test_silence_with_standing_counters_is_standstill() -> None:
    log = arrivals("full_shift")
    stalled_ns = 70_000_000  # the control unit stops for seven periods and then goes on as if none had passed
    late = moved(log, stalled_ns, after_ns=500_050_000)
    found = mapped(late)
    assert found.idle == [Span(50, 57)] and not found.off_bus
    assert [found.idle_at(tick) is None for tick in (49, 50, 56, 57)] == [True, False, False, True]
    blow = next(a for a in late if a.kind is SafetyBlow and a.time_ns > 570_100_000)
    assert found.tick_of(blow) == 57


def test_a_hole_in_the_recording_begins_the_replay_anew() -> None:
    hole_ns = 3_600_000_000_000 + 3 * PERIOD
    found = mapped(moved(arrivals("full_shift"), hole_ns, after_ns=500_050_000))
    first = 50 + hole_ns // PERIOD
    assert found.restarts == [first]
    assert found.idle == [Span(50, first)]

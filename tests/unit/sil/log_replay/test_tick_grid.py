"""Bit rate, period and phase of the recorded unit's ticks out of logs where they are known."""

from __future__ import annotations

import random

import pytest

from can_dbc.messages import PositionPulse
from sil.log_replay.recorded_frames import Arrival
from sil.log_replay.tick_grid import make_grid, survey
from sil.simulation import load_scenario
from tests.support.golden_logs import arrivals

NAMES = sorted(load_scenario.shipped())
COMPUTATION = 100_000


def moved(log: list[Arrival], by_ns: int) -> list[Arrival]:
    return [a._replace(time_ns=a.time_ns + by_ns) for a in log]


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
    log = [a for a in arrivals("full_shift") if a.time_ns > 333_000_000]
    found = survey(log)
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
    log = [
        a._replace(time_ns=a.time_ns + 37_000_000) if a.time_ns > 300_050_000 else a
        for a in arrivals("firmware_2500us")
    ]
    assert survey(log).period_ns == 2_500_000
    paused = [
        a._replace(time_ns=a.time_ns + 150_000_000) if a.time_ns > 500_050_000 else a
        for a in arrivals("full_shift")
    ]
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

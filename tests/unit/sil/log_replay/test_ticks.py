"""Which ticks ran: losses, delays, silence off the bus, standstill and holes distinguished."""

from __future__ import annotations

from can_dbc.messages import SafetyBlow, ValveCommand
from sil.log_replay.recorded_frames import OUTPUTS, Arrival
from sil.log_replay.tick_grid import make_grid, survey
from sil.log_replay.ticks import Span, TickMap, map_ticks
from tests.support.golden_logs import arrivals

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


def test_lost_frames_leave_all_ticks_running() -> None:
    found = mapped(arrivals("lost_frames"))
    assert not found.idle and not found.off_bus


def test_silence_with_running_counters_is_off_the_bus() -> None:
    found = mapped(arrivals("bus_off"))
    assert found.off_bus == [Span(16, 36)] and not found.idle
    assert found.receives(159_999_999) and not found.receives(160_000_000)
    assert not found.receives(359_999_999) and found.receives(360_000_000)


def test_silence_with_standing_counters_is_standstill() -> None:
    log = arrivals("full_shift")
    stalled_ns = 70_000_000  # the control unit stops for seven periods and then goes on as if none had passed
    late = [
        a._replace(time_ns=a.time_ns + stalled_ns) if a.time_ns > 500_050_000 else a for a in log
    ]
    found = mapped(late)
    assert found.idle == [Span(50, 57)] and not found.off_bus
    assert [found.idle_at(tick) is None for tick in (49, 50, 56, 57)] == [True, False, False, True]
    blow = next(a for a in late if a.kind is SafetyBlow and a.time_ns > 570_100_000)
    assert found.tick_of(blow) == 57


def test_a_hole_in_the_recording_begins_the_replay_anew() -> None:
    log = arrivals("full_shift")
    hole_ns = 3_600_000_000_000 + 3 * PERIOD
    late = [a._replace(time_ns=a.time_ns + hole_ns) if a.time_ns > 500_050_000 else a for a in log]
    found = mapped(late)
    first = 50 + hole_ns // PERIOD
    assert found.restarts == [first]
    assert found.idle == [Span(50, first)]


def test_a_dead_unit_has_a_last_tick() -> None:
    assert mapped(arrivals("dead_controller")).last == 14

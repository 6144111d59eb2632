"""Solenoid valves: thresholds, delays, cancelled commands, duty-dependent closing."""

from __future__ import annotations

from math import exp, log

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from can_dbc.errors import InputError
from plant.devices.coil import CoilConfig, CoilValve
from plant.devices.valve import Valve, ValveTiming, seconds_to_ns, switch_schedule
from plant.parameters import load

MS = 1_000_000
TIMING = ValveTiming(8 * MS, 35 * MS, 0.33, 0.35)
BY_DUTY = ValveTiming(8 * MS, 35 * MS, 0.33, 0.35, True, 0.004, 0.0293)


def moves(commands: list[tuple[int, float]], timing: ValveTiming = TIMING) -> list[object]:
    valve = Valve(timing)
    for t_ns, duty in commands:
        valve.command(t_ns, duty)
    return list(valve.moves(10**12))


def test_opens_after_8_ms_and_closes_after_35_ms() -> None:
    assert moves([(10 * MS, 0.98), (200 * MS, 0.0)]) == [(18 * MS, 1.0), (235 * MS, 0.0)]


@pytest.mark.parametrize(("duty", "opens"), [(0.33, False), (0.34, False), (0.35, True), (1, True)])
def test_all_or_nothing_from_rest(duty: float, opens: bool) -> None:
    assert bool(moves([(0, duty)])) == opens


def test_between_the_thresholds_an_open_valve_stays_open() -> None:
    assert moves([(0, 0.98), (50 * MS, 0.34), (90 * MS, 0.33)]) == [(8 * MS, 1.0), (125 * MS, 0.0)]


def test_pulse_shorter_than_the_opening_delay_never_opens() -> None:
    assert moves([(0, 0.98), (8 * MS - 1, 0.0)]) == []


def test_move_due_at_the_instant_of_the_reversal_happens_first() -> None:
    assert moves([(0, 0.98), (8 * MS, 0.0)]) == [(8 * MS, 1.0), (43 * MS, 0.0)]


def test_closing_is_cancelled_by_a_command_within_35_ms() -> None:
    assert moves([(0, 0.98), (100 * MS, 0.0), (134 * MS, 0.98), (300 * MS, 0.0)]) == [
        (8 * MS, 1.0),
        (335 * MS, 0.0),
    ]


def test_repeating_a_command_does_not_restart_its_delay() -> None:
    assert moves([(0, 0.98), (5 * MS, 0.5), (7 * MS, 0.35)]) == [(8 * MS, 1.0)]


def test_less_current_closes_sooner() -> None:
    assert BY_DUTY.fall_delay_ns(0.98) == pytest.approx(35 * MS, abs=0.1 * MS)
    assert BY_DUTY.fall_delay_ns(0.5) == seconds_to_ns(0.004 + 0.0293 * log(0.5 / 0.34))
    assert BY_DUTY.fall_delay_ns(0.335) == 4 * MS
    delays = [BY_DUTY.fall_delay_ns(current / 100) for current in range(34, 101)]
    assert delays == sorted(delays)


def test_current_follows_the_duty_with_its_time_constant() -> None:
    tau_ns = seconds_to_ns(0.0293)
    assert BY_DUTY.current(0.2, 1.0, 0) == pytest.approx(0.2)
    assert BY_DUTY.current(0.2, 1.0, tau_ns) == pytest.approx(1.0 - 0.8 * exp(-1.0))
    assert BY_DUTY.current(0.98, 0.4, 40 * tau_ns) == pytest.approx(0.4)
    halves = BY_DUTY.current(BY_DUTY.current(0.98, 0.4, 7 * MS), 0.4, 13 * MS)
    assert halves == pytest.approx(BY_DUTY.current(0.98, 0.4, 20 * MS), rel=1e-12)
    assert TIMING.current(0.98, 0.4, 0) == 0.4


def test_short_filling_and_one_with_a_reduced_duty_end_sooner() -> None:
    for duty, length_ms in ((0.98, 20), (0.98, 30), (0.5, 30), (0.98, 200)):
        current = BY_DUTY.current(BY_DUTY.current(0.0, 0.98, 10 * MS), duty, (length_ms - 10) * MS)
        given = [(0, 0.0), (20 * MS, 0.98), (30 * MS, duty), ((20 + length_ms) * MS, 0.0)]
        closes_ns = (20 + length_ms) * MS + BY_DUTY.fall_delay_ns(current)
        assert moves(given, BY_DUTY) == [(28 * MS, 1.0), (closes_ns, 0.0)]
    assert BY_DUTY.fall_delay_ns(BY_DUTY.current(0.0, 0.98, 20 * MS)) < 15 * MS


@pytest.mark.parametrize("steps", [[(20, 0.98)], [(30, 0.98)], [(50, 0.98)], [(50, 0.98), (20, 0.4)],
                                   [(50, 0.98), (50, 0.5)], [(200, 0.98)]])  # fmt: skip
def test_closing_by_the_current_agrees_with_the_magnetic_circuit(
    steps: list[tuple[int, float]],
) -> None:
    def closes(valve: Valve) -> float:
        valve.command(0, 0.0)
        now_ns = 10 * MS
        for length_ms, duty in steps:
            valve.command(now_ns, duty)
            now_ns += length_ms * MS
        valve.command(now_ns, 0.0)
        (_, opened), (instant_ns, closed) = valve.moves(now_ns + 100 * MS)
        assert (opened, closed) == (1.0, 0.0)
        return 1e-6 * (instant_ns - now_ns)

    assert closes(Valve(BY_DUTY)) == pytest.approx(closes(CoilValve(TIMING, CoilConfig())), abs=2.5)


@pytest.mark.parametrize("duty", [-0.01, 1.01, float("nan"), float("inf")])
def test_impossible_duty_is_refused(duty: float) -> None:
    with pytest.raises(ValueError, match="duty"):
        Valve(TIMING).command(0, duty)


def test_impossible_start_timing_and_order_are_refused() -> None:
    with pytest.raises(ValueError, match="cannot be open"):
        Valve(TIMING, is_open=True, duty=0.0)
    with pytest.raises(InputError, match=r"valve.D_rise: "):
        ValveTiming(-1, 0, 0.33, 0.35)
    with pytest.raises(InputError, match=r"valve.duty_open: "):
        ValveTiming(1, 1, 0.35, 0.35)
    with pytest.raises(InputError, match=r"valve.D_fall: 1e\+300; expected 0 to 10 s"):
        load().override({"valve.D_fall": 1e300})
    with pytest.raises(InputError, match="1e\\+308 s"):
        seconds_to_ns(1e308)
    valve = Valve(TIMING)
    valve.command(5, 0.98)
    with pytest.raises(ValueError, match="after one at 5"):
        valve.command(4, 0.0)


COMMANDS = st.lists(
    st.tuples(st.integers(0, 120), st.sampled_from([0.0, 0.33, 0.34, 0.35, 0.98])), max_size=20
).map(lambda raw: sorted(((t * MS, duty) for t, duty in raw), key=lambda c: c[0]))


@settings(deadline=None)
@given(COMMANDS, st.lists(st.integers(0, 300), max_size=5))
def test_moves_do_not_depend_on_how_often_they_are_asked_for(
    commands: list[tuple[int, float]], asks: list[int]
) -> None:
    whole = moves(commands)
    valve, seen = Valve(TIMING), []
    steps = sorted([(t, 0, duty) for t, duty in commands] + [(a * MS, 1, 0.0) for a in asks])
    ordered = sorted(steps, key=lambda s: (s[0], s[1]))
    pending = list(commands)
    for t_ns, is_ask, _ in ordered:
        if is_ask:
            seen += valve.moves(t_ns)
        else:
            valve.command(*pending.pop(0))
    seen += valve.moves(10**12)
    assert seen == whole


@settings(deadline=None)
@given(COMMANDS)
def test_moves_alternate_and_follow_a_command_by_exactly_one_delay(
    commands: list[tuple[int, float]],
) -> None:
    result = moves(commands)
    assert [u for _, u in result] == [float(i % 2 == 0) for i in range(len(result))]
    starts = {t for t, _ in commands}
    for t_ns, u in result:
        assert t_ns - (TIMING.rise_ns if u else TIMING.fall_ns) in starts


def test_schedule_of_a_campaign_stroke() -> None:
    commands = [(0.01, 0, 0.98), (0.01, 1, 0.0), (0.2, 0, 0.0)]
    assert switch_schedule(commands, TIMING, valves=3, charged=(1,)) == [
        (18 * MS, 0, 1.0),
        (45 * MS, 1, 0.0),
        (235 * MS, 0, 0.0),
    ]
    with pytest.raises(ValueError, match="no valve 3"):
        switch_schedule([(0.0, 3, 0.98)], TIMING, valves=3)


def test_simultaneous_switches_are_ordered_by_chamber() -> None:
    schedule = switch_schedule([(0.0, 2, 0.98), (0.0, 0, 0.98)], TIMING, valves=3)
    assert schedule == [(8 * MS, 0, 1.0), (8 * MS, 2, 1.0)]

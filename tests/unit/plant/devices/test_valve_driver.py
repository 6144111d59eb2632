"""Valve driver and valves with faults: end-to-end checks, timers, the blow; what each fault does to the plunger."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from can_dbc import codec
from can_dbc.e2e import Protector, with_counter
from can_dbc.errors import InputError
from can_dbc.frame import Frame
from can_dbc.messages import Chamber, Gear, PlantMotion, SafetyBlow, ValveCommand
from plant.devices.coil import make_valve
from plant.devices.valve import CoilConfig, Drive, Valve, ValveTiming
from plant.devices.valve_driver import DE_ENERGISED, Duties, ValveDriver, ValveDriverConfig
from plant.devices.valve_faults import FaultyValve, ValveFault, ValveGroup
from plant.parameters import load

MS = 1_000_000
OFF = ValveCommand(0.0, 0.0, 0.0, Gear.NEUTRAL)
PUSH_B = ValveCommand(0.984375, 0.0, 0.0, Gear.BACKWARD)
NO_BLOW = SafetyBlow(Chamber.NONE, False, 0.0)
ON_B: Duties = (0.984375, 0.0, 0.0)

ON_N = ValveCommand(0.0, 0.98, 0.0, Gear.NEUTRAL)
MIXED = ValveCommand(0.0, 0.5, 0.25, Gear.NEUTRAL)
FULL = ValveCommand(1.0, 0.0, 0.5, Gear.BACKWARD)
FIRST = range(0, 20, 10)
BLOWN = (0.0, 0.98, 0.0)

BusFrame = tuple[int, Frame]
Part = tuple[range | int, ValveCommand, SafetyBlow]


class Controller:
    """Sends both messages every 10 ms, 0.3 ms and 0.5 ms after its tick."""

    def __init__(self) -> None:
        self.commands = Protector(ValveCommand)
        self.blows = Protector(SafetyBlow)

    def tick(
        self, t_ms: int, command: ValveCommand = PUSH_B, blow: SafetyBlow = NO_BLOW
    ) -> list[BusFrame]:
        return [
            (t_ms * MS + 300_000, self.commands.protect(command)),
            (t_ms * MS + 500_000, self.blows.protect(blow)),
        ]

    def ticks(
        self, times: range, command: ValveCommand = PUSH_B, blow: SafetyBlow = NO_BLOW
    ) -> list[BusFrame]:
        return [frame for t in times for frame in self.tick(t, command, blow)]


def driver(config: ValveDriverConfig | None = None) -> ValveDriver:
    return ValveDriver(config or ValveDriverConfig(), blow_duty=0.98)


def test_nothing_is_energised_before_both_channels_are_valid() -> None:
    unit, sender = driver(), Controller()
    frames = sender.ticks(range(0, 40, 10))
    only_commands = [f for i, f in enumerate(frames) if i % 2 == 0]
    assert driver().advance(40 * MS, only_commands) == []
    changes = unit.advance(40 * MS, frames)
    assert changes == [(10_500_000, ON_B)]  # the second frame of each proves the sequence
    assert unit.target is Gear.BACKWARD and unit.duties == ON_B


def test_dead_controller_de_energises_the_valves_at_the_stated_instant() -> None:
    unit = driver(ValveDriverConfig(timeout_s=0.05))
    changes = unit.advance(1000 * MS, Controller().ticks(range(0, 100, 10)))
    assert changes[-1] == (90 * MS + 300_000 + 50 * MS, DE_ENERGISED)
    assert len(changes) == 2
    assert unit.target is Gear.UNKNOWN


def test_a_frame_at_the_instant_of_the_timeout_is_in_time() -> None:
    unit, sender = driver(ValveDriverConfig(timeout_s=0.05)), Controller()
    frames = sender.ticks(range(0, 40, 10))
    late = [(f[0] + 40 * MS, f[1]) for f in sender.tick(40)]  # 50 ms after the ones at 30 ms
    assert unit.advance(85 * MS, [*frames, *late]) == [(10_500_000, ON_B)]
    unit, sender = driver(ValveDriverConfig(timeout_s=0.05)), Controller()
    frames = sender.ticks(range(0, 40, 10))
    too_late = [(f[0] + 40 * MS + 1, f[1]) for f in sender.tick(40)]
    assert unit.advance(85 * MS, [*frames, *too_late])[1] == (80 * MS + 300_000, DE_ENERGISED)


def test_either_channel_falling_silent_de_energises() -> None:
    for silent in (0, 1):
        unit, sender = driver(), Controller()
        frames = sender.ticks(range(0, 100, 10))
        kept = [f for i, f in enumerate(frames) if i < 8 or i % 2 != silent]
        last = max(t for i, (t, _) in enumerate(frames) if i < 8 and i % 2 == silent)
        assert unit.advance(200 * MS, kept)[1] == (last + 50 * MS, DE_ENERGISED)


def blow(chamber: Chamber, left_s: float, active: bool = True) -> SafetyBlow:
    return SafetyBlow(chamber, active, left_s)


N, B, F = Chamber.N, Chamber.B, Chamber.F
SEQUENCES: dict[str, tuple[dict[str, float], list[Part], int, list[tuple[int, Duties]]]] = {
    "duties as commanded": (
        {}, [(FIRST, PUSH_B, NO_BLOW), (20, MIXED, NO_BLOW)], 21,
        [(10_500_000, ON_B), (20_300_000, (0.0, 0.5, 0.25))],
    ),
    "a blow until its own clock has run out": (
        {}, [(FIRST, OFF, NO_BLOW), (20, OFF, blow(N, 0.015)), (30, OFF, blow(N, 0.005))], 50,
        [(20_500_000, BLOWN), (35_500_000, DE_ENERGISED)],
    ),
    "a blow whose frames are delayed": (
        {}, [(FIRST, OFF, NO_BLOW), (20, OFF, blow(F, 0.0125))], 60,
        [(20_500_000, (0.0, 0.0, 0.98)), (33_000_000, DE_ENERGISED)],
    ),
    "a larger commanded duty and other chambers stay": (
        {}, [(FIRST, FULL, blow(B, 0.1))], 20, [(10_500_000, (1.0, 0.0, 0.5))],
    ),
    "a blow without chamber": ({}, [(range(0, 50, 10), OFF, blow(Chamber.NONE, 0.1))], 50, []),
    "a blow not active": ({}, [(range(0, 50, 10), OFF, blow(N, 0.1, False))], 50, []),
    "a blow cut by an inactive frame": (
        {}, [(FIRST, OFF, blow(N, 0.15)), (20, OFF, NO_BLOW)], 30,
        [(10_500_000, BLOWN), (20_500_000, DE_ENERGISED)],
    ),
    "a blow cut by the limit": (
        {"blow_limit_s": 0.005}, [(FIRST, OFF, blow(N, 4.0))], 30,
        [(10_500_000, BLOWN), (15_500_000, DE_ENERGISED)],
    ),
    "a blow cut by a dead controller": (
        {}, [(FIRST, OFF, blow(N, 0.15))], 300, [(10_500_000, BLOWN), (60_300_000, DE_ENERGISED)],
    ),
    "a new command outlasts the blow": (
        {}, [(FIRST, OFF, NO_BLOW), (20, OFF, blow(N, 0.015)), (30, ON_N, blow(N, 0.003)),
             (40, ON_N, NO_BLOW)], 49, [(20_500_000, BLOWN)],
    ),
    "a blow that changes its chamber takes over the new one": (
        {}, [(FIRST, ON_N, blow(B, 0.1)), (20, ON_N, blow(N, 0.005))], 29,
        [(10_500_000, (0.98, 0.98, 0.0)), (20_500_000, BLOWN), (25_500_000, DE_ENERGISED)],
    ),
    "peak and hold, and a new peak": (
        {"hold_duty": 0.4, "peak_s": 0.02},
        [(range(0, 60, 10), PUSH_B, NO_BLOW), (60, OFF, NO_BLOW), (70, PUSH_B, NO_BLOW)], 80,
        [(10_500_000, ON_B), (30_500_000, (0.4, 0.0, 0.0)), (60_300_000, DE_ENERGISED),
         (70_300_000, ON_B)],
    ),
    "blow duty as configured": (
        {"blow_duty": 0.36}, [(range(0, 30, 10), OFF, blow(N, 0.1))], 30,
        [(10_500_000, (0.0, 0.36, 0.0))],
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", SEQUENCES)
def test_sequences(name: str) -> None:
    config, parts, until_ms, expected = SEQUENCES[name]
    unit, sender = driver(ValveDriverConfig(**config)), Controller()
    frames = []
    for when, command, blown in parts:
        times = when if isinstance(when, range) else range(when, when + 1)
        frames += sender.ticks(times, command, blown)
    assert unit.advance(until_ms * MS, frames) == expected


def test_a_command_lost_after_a_blow_that_was_cut_does_not_energise_again() -> None:
    unit, sender = driver(), Controller()
    frames = sender.ticks(range(0, 20, 10), ON_N)
    frames += sender.tick(20, ON_N, SafetyBlow(Chamber.N, True, 0.15))
    frames += sender.tick(30, OFF)[1:]
    assert unit.advance(39 * MS, frames)[-1] == (30_500_000, DE_ENERGISED)


def test_other_frames_are_passed_over() -> None:
    unit = driver()
    other = codec.encode(PlantMotion(0.0, 0.0, 0.0, 0.0))
    strange = Frame(0x123, b"")
    assert unit.advance(5 * MS, [(1 * MS, other), (2 * MS, strange)]) == []


def test_single_lost_and_repeated_frames_change_nothing() -> None:
    unit, sender = driver(), Controller()
    kept = [f for i, f in enumerate(sender.ticks(range(0, 200, 10))) if i not in (8, 9, 20, 31)]
    kept.insert(13, (kept[12][0], kept[12][1]))
    assert unit.advance(195 * MS, kept) == [(10_500_000, ON_B)]


def test_frozen_counter_de_energises() -> None:
    unit, sender = driver(), Controller()
    frames = sender.ticks(range(0, 50, 10))
    frozen = [(t + i * 10 * MS, f) for i in range(1, 20) for t, f in frames[-2:]]
    changes = unit.advance(300 * MS, frames + frozen)
    assert changes[1] == (70_300_000, DE_ENERGISED)  # no good frame among the last three
    assert len(changes) == 2


def test_a_sender_whose_counter_never_settles_does_not_keep_an_old_command_in_force() -> None:
    unit, sender = driver(), Controller()
    frames = sender.ticks(range(0, 30, 10))
    counter = 3
    for t in range(30, 500, 10):  # jump, step, jump, step: never a good frame
        counter = (counter + (7 if t % 20 else 1)) % 16
        for at, frame in sender.tick(t):
            kind = ValveCommand if at % MS == 300_000 else SafetyBlow
            frames.append((at, with_counter(kind, frame, counter)))
    changes = unit.advance(500 * MS, frames)
    assert changes[1][1] == DE_ENERGISED and changes[1][0] <= 20_500_000 + 50 * MS
    assert len(changes) == 2


DAMAGE = st.lists(
    st.tuples(st.integers(0, 39), st.binary(min_size=0, max_size=8)), min_size=1, max_size=12
)


def check_damaged(damage: list[tuple[int, bytes]]) -> None:
    """Frames replaced by any bytes: the commanded valve or none, and none in the end."""
    unit, sender = driver(), Controller()
    frames = sender.ticks(range(0, 200, 10))
    for index, data in damage:
        t, frame = frames[index]
        if data != frame.data:
            frames[index] = (t, replace_data(frame, data))
    for _, duties in unit.advance(400 * MS, frames):
        assert duties in (ON_B, DE_ENERGISED)
    assert unit.duties == DE_ENERGISED


@settings(max_examples=300, deadline=None)
@given(DAMAGE)
def test_bytes_at_random_never_energise_a_wrong_valve(damage: list[tuple[int, bytes]]) -> None:
    check_damaged(damage)


def replace_data(frame: Frame, data: bytes) -> Frame:
    return Frame(frame.can_id, data)


@settings(deadline=None)
@given(st.lists(st.integers(1, 400), max_size=12), st.sets(st.integers(0, 59), max_size=40))
def test_changes_do_not_depend_on_how_often_the_driver_is_advanced(
    cuts: list[int], lost: set[int]
) -> None:
    sender = Controller()
    frames = sender.ticks(range(0, 150, 10))
    frames += sender.ticks(range(150, 300, 10), OFF, SafetyBlow(Chamber.N, True, 0.0225))
    frames = [f for i, f in enumerate(frames) if i not in lost]
    whole = driver().advance(400 * MS, frames)
    unit, pieces = driver(), []
    for cut in [*sorted(cuts), 400]:
        due = [f for f in frames if f[0] <= cut * MS]
        frames = frames[len(due) :]
        pieces += unit.advance(cut * MS, due)
    assert pieces == whole


def test_instants_out_of_order_are_refused() -> None:
    unit, sender = driver(), Controller()
    unit.advance(50 * MS, [])
    with pytest.raises(ValueError, match="outside"):
        unit.advance(60 * MS, sender.tick(0))
    with pytest.raises(ValueError, match="go back"):
        unit.advance(10 * MS, [])


def test_blow_goes_on_with_the_duty_that_was_commanded() -> None:
    """From the frame with the blow on, also when the command ends; one below 35 % does not count."""
    for commanded, blown in ((0.36, 0.36), (0.25, 0.98)):
        unit, sender = driver(), Controller()
        push = ValveCommand(commanded, 0.0, 0.0, Gear.BACKWARD)
        blow = SafetyBlow(Chamber.B, True, 0.1)
        frames = sender.ticks(range(0, 20, 10), push) + sender.tick(20, push, blow)
        frames += sender.ticks(range(30, 60, 10), OFF, blow)
        changes = unit.advance(60 * MS, frames)
        assert unit.duties[0] == pytest.approx(blown, abs=1e-4)
        assert [duties for _, duties in changes if duties[0] == 0.0] == []


TIMING = ValveTiming.from_parameters(load())
RISE, FALL = 8, 35
SWITCHED = [(20 * MS, 0.98), (100 * MS, 0.0)]


def moves(*faults: dict[str, Any], step_ms: int = 200, seed: int = 1) -> list[tuple[float, float]]:
    """Moves (ms, u) of a valve commanded on at 20 ms and off at 100 ms, seen in pieces."""
    valve = Valve(TIMING)
    faulty = FaultyValve(
        valve, [msgspec.convert({"valve": "B", **fault}, ValveFault) for fault in faults], seed
    )
    plunger_moves = []
    waiting = list(SWITCHED)
    for until in range(step_ms * MS, 401 * MS, step_ms * MS):
        while waiting and waiting[0][0] <= until:
            faulty.hand_over(*waiting.pop(0))
        for instant, duty in faulty.until(until):
            valve.command(instant, duty)
        plunger_moves += [(t / MS, u) for t, u in valve.moves(until)]
    return plunger_moves


HEALTHY = [(20 + RISE, 1.0), (100 + FALL, 0.0)]


def test_without_the_fault_acting_the_valve_is_healthy() -> None:
    assert moves({"kind": "off", "start_s": 0.3}) == HEALTHY
    assert moves({"kind": "stuck", "start_s": 0.0, "end_s": 0.01}) == HEALTHY


def test_off_never_opens_and_falls_closed_when_it_begins_late() -> None:
    assert moves({"kind": "off"}) == []
    assert moves({"kind": "off", "start_s": 0.05}) == [(28, 1.0), (50 + FALL, 0.0)]


def test_wrong_opens_by_itself_and_stays_open() -> None:
    assert moves({"kind": "wrong", "start_s": 0.01}) == [(10 + RISE, 1.0)]
    assert moves({"kind": "wrong", "start_s": 0.05, "end_s": 0.15}) == [(28, 1.0), (185, 0.0)]


def test_stuck_stays_where_it_is_and_follows_when_freed() -> None:
    assert moves({"kind": "stuck"}) == []
    assert moves({"kind": "stuck", "start_s": 0.05}) == [(28, 1.0)]
    assert moves({"kind": "stuck", "end_s": 0.06}) == [(60 + RISE, 1.0), (135, 0.0)]
    assert moves({"kind": "stuck", "start_s": 0.05, "end_s": 0.2}) == [(28, 1.0), (235, 0.0)]


def test_slow_takes_longer_by_its_factor() -> None:
    assert moves({"kind": "slow", "factor": 2.0}) == [(36, 1.0), (170, 0.0)]


def test_delayed_moves_everything_later() -> None:
    assert moves({"kind": "delayed", "delay_s": 0.03}) == [(58, 1.0), (165, 0.0)]
    # the fault ends while a command is on its way
    assert moves({"kind": "delayed", "delay_s": 0.03, "end_s": 0.03}) == [(38, 1.0), (135, 0.0)]
    late_end = {"kind": "delayed", "delay_s": 0.03, "end_s": 0.12}
    assert moves(late_end) == [(58, 1.0), (120 + FALL, 0.0)]


def test_intermittent_is_off_in_some_slots_only() -> None:
    plunger_moves = moves({"kind": "intermittent", "probability": 0.3})
    assert plunger_moves and plunger_moves != HEALTHY
    assert all((t - RISE) % 10 == 0 for t, u in plunger_moves if u == 1.0)
    assert moves({"kind": "intermittent", "probability": 0.0}) == HEALTHY
    assert moves({"kind": "intermittent", "probability": 1.0}) == []


def test_garbage_opens_without_a_command_and_repeats_with_its_seed() -> None:
    fault = {"kind": "garbage"}
    assert moves(fault)[0][0] < 20 + RISE or moves(fault)[-1][0] > 100 + FALL
    assert moves(fault) == moves(fault) and moves(fault) != moves(fault, seed=2)


@pytest.mark.parametrize(
    "kind", msgspec.json.schema(ValveFault)["$defs"]["ValveFault"]["properties"]["kind"]["enum"]
)
def test_pieces_do_not_matter(kind: str) -> None:
    fault = {"kind": kind, "start_s": 0.03, "end_s": 0.33}
    assert [moves(fault, step_ms=step) for step in (1, 5, 50)] == [moves(fault, step_ms=400)] * 3


def test_what_cannot_be_is_refused() -> None:
    with pytest.raises(InputError, match="expected after its start"):
        moves({"kind": "off", "start_s": 0.2, "end_s": 0.1})
    with pytest.raises(InputError, match="twice at one time"):
        moves({"kind": "off"}, {"kind": "off", "start_s": 0.1})


NAMES = ("B", "N", "F")
ALL_ON = [(5 * MS, (1.0, 1.0, 1.0))]


def group(*faults: ValveFault, drive: Drive = "delays") -> ValveGroup:
    valves = [make_valve(drive, TIMING, CoilConfig(), False, 0.0, MS) for _ in NAMES]
    return ValveGroup(valves, NAMES, faults, seed=1)


def test_moves_of_one_instant_are_in_the_order_of_the_chambers() -> None:
    coils, moves = group().drive(100 * MS, ALL_ON)
    assert coils == [(5 * MS, chamber, 1.0) for chamber in range(3)]
    assert moves == [(5 * MS + TIMING.rise_ns, chamber, 1.0) for chamber in range(3)]


def test_a_move_due_later_happens_in_the_next_interval() -> None:
    valves = group()
    assert valves.drive(6 * MS, ALL_ON)[1] == []
    assert valves.drive(100 * MS, []) == (
        [],
        [(5 * MS + TIMING.rise_ns, chamber, 1.0) for chamber in range(3)],
    )


def test_a_fault_acts_on_its_own_valve() -> None:
    coils, moves = group(ValveFault(valve="N", kind="off", start_s=0.0)).drive(100 * MS, ALL_ON)
    assert {chamber for _, chamber, _ in coils} == {chamber for _, chamber, _ in moves} == {0, 2}


def test_a_fault_that_energises_a_coil_needs_no_command() -> None:
    fault = ValveFault(valve="F", kind="wrong", start_s=0.02, end_s=0.06)
    coils, moves = group(fault).drive(200 * MS, [])
    assert coils == [(20 * MS, 2, 1.0), (60 * MS, 2, 0.0)]
    assert moves == [(20 * MS + TIMING.rise_ns, 2, 1.0), (60 * MS + TIMING.fall_ns, 2, 0.0)]


def test_currents_are_those_since_the_last_call_and_only_of_coils() -> None:
    assert list(group().currents()) == []
    valves = group(drive="coil")
    valves.drive(20 * MS, ALL_ON)
    first = [at for at, chamber, _ in valves.currents() if chamber == 1]
    valves.drive(40 * MS, [])
    second = [at for at, chamber, _ in valves.currents() if chamber == 1]
    assert first and second and max(first) < min(second)
    assert all(before < after for before, after in pairwise(first + second))

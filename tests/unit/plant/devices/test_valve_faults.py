"""What each fault of a valve does to its plunger, against the same commands without it."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import msgspec
import pytest

from can_dbc.errors import InputError
from plant.devices.coil import make_valve
from plant.devices.valve import CoilConfig, Drive, Valve, ValveTiming
from plant.devices.valve_faults import FaultyValve, ValveFault, ValveGroup
from plant.parameters import load

MS = 1_000_000
TIMING = ValveTiming.from_parameters(load())
RISE, FALL = 8, 35
COMMANDS = [(20 * MS, 0.98), (100 * MS, 0.0)]


def moves(*faults: dict[str, Any], step_ms: int = 200, seed: int = 1) -> list[tuple[float, float]]:
    """Moves (ms, u) of a valve commanded on at 20 ms and off at 100 ms, seen in pieces."""
    valve = Valve(TIMING)
    faulty = FaultyValve(
        valve, [msgspec.convert({"valve": "B", **fault}, ValveFault) for fault in faults], seed
    )
    plunger_moves = []
    waiting = list(COMMANDS)
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
    assert moves(fault) == moves(fault)
    assert moves(fault) != moves(fault, seed=2)


@pytest.mark.parametrize(
    "kind", msgspec.json.schema(ValveFault)["$defs"]["ValveFault"]["properties"]["kind"]["enum"]
)
def test_pieces_do_not_matter(kind: str) -> None:
    fault = {"kind": kind, "start_s": 0.03, "end_s": 0.33}
    whole = moves(fault, step_ms=400)
    assert [moves(fault, step_ms=step) for step in (1, 5, 50)] == [whole] * 3


def test_what_cannot_be_is_refused() -> None:
    with pytest.raises(InputError, match="expected after its start"):
        moves({"kind": "off", "start_s": 0.2, "end_s": 0.1})
    with pytest.raises(InputError, match="twice at one time"):
        moves({"kind": "off"}, {"kind": "off", "start_s": 0.1})


NAMES = ("B", "N", "F")
MS = 1_000_000
TIMING = ValveTiming.from_parameters(load())
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

"""Three valves together: order of their moves, faults of one, currents of coils."""

from __future__ import annotations

from itertools import pairwise

from plant.devices.coil import make_valve
from plant.devices.valve import CoilConfig, Drive, ValveTiming
from plant.devices.valve_faults import ValveFault
from plant.devices.valve_group import ValveGroup
from plant.parameters import load

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

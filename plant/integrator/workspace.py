"""What one integration works on: its views, and the memory of its steps, events and rests."""

from __future__ import annotations

from typing import Any, NamedTuple

from plant.integrator.filling import ChamberCurve
from plant.kernel.layout import GUARDS, MAX_STATES, Impact, Modes, Quadratures
from plant.kernel.records import Record, Value, block
from plant.kernel.views import named

# Rows of vectors and matrices: whole cache lines, which the vector instructions need.
WIDEST, ROW = 32, 16
assert WIDEST - Quadratures.size - MAX_STATES >= 0 and ROW - MAX_STATES >= 0


class Motion(NamedTuple):
    """Views of one stroke: state, modes, valve positions u0 + du t, parameters, flow map, scratch."""

    y: Any
    m: Any
    u0: Any
    du: Any
    p: Any
    c: Any
    scratch: Any


class Scratch(Record):
    """Memory of events and rests."""

    guards: Value = block(GUARDS)  # at the end of a step
    before: Value = block(GUARDS)  # at its start
    trial: Value = block(GUARDS)
    older: Value = block(GUARDS)
    impact: Value = block(Impact.size)
    rest: Value = block(3 * ChamberCurve.size)


class Run(Record):
    """One integration by the scalar kernel: state, valves, step control, memory."""

    y: Value = block(WIDEST)  # state and quadratures behind it
    # memory of a step
    y1: Value = block(WIDEST)
    stage: Value = block(WIDEST)
    error: Value = block(WIDEST)
    column: Value = block(WIDEST)
    time_rate: Value = block(WIDEST)  # derivative of the rates in time
    k: Value = block(7, WIDEST)
    dense: Value = block(5, WIDEST)
    jacobian: Value = block(WIDEST, ROW)
    lu: Value = block(MAX_STATES, ROW)
    pivot: Value = block(ROW)
    scale: Value = block(ROW)  # typical size of each state, for the error control
    u0: Value = block(3)  # valve positions u0 + du t
    du: Value = block(3)
    tolerance: Value
    time: Value
    end: Value
    next: Value  # time of the next switch, or of the end
    wanted: Value  # step that the error control would take; carried over from call to call
    step: Value
    scratch: Value = block(Scratch.size)


class Control(Record):
    """Counters and switches of one integration (int64)."""

    modes: Value = block(Modes.size)
    states: Value  # how many leading states are integrated
    quadratures: Value  # how many quadratures are behind the states, 0 or all
    use: Value  # OWN_STEPS, WRITE_GRID or FOLLOW_GRID
    grid_steps: Value  # steps in the grid
    starting: Value  # 1: the modes of motion are yet to be chosen
    # counted up
    events: Value
    steps: Value
    corners: Value  # of a law passed, which are no events
    # of the loop
    next_switch: Value
    next_sample: Value
    most_events: Value
    fresh: Value  # 1: something changed at this instant
    has_jacobian: Value
    columns: Value = block(MAX_STATES)


scratch_of = named(Scratch)
run_of = named(Run)
control_of = named(Control)

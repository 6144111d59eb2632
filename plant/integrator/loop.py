"""The event loop's parts that one stroke and the lanes of a batch share.

`r` has time, end, next, wanted and step, `k` the counters: `Run` and `Control`, or `lane_steps.Lane` and `Memory`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from plant.integrator import filling
from plant.integrator.events import all_guards, locate
from plant.integrator.steppers import interpolate, interpolated
from plant.kernel import layout
from plant.kernel.compiled import called, inlined
from plant.kernel.records import Record, Value, block
from plant.kernel.views import named

# Rows of vectors and matrices: whole cache lines, which the vector instructions need.
WIDEST, ROW = 32, 16
assert WIDEST - layout.Quadratures.size - layout.MAX_STATES >= 0 and ROW - layout.MAX_STATES >= 0


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

    guards: Value = block(layout.GUARDS)  # at the end of a step
    before: Value = block(layout.GUARDS)  # at its start
    trial: Value = block(layout.GUARDS)
    older: Value = block(layout.GUARDS)
    impact: Value = block(layout.Impact.size)
    rest: Value = block(3 * filling.ChamberCurve.size)


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
    lu: Value = block(layout.MAX_STATES, ROW)
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

    modes: Value = block(layout.Modes.size)
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
    columns: Value = block(layout.MAX_STATES)


scratch_of = named(Scratch)
run_of = named(Run)
control_of = named(Control)


# Why a loop stopped.
DONE, TOO_MANY_EVENTS, STEP_TOO_SMALL, NOT_FINITE = 0, 1, 2, 3
OFF_GRID = 10  # something happened that the stroke of the grid did not meet
# It goes on: with a step, or because something has happened at this instant.
STEPPING, AGAIN = -1, -2

GRID_COLUMNS, EVENT_COLUMNS = layout.GridRow.size, layout.EventRow.size

MAX_EVENTS = 4000
LONGEST_STEP_S = 5e-3
STEP_AFTER_EVENT_S = 2e-5
STEP_AFTER_REST_S = 4e-4


class Task(NamedTuple):
    """Views of what a stroke is given and what it writes.

    switches: rows (time, chamber, position, slope); samples: instants wanted -> out, `columns` of the state each; both
    ascending; events: room for so many; table: filling curves, if tabulated; grid: steps written or followed (`use`);
    stored: what the grid's stroke stored of each sample at rest, for its neighbours.
    """

    switches: Any
    n_switch: Any
    samples: Any
    n_sample: Any
    columns: Any
    n_columns: Any
    out: Any
    events: Any
    room: Any
    table: Any
    tabulated: Any
    grid: Any
    steps: Any
    use: Any
    stored: Any
    neighbours: Any


@called
def apply_switches(r, k, o, task):
    """Move the valves that are due, and store the time of the next switch; True if one has moved."""
    switches = task.switches
    u0 = o.u0
    du = o.du
    before = k.next_switch
    i = before
    while i < task.n_switch and switches[4 * i] <= r.time:
        chamber = int(switches[4 * i + 1])
        du[chamber] = switches[4 * i + 3]
        u0[chamber] = switches[4 * i + 2] - du[chamber] * switches[4 * i]
        i += 1
    k.next_switch = i
    r.next = min(switches[4 * i], r.end) if i < task.n_switch else r.end
    return i > before


@inlined
def valves_stand(o):
    """Return True if no valve is moving."""
    return o.du[0] == 0.0 and o.du[1] == 0.0 and o.du[2] == 0.0


@inlined
def grid_step(task, number):
    """Step of that number in the grid, the last one if there are not so many."""
    return layout.grid_row(task.grid[min(number, task.steps - 1) * GRID_COLUMNS :])


@called
def choose_step(r, k, task):
    """Choose the step: what the error control wants, up to the next switch; or the grid's. STEPPING, or OFF_GRID."""
    if task.use == filling.FOLLOW_GRID:
        if k.steps >= task.steps:
            return OFF_GRID
        row = grid_step(task, k.steps)
        end = r.next if row.switch != 0.0 else row.end
        r.step = end - r.time
        return STEPPING if r.time < end and end <= r.next else OFF_GRID
    left = r.next - r.time
    h = r.wanted
    r.step = left if h >= left * (1.0 - 1e-12) else min(h, 0.5 * left)
    return STEPPING


@inlined
def expects_event(task, number):
    """Return True if an event may end this step: on a grid, only where its own stroke met one."""
    return task.use != filling.FOLLOW_GRID or grid_step(task, number).guard >= 0.0


@inlined
def first_event(r, theta, fired, y1, spare, o, task, n):
    """Find the first event within a step: its fraction of the step, and its guard or -1; y1: the state there.

    theta: fraction at which a body may have turned or met another one, 1 if none; fired: a guard of scratch.guards is
    negative at the end. Guard -2: the grid's stroke had passed no guard where this one has.
    """
    t = r.time
    if theta < 1.0:
        interpolate(theta, r.dense, spare, n)
        fired = all_guards(t + theta * r.step, spare, o, o.scratch.guards) < 0.0
    if not fired:
        return 1.0, -1
    if all_guards(t, o.y, o, o.scratch.before) < 0.0 and task.use == filling.FOLLOW_GRID:
        return theta, -2
    return locate(t, r.step, theta, r.dense, y1, o, n)


@called
def follow_or_write(r, task, number, last, happened):
    """Write a step to the grid, or compare it; False if something else happened (-1: nothing)."""
    if task.use == filling.OWN_STEPS:
        return True
    row = grid_step(task, number)
    if task.use == filling.FOLLOW_GRID:
        return row.guard == happened
    row.end = r.time + r.step
    row.switch = 1.0 if last else 0.0
    row.guard = happened
    return True


@inlined
def store_event(t, index, impact, y, count, task):
    """Store an event as number `count` if there is room for it."""
    if count < task.room:
        row = layout.event_row(task.events[count * EVENT_COLUMNS :])
        row.time = t
        row.guard = index
        row.lost = impact.lost
        row.speed = impact.speed
        row.at_block = impact.at_block
        row.x = y[0]
        row.v = y[1]


@called
def sample_rest(r, k, o, y1, until, task):
    """Write the samples of a rest from now on, from its curves; y1 holds all that does not move."""
    t = r.time
    samples = task.samples
    n_columns = task.n_columns
    begin = k.next_sample
    end = begin
    while end < task.n_sample and samples[end] <= until:
        end += 1
    k.next_sample = end
    first = layout.FIRST_PRESSURE[int(o.m.system)]
    count = layout.CHAMBERS[int(o.m.system)]
    for i in range(n_columns):
        chamber = task.columns[i] - first
        row = filling.chamber_of(o.scratch.rest, max(chamber, 0))
        out = task.out[i:]
        if chamber < 0 or chamber >= count or row.kind == filling.STILL:
            value = y1[task.columns[i]]
            for s in range(begin, end):
                out[s * n_columns] = value
        elif task.use == filling.OWN_STEPS or not task.neighbours:
            filling.chamber_samples(row, task.table, t, samples, begin, end, out, n_columns)
        else:
            stored = task.stored[filling.STORED_COLUMNS * chamber :]
            filling.neighbour_samples(row, t, o.c, stored, begin, end, out, task)


@called
def sample_step(r, k, dense, until, theta, task):
    """Write the samples of a step, from its interpolant, up to its fraction theta."""
    samples = task.samples
    i = k.next_sample
    while i < task.n_sample and samples[i] <= until:
        fraction = min(max((samples[i] - r.time) / r.step, 0.0), theta)
        for c in range(task.n_columns):
            task.out[i * task.n_columns + c] = interpolated(fraction, dense, task.columns[c])
        i += 1
    k.next_sample = i

"""Many strokes: eight at a time in lanes, each with its own time, step size and modes.

A lane that is done takes the next stroke. A stroke's result does not depend on its neighbours.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from plant.batch import lane_control
from plant.batch.lane_steps import FREE_OF, MODES_FREE_OF, WIDTH, Lane, lane_of, step_of_lanes
from plant.integrator.filling import FOLLOW_GRID, OWN_STEPS, STORED_ROW, WRITE_GRID
from plant.integrator.loop import DONE, STEPPING, Scratch, Task, scratch_of
from plant.kernel import layout
from plant.kernel.compiled import called, inlined, kernel
from plant.kernel.views import view

ALPHA_V0, FLOW_SIZE = layout.Parameters.fields["alpha_v0"].start, layout.FlowMap.size
NOT_IN_LANES = tuple(layout.Parameters.fields[name].start for name in FREE_OF)
MODES_NOT_IN_LANES = tuple(layout.Modes.fields[name].start for name in MODES_FREE_OF)
COUNTERS, FLAT = lane_control.Memory.size, Lane.size * WIDTH
MOVING_STATES = (layout.FixedState.p_2 + 1, layout.LengthState.impulse + 1)


class Batch(NamedTuple):
    """Arrays of a batch, as those of `plant.batch.batch.Strokes`; an array with one row is shared by all strokes.

    switches [., k, 4] with infinite times behind the last; samples [., s] in s, ascending; columns: states to be
    sampled; scale: typical size of each state.
    """

    packed: Any
    flow: Any
    initial: Any
    modes: Any
    valves: Any
    switches: Any
    duration: Any
    samples: Any
    columns: Any
    scale: Any


class Outcome(NamedTuple):
    """Arrays that a batch writes.

    results [strokes, Result.size]; final [strokes, states]; out [strokes, s, columns]; events [strokes, room, EventRow.size].
    """

    results: Any
    final: Any
    out: Any
    events: Any


class Room(NamedTuple):
    """Memory: flat [FLAT + Scratch.size], counters [Memory.size * WIDTH], grid [steps, GridRow.size], stored [s, STORED_ROW]."""

    flat: Any
    counters: Any
    grid: Any
    stored: Any

    @classmethod
    def of(cls, samples: int, steps: int) -> Room:
        """Return memory for a grid of so many samples and steps."""
        return cls(
            np.zeros(FLAT + Scratch.size),
            np.zeros(lane_control.Memory.size * WIDTH, dtype=np.int64),
            np.zeros((steps, layout.GridRow.size)),
            np.zeros((samples, STORED_ROW)),
        )


def room_for_results(strokes: int, states: int, samples: int, columns: int, events: int) -> Outcome:
    """Return the arrays that a batch of so many strokes writes."""
    return Outcome(
        np.zeros((strokes, lane_control.Result.size)),
        np.zeros((strokes, states)),
        np.zeros((strokes, samples, columns)),
        np.zeros((strokes, events, layout.EventRow.size)),
    )


@inlined
def row_of(array, stroke):
    """View of a stroke's row, of an array with one for each stroke or one for all."""
    return view(array, min(stroke, array.shape[0] - 1) * (array.strides[0] // 8))


@inlined
def task_of(stroke, batch, outcome, room, table, use, steps):
    """Return the task of one stroke of a batch."""
    return Task(
        row_of(batch.switches, stroke), batch.switches.shape[1],
        row_of(batch.samples, stroke), batch.samples.shape[1],
        view(batch.columns, 0), batch.columns.shape[0], row_of(outcome.out, stroke),
        row_of(outcome.events, stroke), outcome.events.shape[1],
        view(table, 0), table.shape[0] > 1,
        view(room.grid, 0), steps, use, view(room.stored, 0), True,
    )  # fmt: skip


@called
def fill_lane(one, stroke, batch, n, first):
    """Copy a stroke's inputs into a lane; the flow map only if it is not the one there."""
    if first or batch.flow.shape[0] != 1:
        copy(one.flow, row_of(batch.flow, stroke), FLOW_SIZE)
    copy(one.parameters, row_of(batch.packed, stroke), lane_control.COPIED)
    put_at_start(one, one.modes, stroke, batch, n)


@inlined
def copy(target, source, count):
    """Copy the first elements of a view."""
    for i in range(count):
        target[i] = source[i]


@inlined
def put_at_start(r, modes, stroke, batch, n):
    """Put the first n states of a stroke, its modes and its valves to time 0."""
    copy(r.y, row_of(batch.initial, stroke), n)
    copy(modes, row_of(batch.modes, stroke), lane_control.MODES)
    copy(r.u0, row_of(batch.valves, stroke), 3)
    for i in range(3):
        r.du[i] = 0.0
    r.time = 0.0
    r.end = row_of(batch.duration, stroke)[0]


@called
def finish(one, k, stroke, status, batch, outcome, n):
    """Write what became of a stroke."""
    result = lane_control.result_of(row_of(outcome.results, stroke))
    result.status = status
    result.events = k.events
    result.steps = k.steps
    initial = row_of(batch.initial, stroke)
    for i in range(outcome.final.shape[1]):
        outcome.final[stroke, i] = one.y[i] if i < n else initial[i]
    for i in range(k.next_sample, batch.samples.shape[1]):
        for c in range(batch.columns.shape[0]):
            outcome.out[stroke, i, c] = outcome.final[stroke, batch.columns[c]]


@called
def run_order(batch, outcome, room, table, order, tolerance, system, pace):
    """Simulate the strokes `order` in lanes, as `run_lanes`; pace: how it uses the grid, and how many steps that holds."""
    use, steps = pace
    n = MOVING_STATES[system]
    # WIDTH; as a variable it keeps the compiler from unrolling the lanes
    width = room.counters.shape[0] // COUNTERS
    fixed = system == layout.FIXED
    f = view(room.flat, 0)
    counters = view(room.counters, 0)
    scratch = scratch_of(f[FLAT:])
    curved = False
    for stroke in order:
        curved = curved or batch.packed[stroke, ALPHA_V0] != 0.0
    for j in range(WIDTH):
        lane_control.memory_of(counters, j).stroke = lane_control.IDLE
        for i in range(n):
            lane_of(f, j).scale[i] = batch.scale[i]
    upcoming = 0
    active = 0
    starting = True
    while starting or active > 0:
        if not starting:
            step_of_lanes(f, fixed, curved, n, tolerance, width)
        for j in range(WIDTH):
            one = lane_of(f, j)
            k = lane_control.memory_of(counters, j)
            if k.stroke == lane_control.IDLE and not starting:
                continue
            o = lane_control.motion_of(one, scratch)
            status = DONE
            if not starting:
                result = lane_control.result_of(row_of(outcome.results, k.stroke))
                task = task_of(k.stroke, batch, outcome, room, table, use, steps)
                status = lane_control.judge(one, k, o, task, result, n)
            while status != STEPPING:
                ended = k.stroke != lane_control.IDLE and (status != DONE or one.time >= one.end)
                if ended:
                    finish(one, k, k.stroke, status, batch, outcome, n)
                    active -= 1
                    k.stroke = lane_control.IDLE
                if k.stroke == lane_control.IDLE:
                    if upcoming >= order.shape[0]:
                        for i in range(n):  # no stroke: steps of no length
                            one.rate_0[i] = 0.0
                        one.accepted = 0.0
                        one.step = 0.0
                        break
                    stroke = order[upcoming]
                    fill_lane(one, stroke, batch, n, starting)
                    lane_control.begin(
                        one, k, o, lane_control.result_of(row_of(outcome.results, stroke))
                    )
                    k.stroke = stroke
                    upcoming += 1
                    active += 1
                result = lane_control.result_of(row_of(outcome.results, k.stroke))
                task = task_of(k.stroke, batch, outcome, room, table, use, steps)
                status = lane_control.prepare(one, k, o, task, result, n)
        starting = False


@kernel
def run_lanes(batch, outcome, room, table, order, tolerance, system, follow):
    """Simulate the strokes `order` (int64, their numbers) of a batch, in lanes.

    table: filling curves of the only flow map, to pass rests in closed form, shorter if there are none; system: FIXED
    or LENGTH; follow: True if the first stroke writes the grid and the others take its steps.
    """
    if not follow:
        run_order(batch, outcome, room, table, order, tolerance, system, (OWN_STEPS, 1))
        return
    longest = room.grid.shape[0]
    run_order(batch, outcome, room, table, order[:1], tolerance, system, (WRITE_GRID, longest))
    steps = min(int(lane_control.result_of(row_of(outcome.results, order[0])).steps), longest)
    run_order(batch, outcome, room, table, order[1:], tolerance, system, (FOLLOW_GRID, steps))


@kernel
def find_covered(packed, modes, covered):
    """Find which strokes the lanes cover, by their parameters and modes -> covered."""
    for i in range(len(covered)):
        covered[i] = True
        for k in NOT_IN_LANES:
            covered[i] = covered[i] and packed[i, k] == 0.0
        for k in MODES_NOT_IN_LANES:
            covered[i] = covered[i] and modes[min(i, len(modes) - 1), k] == 0

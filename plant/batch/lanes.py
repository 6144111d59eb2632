"""Many strokes: eight at a time in lanes, each with its own time, step size and modes.

A lane that is done takes the next stroke.  A stroke's result does not depend on its neighbours.

Checked by: tests/unit/plant/batch/test_batch.py
"""
# mypy: disallow-untyped-defs=False

from __future__ import annotations

import numpy as np

from plant.batch.lane_control import (
    IDLE,
    RESULTS,
    STEPPING,
    begin,
    judge,
    memory_of,
    prepare,
    result_of,
)
from plant.batch.lane_steps import WIDTH, lane_of, step_of_lanes
from plant.integrator.integrate import DONE, EVENT_COLUMNS
from plant.kernel.compiled import kernel
from plant.kernel.layout import FlowMap, Parameters
from plant.kernel.views import view

ALPHA_V0, FLOW_SIZE = Parameters.fields["alpha_v0"].start, FlowMap.size


@kernel
def run_lanes(
    system, n, packed, c, y0, m0, u0, switches, duration, samples, columns, scale, tolerance,
    tabulated, table, order, results, final, out, events, width,
    flat, scratch, memory, grid, steps, use, known,
):  # fmt: skip
    """Simulate the strokes `order` of a batch, in lanes.

    Parameters
    ----------
    system, n : FIXED or LENGTH, and how many leading states move
    packed : float64 [strokes, Parameters.size]
    c, y0, m0, u0, switches, duration, samples : one row a stroke, or one row for all; switches
        [., k, 4] ascending with infinite times behind the last, samples [., s] ascending
    columns : int64, states to be sampled
    tabulated : True if `table` holds the filling curves of c, which then has one row
    order : int64, numbers of the strokes to simulate
    results : float64 [strokes, RESULTS]; final : [strokes, states]; out : [strokes, s, columns];
    events : [strokes, room, EVENT_COLUMNS]
    flat, scratch, memory : float64 [ROWS * WIDTH], [SCRATCH], int64 [MEMORY * WIDTH]
    width : WIDTH; as a variable it keeps the compiler from unrolling the lanes
    grid, steps, use : float64 [steps, GRID_COLUMNS], OWN_STEPS to leave it alone, WRITE_GRID to note
        the steps of the only stroke, FOLLOW_GRID to take those steps whatever the error
    known : float64 [s, KNOWN], as the grid: noted of the samples at rest, and used next to it
    """
    fixed = system == 0
    f = view(flat, 0)
    scratch = view(scratch, 0)
    memory = view(memory, 0)
    states = final.shape[1]
    n_sample = samples.shape[1]
    n_switch = switches.shape[1]
    n_columns = columns.shape[0]
    room = events.shape[1]
    p_view = view(packed, 0)
    c_view = view(c, 0)
    y_view = view(y0, 0)
    m_view = view(m0, 0)
    u_view = view(u0, 0)
    switch_view = view(switches, 0)
    sample_view = view(samples, 0)
    column_view = view(columns, 0)
    table_view = view(table, 0)
    result_view = view(results, 0)
    out_view = view(out, 0)
    event_view = view(events, 0)
    grid_view = view(grid, 0)
    known_view = view(known, 0)
    one_c = c.shape[0] == 1
    one_y = y0.shape[0] == 1
    one_m = m0.shape[0] == 1
    one_u = u0.shape[0] == 1
    one_switch = switches.shape[0] == 1
    one_duration = duration.shape[0] == 1
    one_sample = samples.shape[0] == 1
    curved = False
    for stroke in order:
        curved = curved or packed[stroke, ALPHA_V0] != 0.0
    upcoming = 0
    active = 0
    for j in range(WIDTH):
        memory_of(memory, j).stroke = IDLE
        for k in range(n):
            lane_of(f, j).scale[k] = scale[k]
    status = DONE
    starting = True
    while starting or active > 0:
        if not starting:
            step_of_lanes(f, fixed, curved, n, tolerance, width)
        for j in range(WIDTH):
            one = lane_of(f, j)
            own = memory_of(memory, j)
            stroke = own.stroke
            if stroke == IDLE and not starting:
                continue
            if not starting:
                status = judge(
                    one, n, own,
                    sample_view[0 if one_sample else stroke * n_sample:], n_sample,
                    column_view, n_columns,
                    out_view[stroke * n_sample * n_columns:],
                    event_view[stroke * room * EVENT_COLUMNS:], room,
                    result_of(result_view[stroke * RESULTS:]), scratch, grid_view, steps, use,
                )  # fmt: skip
            fresh = starting
            while status != STEPPING:
                if fresh or status != DONE or one.time >= one.end:
                    if not fresh:
                        result = result_of(result_view[stroke * RESULTS :])
                        result.status = status
                        result.events = own.events
                        result.steps = own.taken
                        result.rejected = own.rejected
                        result.jumps = own.jumps
                        for k in range(n):
                            final[stroke, k] = one.y[k]
                        for k in range(n, states):
                            final[stroke, k] = y0[0 if one_y else stroke, k]
                        for i in range(own.next_sample, n_sample):
                            for k in range(n_columns):
                                out[stroke, i, k] = final[stroke, columns[k]]
                        active -= 1
                        own.stroke = IDLE
                    fresh = False
                    if upcoming >= order.shape[0]:
                        for k in range(n):
                            one.rate_0[k] = 0.0
                        one.accepted = 0.0
                        one.step = 0.0
                        break
                    stroke = order[upcoming]
                    upcoming += 1
                    active += 1
                    own.stroke = stroke
                    row = 0 if one_c else stroke
                    if starting or not one_c:
                        for k in range(FLOW_SIZE):
                            one.flow[k] = c_view[row * FLOW_SIZE + k]
                    begin(
                        one, n, own,
                        p_view[stroke * packed.shape[1]:],
                        y_view[0 if one_y else stroke * y0.shape[1]:],
                        m_view[0 if one_m else stroke * m0.shape[1]:],
                        u_view[0 if one_u else stroke * 3:],
                        duration[0 if one_duration else stroke],
                        scratch,
                    )  # fmt: skip
                    result = result_of(result_view[stroke * RESULTS :])
                    result.arrival = np.nan
                    result.speed = np.nan
                    result.energy = np.nan
                status = prepare(
                    one, fixed, n, own,
                    switch_view[0 if one_switch else stroke * n_switch * 4:], n_switch,
                    sample_view[0 if one_sample else stroke * n_sample:], n_sample,
                    column_view, n_columns,
                    out_view[stroke * n_sample * n_columns:],
                    event_view[stroke * room * EVENT_COLUMNS:], room,
                    result_of(result_view[stroke * RESULTS:]),
                    tabulated, table_view, scratch, grid_view, steps, use, known_view,
                )  # fmt: skip
            status = DONE
        starting = False

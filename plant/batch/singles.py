"""Many strokes, one after the other, by the scalar kernel: for what the lanes do not cover."""

from __future__ import annotations

import numpy as np

from plant.batch.lane_control import result_of, store_arrival
from plant.batch.lanes import copy, put_at_start
from plant.integrator.filling import FOLLOW_GRID, OWN_STEPS, WRITE_GRID
from plant.integrator.integrate import advance
from plant.integrator.loop import Control, Run, control_of, run_of
from plant.kernel.compiled import called, kernel
from plant.kernel.layout import EventRow, event_row, modes
from plant.kernel.packing import FIRST_STEP_S, active_states
from plant.kernel.views import view

RUN, CONTROL, EVENT_COLUMNS = Run.size, Control.size, EventRow.size
EVENT_ROOM = 512
active = called(active_states)


@called
def begin_single(run, control, stroke, batch, tolerance, system):
    """Put a stroke at time 0 into the scalar kernel's memory."""
    r = run_of(run)
    k = control_of(control)
    control[:] = 0
    put_at_start(r, k.modes, stroke, batch, len(batch.scale))
    copy(r.scale, view(batch.scale, 0), len(batch.scale))
    r.tolerance = tolerance
    r.wanted = FIRST_STEP_S
    k.states = active(system, modes(k.modes))
    k.starting = 1


@called
def finish_single(run, control, stroke, status, batch, outcome, record, sampled):
    """Write what became of a stroke."""
    k = control_of(control)
    result = result_of(outcome.results[stroke])
    result.status = status
    result.arrival = np.nan
    result.speed = np.nan
    result.energy = np.nan
    result.events = k.events
    result.steps = k.steps
    for e in range(min(k.events, len(record))):
        if e < outcome.events.shape[1]:
            outcome.events[stroke, e] = record[e]
        row = event_row(record[e])
        store_arrival(row.time, row, result)
    y = run_of(run).y
    for i in range(outcome.final.shape[1]):
        outcome.final[stroke, i] = y[i]
    for i in range(sampled.shape[0]):
        for c in range(len(batch.columns)):
            column = batch.columns[c]
            moves = column < k.states
            outcome.out[stroke, i, c] = sampled[i, column] if moves else y[column]


@called
def run_single(stroke, batch, outcome, room, table, run, control, record):
    """Simulate one stroke; `control` holds how it takes its steps."""
    k = control_of(control)
    switches = batch.switches[min(stroke, batch.switches.shape[0] - 1)]
    count = 0
    while count < switches.shape[0] and switches[count, 0] < np.inf:
        count += 1
    samples = batch.samples[min(stroke, batch.samples.shape[0] - 1)]
    sampled = np.zeros((samples.shape[0], k.states))
    flow = batch.flow[min(stroke, batch.flow.shape[0] - 1)]
    status = advance(
        run, control, batch.packed[stroke], flow, switches[:count], samples, sampled, record, table,
        room.grid,
    )  # fmt: skip
    finish_single(run, control, stroke, status, batch, outcome, record, sampled)


@kernel
def run_singles(batch, outcome, room, table, order, tolerance, system, follow):
    """Simulate the strokes `order` of a batch by the scalar kernel; arguments as of `run_lanes`."""
    run = np.zeros(RUN)
    control = np.zeros(CONTROL, dtype=np.int64)
    record = np.zeros((EVENT_ROOM, EVENT_COLUMNS))
    steps = room.grid.shape[0]
    for number in range(len(order)):
        begin_single(run, control, order[number], batch, tolerance, system)
        k = control_of(control)
        k.use = OWN_STEPS
        if follow:
            k.use = WRITE_GRID if number == 0 else FOLLOW_GRID
        k.grid_steps = steps
        run_single(order[number], batch, outcome, room, table, run, control, record)
        if follow and number == 0:
            steps = min(k.steps, steps)

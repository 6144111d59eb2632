"""Many strokes, one after the other, by the scalar kernel: for what the lanes do not cover.

Checked by: tests/unit/plant/batch/test_batch.py
"""
# mypy: disallow-untyped-defs=False

from __future__ import annotations

import numpy as np

from plant.batch.lane_control import result_of
from plant.integrator.integrate import (
    EVENT_COLUMNS,
    ROW,
    WORKSPACE_ROWS,
    advance,
)
from plant.kernel.compiled import called, kernel
from plant.kernel.layout import Counts
from plant.kernel.packing import active_states
from plant.kernel.record_views import counts_of, event_row, modes

FIRST_STEP = 1e-4
COUNTS = Counts.size
active = called(active_states)


@kernel
def run_singles(
    system, packed, c, y0, m0, u0, switches, duration, samples, columns, scale, tolerance,
    tabulated, table, order, results, final, out, events, grid, steps, use,
):  # fmt: skip
    """Simulate the strokes `order` of a batch by the scalar kernel; arguments as of `run_lanes`."""
    states = final.shape[1]
    n_sample = samples.shape[1]
    room = events.shape[1]
    workspace = np.zeros((WORKSPACE_ROWS, ROW))
    record = np.zeros((512, EVENT_COLUMNS))
    sampled = np.zeros((n_sample, states))
    y = np.zeros(states)
    m = np.zeros(32, dtype=np.int64)
    u = np.zeros(3)
    du = np.zeros(3)
    step = np.zeros(1)
    counts = np.zeros(COUNTS, dtype=np.int64)
    for stroke in order:
        first_y = y0[min(stroke, y0.shape[0] - 1)]
        first_m = m0[min(stroke, m0.shape[0] - 1)]
        first_u = u0[min(stroke, u0.shape[0] - 1)]
        y[:] = first_y[:states]
        m[:] = 0
        m[: len(first_m)] = first_m
        u[:] = first_u
        du[:] = 0.0
        step[0] = FIRST_STEP
        counts[:] = 0
        p = packed[stroke]
        rows = switches[min(stroke, switches.shape[0] - 1)]
        k = 0
        while k < rows.shape[0] and rows[k, 0] < np.inf:
            k += 1
        n = active(system, modes(m))
        for s in range(n, states):
            sampled[:, s] = y[s]
        status = advance(
            duration[min(stroke, duration.shape[0] - 1)],
            y,
            m,
            u,
            du,
            p,
            c[min(stroke, c.shape[0] - 1)],
            scale,
            n,
            0,
            tolerance,
            step,
            rows[:k],
            samples[min(stroke, samples.shape[0] - 1)],
            sampled,
            record,
            counts,
            workspace,
            tabulated,
            table,
            grid,
            steps,
            use,
            True,
        )
        counted = counts_of(counts)
        result = result_of(results[stroke])
        result.status = status
        result.arrival = np.nan
        result.speed = np.nan
        result.energy = np.nan
        result.events = counted.events
        result.steps = counted.steps
        result.rejected = counted.rejected
        result.jumps = 0.0
        for e in range(min(counted.events, record.shape[0])):
            if e < room:
                events[stroke, e] = record[e]
            row = event_row(record[e])
            arrived = row.speed > 0.0 and row.at_block == 0.0
            if arrived and not result.arrival >= 0.0:
                result.arrival = row.time
                result.speed = row.speed
                result.energy = row.lost
        final[stroke] = y
        for i in range(n_sample):
            for s in range(len(columns)):
                out[stroke, i, s] = sampled[i, columns[s]]

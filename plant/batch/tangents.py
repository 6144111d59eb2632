"""How a stroke changes with its parameters: differences along one frozen sequence of steps.

The stroke runs once and notes where its steps end.  The same stroke with a parameter moved by a
tiny amount then takes those very steps, in the lanes where they cover it, without error control, but
locates its own events, resets at its own instants and rests for its own time.  Both are the same
smooth function of the parameter, so the difference quotient carries the events' own motion and is
good to many digits where differences of two free runs would drown in their changing steps.

Checked by: tests/unit/plant/batch/test_tangents.py
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from plant.batch.batch import Strokes, fill_still
from plant.batch.lane_control import Result
from plant.batch.lanes import Batch, Room, room_for_results, run_lanes
from plant.batch.singles import run_singles
from plant.integrator.filling_curves import filling_curves
from plant.kernel.compiled import kernel
from plant.kernel.packing import Floats, scales

MOVE = 1e-6
"""A share of a parameter's size by which a neighbour is moved: truncation and rounding stay small."""


class Followers:
    """A stroke and others next to it along its own steps, again and again at the same instants.

    sample_s : instants [s] in s, ascending
    """

    def __init__(self, sample_s: Floats) -> None:
        self._instants = np.ascontiguousarray(sample_s)[None]
        self._room = Room.of(len(sample_s), steps=4096)

    def run(
        self, strokes: Strokes, columns: Sequence[int], tolerance: float
    ) -> tuple[int, Floats, NDArray[np.bool_]]:
        """Status of the first stroke, samples [n, s, columns] in SI units, and which [n] are alike it.

        The other strokes differ from the first by a share of about `MOVE`.  Those that are alike went
        through the same steps and events; then the difference of their samples, divided by the
        parameter's, is a derivative.  The samples of the others mean nothing.
        """
        n, states = len(strokes), strokes.initial.shape[1]
        covered = strokes.in_lanes
        wanted = np.array(columns, dtype=np.int64)
        batch = Batch._make((*strokes.arrays, self._instants, wanted, scales(strokes.system)))
        outcome = room_for_results(n, states, self._instants.shape[1], len(wanted), 0)
        run = run_lanes if covered[0] else run_singles
        run(
            batch, outcome, self._room, filling_curves(strokes.flow), np.arange(n), tolerance,
            strokes.system, True,
        )  # fmt: skip
        if covered[0]:
            fill_still(outcome.out, strokes, columns, covered)
        same = outcome.results[:, : Result.arrival]  # status, events and steps
        alike = (same == same[0]).all(axis=1) & (covered == covered[0])
        return int(same[0, 0]), outcome.out, alike


@kernel
def to_quotients(samples, steps):
    """Turn samples [n + 1, k] of a stroke and its n neighbours into differences from the first row, by their steps."""
    for i in range(len(steps)):
        per_step = 1.0 / steps[i]
        for k in range(samples.shape[1]):
            samples[i + 1, k] = (samples[i + 1, k] - samples[0, k]) * per_step

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

from plant.batch.batch import (
    BATCH_TOLERANCE,
    LONGEST_GRID,
    BatchResult,
    Strokes,
    covered_by_lanes,
    simulate_batch,
)
from plant.batch.lane_control import Result
from plant.batch.lanes import MOVING, Batch, Room, room_for_results, run_in_lanes
from plant.batch.singles import run_singles
from plant.integrator.filling import filling_curves
from plant.integrator.loop import DONE
from plant.kernel.layout import FIXED, LENGTH
from plant.kernel.packing import Floats, Ints, scales

MOVE = 1e-6
"""A share of a parameter's size by which a neighbour is moved: truncation and rounding stay small."""


def neighbours(
    strokes: Strokes,
    sample_s: Floats,
    columns: Sequence[int] | None = None,
    tolerance: float = BATCH_TOLERANCE,
) -> tuple[BatchResult, NDArray[np.bool_]]:
    """Simulate a stroke and others next to it along its own steps; arguments as `simulate_batch`.

    sample_s: [s] in s, ascending.  The first stroke is the one; the others differ from it by a share of about `MOVE`.  Returns the
    results, and for each stroke whether it went through the same steps and events as the first: then
    the difference of their samples, divided by the parameter's, is a derivative.  The results of
    those that did not mean nothing, nor does any if the lanes do not cover the first.
    """
    result = simulate_batch(
        strokes, sample_s=sample_s, columns=columns, tolerance=tolerance, follow=True
    )
    alike = (
        (result.in_lanes == result.in_lanes[0])
        & (result.status == DONE)
        & (result.steps == result.steps[0])
        & (result.event_count == result.event_count[0])
    )
    return result, alike


class Followers:
    """The same as `neighbours` again and again at the same instants, without making room anew.

    sample_s : instants [s], ascending
    """

    def __init__(self, sample_s: Floats) -> None:
        self._instants = np.ascontiguousarray(sample_s)[None]
        self._room = Room.of(len(sample_s), LONGEST_GRID)
        self._scales = {system: scales(system) for system in (FIXED, LENGTH)}

    def run(
        self,
        system: int,
        packed: Floats,
        flow: Floats,
        initial: Floats,
        driven: tuple[Ints, Floats, Floats, Floats],
        columns: Ints,
        tolerance: float,
    ) -> tuple[int, Floats, NDArray[np.bool_]]:
        """Status of the first stroke, samples [n, s, columns], and which strokes are alike it.

        Arrays as those of `Strokes`; driven: its modes, valves, switches and durations.
        """
        n, states = len(packed), initial.shape[1]
        covered = covered_by_lanes(packed, driven[0])
        lanes = bool(covered[0])
        batch = Batch(packed, flow, initial, *driven, self._instants, columns, self._scales[system])
        found = room_for_results(n, states, self._instants.shape[1], len(columns), 0)
        arguments = (batch, found, self._room, filling_curves(flow), np.arange(n), tolerance)
        if lanes:
            run_in_lanes(*arguments, system, True)
        else:
            run_singles(*arguments, system, True)
        out, results = found.out, Result(found.results)
        if lanes:
            for place, column in enumerate(columns.tolist()):
                if column >= MOVING[system]:  # these states do not move in a lane
                    out[:, :, place] = initial[:, column, None]
        alike = (
            (covered == covered[0])
            & (results.status == DONE)
            & (results.steps == results.steps[0])
            & (results.events == results.events[0])
        )
        return int(results.status[0]), out, alike

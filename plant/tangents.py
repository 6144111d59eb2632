"""How a stroke changes with its parameters: differences along one frozen sequence of steps.

The stroke runs once and notes where its steps end.  The same stroke with a parameter moved by a
tiny amount then takes those very steps in the lanes, without error control, but locates its own
events, resets at its own instants and rests for its own time.  Both are the same smooth function of
the parameter, so the difference quotient carries the events' own motion and is good to many digits
where differences of two free runs would drown in their changing steps.

Checked by: tests/unit/plant/test_tangents.py
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .batch import BATCH_TOLERANCE, BatchResult, Strokes, simulate_batch
from .integrate import DONE
from .lane_control import FOLLOW_GRID, GRID_COLUMNS, WRITE_GRID
from .packing import Floats

LONGEST_GRID = 4096


@dataclass(frozen=True)
class Neighbours:
    """A stroke and its neighbours along the stroke's own steps.

    base: the stroke alone; moved: the neighbours; alike: which of them went through the same steps
    and events, so that their differences from the base are derivatives.  The others' results mean
    nothing.
    """

    base: BatchResult
    moved: BatchResult
    alike: np.ndarray


def neighbours(
    base: Strokes,
    moved: Strokes,
    sample_s: Floats,
    columns: Sequence[int] | None = None,
    tolerance: float = BATCH_TOLERANCE,
) -> Neighbours:
    """Simulate one stroke, and others next to it along its steps; arguments as `simulate_batch`.

    Strokes that the lanes do not cover are not alike; if `base` is one of them, nothing is.
    """
    if len(base) != 1:
        raise ValueError(f"base: {len(base)} strokes; expected one")
    grid = np.zeros((LONGEST_GRID, GRID_COLUMNS))
    first = simulate_batch(
        base, sample_s=sample_s, columns=columns, tolerance=tolerance, grid=grid, use=WRITE_GRID
    )
    steps = int(first.steps[0])
    usable = bool(first.in_lanes[0]) and first.status[0] == DONE and 0 < steps <= LONGEST_GRID
    others = simulate_batch(
        moved,
        sample_s=sample_s,
        columns=columns,
        tolerance=tolerance,
        grid=grid[: max(steps, 1)],
        use=FOLLOW_GRID,
    )
    alike = (
        others.in_lanes
        & (others.status == DONE)
        & (others.steps == steps)
        & (others.event_count == first.event_count[0])
    )
    return Neighbours(first, others, alike & usable)

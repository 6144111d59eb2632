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

import numpy as np
from numpy.typing import NDArray

from .batch import BATCH_TOLERANCE, BatchResult, Strokes, simulate_batch
from .integrate import DONE
from .packing import Floats

MOVE = 1e-6
"""A share of a parameter's size by which a neighbour is moved: truncation and rounding stay small."""


def neighbours(
    strokes: Strokes,
    sample_s: Floats,
    columns: Sequence[int] | None = None,
    tolerance: float = BATCH_TOLERANCE,
) -> tuple[BatchResult, NDArray[np.bool_]]:
    """Simulate a stroke and others next to it along its own steps; arguments as `simulate_batch`.

    The first stroke is the one; the others differ from it by a share of about `MOVE`.  Returns the
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

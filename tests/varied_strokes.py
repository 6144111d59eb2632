"""One stroke with other parameters, many times, for tests and benchmarks of the batch."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from plant.batch.batch import Strokes
from plant.effects.setup import Setup
from plant.kernel.layout import Parameters
from plant.kernel.packing import Floats


def varied_strokes(
    setup: Setup, duration_s: float, changes: Mapping[int, float | Floats]
) -> Strokes:
    """One stroke with packed parameters changed: index in plant.kernel.layout -> values [n]; pressures at its start follow."""
    base = Strokes.from_setups([setup], duration_s)
    n = max((np.size(value) for value in changes.values()), default=1)
    packed = np.repeat(base.packed, n, axis=0)
    for index, value in changes.items():
        packed[:, index] = value
    return replace(base, packed=packed, initial=setup.initial_state(Parameters(packed)))

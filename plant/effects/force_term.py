"""Effects on a body of which only driving force, position and perhaps a pressure are known."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Motion:
    """Samples [n] in which the body moves.

    Force in N, speed in m/s, acceleration in m/s^2, position in m, pressure in Pa (None: not measured), number of the
    time block.
    """

    force_n: Floats
    speed_m_s: Floats
    acceleration_m_s2: Floats
    position_m: Floats
    pressure_pa: Floats | None
    block: NDArray[np.int64]


def no_shape(motion: Motion) -> tuple[float, ...]:
    """Return the one shape of a term that has no shape parameter."""
    return (0.0,)


@dataclass(frozen=True)
class ForceTerm:
    """An effect as a coefficient times a feature of the motion.

    parameter, unit: of the coefficient; feature(motion, shape): [n], force per unit of it; shapes(motion): shape
    parameters to try; sign: +1 if only positive coefficients are physical, 0 if both signs are.
    """

    parameter: str
    unit: str
    what: str
    feature: Callable[[Motion, float], Floats]
    shapes: Callable[[Motion], tuple[float, ...]] = no_shape
    sign: int = 1
    needs_pressure: bool = False

"""Heat exchange: process exponents that follow the piston's speed."""

from __future__ import annotations

from .. import layout as L
from ..setup import Setup
from .effect import Effect, EffectParameter


def alpha_speed(setup: Setup, values: dict[str, float]) -> None:
    """Exponents of the volume term: alpha + slope |v|, towards adiabatic when fast."""
    setup.p[L.ALPHA_SPEED] = values["slope_s_m"]


EFFECTS = (
    Effect(
        "alpha_speed",
        "thermodynamics",
        "chamber",
        "process exponents depend on the piston's speed",
        (EffectParameter("slope_s_m", "s/m", 0.0, -1.0, 2.0, 0.1),),
        alpha_speed,
    ),
)

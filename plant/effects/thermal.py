"""Heat exchange: process exponents that follow the piston's speed."""

from __future__ import annotations

from .. import layout as L
from ..setup import Setup
from .effect import Effect, EffectParameter

SLOPES = (L.ALPHA_SPEED_M1, L.ALPHA_SPEED, L.ALPHA_SPEED_M2, L.ALPHA_SPEED_2)
EXPONENTS = (L.ALPHA_M1, L.ALPHA_1, L.ALPHA_M2, L.ALPHA_2)


def alpha_speed(setup: Setup, values: dict[str, float]) -> None:
    """Exponents alpha + slope |v|.

    form 0: those of the volume terms; 1: all four; 2: all four towards gamma, by
    slope (gamma - alpha) |v|; 3: those of the volume terms towards gamma.
    """
    slope, form = values["slope_s_m"], values["form"]
    for index, exponent in zip(SLOPES, EXPONENTS, strict=True):
        volume = index in (L.ALPHA_SPEED, L.ALPHA_SPEED_2)
        if form in (0.0, 3.0) and not volume:
            continue
        towards = setup.p[L.GAMMA] - setup.p[exponent] if form >= 2.0 else 1.0
        setup.p[index] = slope * towards


EFFECTS = (
    Effect(
        "alpha_speed",
        "thermodynamics",
        "chamber",
        "process exponents depend on the piston's speed",
        (
            EffectParameter("slope_s_m", "s/m", 0.0, -5.0, 10.0, 0.1),
            EffectParameter("form", "-", 0.0, 0.0, 3.0, 1.0, optional=True),
        ),
        alpha_speed,
    ),
)

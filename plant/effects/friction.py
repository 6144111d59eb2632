"""Friction of stay and pistons: levels, Stribeck fall, direction, position, pressure."""

from __future__ import annotations

from plant.effects.effect import Effect, EffectParameter
from plant.effects.setup import Setup
from plant.kernel import layout as L


def scale_running(setup: Setup, values: dict[str, float]) -> None:
    """Coulomb and viscous level times a factor, on stay and pistons (not the truck's linkage)."""
    for index in (L.F_RUN_S, L.BETA_S, L.F_RUN_P, L.BETA_P):
        setup.p[index] *= values["factor"]


def scale_static(setup: Setup, values: dict[str, float]) -> None:
    """Breakaway force times a factor."""
    for index in (L.F_STATIC_S, L.F_STATIC_P):
        setup.p[index] *= values["factor"]


def stribeck(setup: Setup, values: dict[str, float]) -> None:
    """Sliding friction falls from the static level over a speed: exp(-|v|/v_s)."""
    setup.p[L.STRIBECK_V] = values["speed_m_s"]


def asymmetry(setup: Setup, values: dict[str, float]) -> None:
    """Friction times 1 + a towards + (backward, extension), 1 - a towards -."""
    setup.p[L.ASYMMETRY] = values["asymmetry"]


def bump(setup: Setup, values: dict[str, float]) -> None:
    """Drag force_n exp(-(x - x0)^2 / (2 w^2)) on the stay; mirrored 1: at x0 on both sides."""
    place = values["position_m"]
    if values["mirrored"] == 1.0 and setup.conditions.kind in ("N-F", "F-N"):
        place = -place
    setup.p[L.BUMP_FORCE] = values["force_n"]
    setup.p[L.BUMP_X] = place
    setup.p[L.BUMP_WIDTH] = values["width_m"]


def seal(setup: Setup, values: dict[str, float]) -> None:
    """Friction mu |dP| A on a piston with the pressure difference dP across it.

    A is the piston's larger face (face 0) or its smaller one (1): they differ on the fixed rig.
    """
    share = 1.0
    if values["face"] == 1.0 and setup.conditions.system == L.FIXED:
        share = setup.p[L.AREA_P2] / setup.p[L.AREA_P]
    setup.p[L.SEAL_MU] = values["mu"] * share


EFFECTS = (
    Effect(
        "dynamic_friction",
        "friction",
        "force",
        "sliding friction (Coulomb and viscous) times a factor",
        (EffectParameter("factor", "-", 1.0, 0.2, 10.0, 0.5, 1),),
        scale_running,
    ),
    Effect(
        "static_friction",
        "friction",
        "force",
        "breakaway force times a factor, sliding friction as it was",
        (EffectParameter("factor", "-", 1.0, 0.2, 10.0, 0.5, 1),),
        scale_static,
    ),
    Effect(
        "stribeck",
        "friction",
        "force",
        "sliding friction falls from the static to the Coulomb level over a speed",
        (EffectParameter("speed_m_s", "m/s", 0.0, 0.0, 5.0, 0.1, 1),),
        stribeck,
    ),
    Effect(
        "friction_asymmetry",
        "friction",
        "force",
        "more friction in one direction than in the other",
        (EffectParameter("asymmetry", "-", 0.0, -0.95, 0.95, 0.3),),
        asymmetry,
    ),
    Effect(
        "friction_bump",
        "friction",
        "force",
        "local drag around one position of the stay",
        (
            EffectParameter("force_n", "N", 0.0, 0.0, 5000.0, 100.0, 1),
            EffectParameter("position_m", "m", 0.006, -0.02, 0.02, 0.002),
            EffectParameter("width_m", "m", 0.001, 1e-4, 0.01, 0.001),
            EffectParameter("mirrored", "-", 0.0, 0.0, 1.0, 1.0, optional=True),
        ),
        bump,
    ),
    Effect(
        "seal_pressure_friction",
        "friction",
        "force",
        "seal friction grows with the pressure difference across the piston",
        (
            EffectParameter("mu", "-", 0.0, 0.0, 0.9, 0.05, 1),
            EffectParameter("face", "-", 0.0, 0.0, 1.0, 1.0, optional=True),
        ),
        seal,
    ),
)

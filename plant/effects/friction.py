"""Friction of stay and pistons: levels, Stribeck fall, direction, position, pressure."""

from __future__ import annotations

import numpy as np

from plant.effects.effect import EffectParameter, Variant, choice, effect
from plant.effects.force_term import Floats, ForceTerm, Motion
from plant.effects.setup import Setup
from plant.kernel.layout import FIXED, Parameters

FACTOR = EffectParameter("factor", "-", 1.0, 0.2, 10.0, 0.5, 1)


@effect(
    "dynamic_friction",
    "friction",
    "force",
    "sliding friction (Coulomb and viscous) times a factor",
    FACTOR,
    tolerance="friction",
    look_alikes=("static_friction", "stribeck", "seal_pressure_friction", "added_mass"),
    sentence="Sliding friction is {}",
    noun="friction",
)
def scale_running(setup: Setup, values: dict[str, float]) -> None:
    """Coulomb and viscous level times a factor, on stay and pistons (not the truck's linkage)."""
    for index in (Parameters.f_run_s, Parameters.beta_s, Parameters.f_run_p, Parameters.beta_p):
        setup.p[index] *= values["factor"]


@effect(
    "static_friction",
    "friction",
    "force",
    "breakaway force times a factor, sliding friction as it was",
    FACTOR,
    tolerance="friction",
    look_alikes=("stribeck", "valve_open_delay"),
    sentence="Breakaway friction is {}",
)
def scale_static(setup: Setup, values: dict[str, float]) -> None:
    """Breakaway force times a factor."""
    for index in (Parameters.f_static_s, Parameters.f_static_p):
        setup.p[index] *= values["factor"]


def stribeck_feature(motion: Motion, shape: float) -> Floats:
    """Return sgn(v) exp(-|v| / v_s) [n], no unit."""
    return np.asarray(np.sign(motion.speed_m_s) * np.exp(-np.abs(motion.speed_m_s) / shape))


def stribeck_speeds(motion: Motion) -> tuple[float, ...]:
    """Return the speeds v_s to try [m/s]: shares of the fastest motion."""
    fast = float(np.quantile(np.abs(motion.speed_m_s), 0.99))
    return tuple(fast * share for share in (0.05, 0.1, 0.2, 0.4))


@effect(
    "stribeck",
    "friction",
    "force",
    "sliding friction falls from the static to the Coulomb level over a speed",
    EffectParameter("speed_m_s", "m/s", 0.0, 0.0, 5.0, 0.1, 1),
    force=ForceTerm(
        "force_n",
        "N",
        "sliding friction falls from a higher level over a speed",
        stribeck_feature,
        stribeck_speeds,
    ),
)
def stribeck(setup: Setup, values: dict[str, float]) -> None:
    """Sliding friction falls from the static level over a speed: exp(-|v|/v_s)."""
    setup.p.stribeck_v = values["speed_m_s"]


@effect(
    "friction_asymmetry",
    "friction",
    "force",
    "more friction in one direction than in the other",
    EffectParameter("asymmetry", "-", 0.0, -0.95, 0.95, 0.3),
    choice("linkage", "-", 0.0, 0.0, 1.0),
    variants=(Variant(), Variant("of the linkage", {"linkage": 1.0}, needs=("truck",))),
    look_alikes=("external_force",),
    force=ForceTerm(
        "viscous_n_s_m",
        "N s/m",
        "friction grows with speed more in one direction than in the other",
        lambda motion, _shape: np.abs(motion.speed_m_s),
        sign=0,
    ),
    sentence="Friction differs with direction by {}",
    noun="friction that differs with direction",
)
def asymmetry(setup: Setup, values: dict[str, float]) -> None:
    """Friction times 1 + a towards + (backward, extension), 1 - a towards -.

    That of stay and pistons or, linkage 1, of a gearbox's linkage: that does not depend on the speed,
    so more of it in one direction is a constant force, and is modelled as one.
    """
    if values["linkage"] == 1.0:
        setup.p.f_external -= values["asymmetry"] * setup.p.f_linkage
    else:
        setup.p.asymmetry = values["asymmetry"]


SPOTS_M = (0.003, 0.0065, 0.010)
"""Where a search looks for a local drag first: three positions on either side."""


def bump_feature(motion: Motion, shape: float) -> Floats:
    """Return sgn(v) exp(-(x - x0)^2 / (2 w^2)) [n], no unit, w a twelfth of the travel."""
    low, high = np.quantile(motion.position_m, (0.05, 0.95))
    return np.asarray(
        np.sign(motion.speed_m_s)
        * np.exp(-0.5 * ((motion.position_m - shape) / (0.08 * (high - low))) ** 2)
    )


def bump_positions(motion: Motion) -> tuple[float, ...]:
    """Return nine positions x0 to try, over the travel [m]."""
    low, high = np.quantile(motion.position_m, (0.05, 0.95))
    return tuple(np.linspace(low, high, 9))


@effect(
    "friction_bump",
    "friction",
    "force",
    "local drag around one position of the stay",
    EffectParameter("force_n", "N", 0.0, 0.0, 5000.0, 100.0, 1),
    EffectParameter("position_m", "m", 0.006, -0.02, 0.02, 0.002),
    EffectParameter("width_m", "m", 0.001, 1e-4, 0.01, 0.001),
    choice("mirrored", "-", 0.0, 0.0, 1.0),
    scope=lambda values: "stroke" if values.get("mirrored") == 1.0 else "unit",
    variants=(
        Variant(starts=tuple((30.0, s * x, 0.0012) for s in (1.0, -1.0) for x in SPOTS_M)),
        Variant(
            "both sides",
            {"mirrored": 1.0},
            tuple((30.0, x, 0.0012) for x in SPOTS_M),
            ("length stroke",),
        ),
    ),
    rugged=True,
    look_alikes=("detent",),
    force=ForceTerm("force_n", "N", "local drag around one position", bump_feature, bump_positions),
)
def bump(setup: Setup, values: dict[str, float]) -> None:
    """Drag force_n exp(-(x - x0)^2 / (2 w^2)) on the stay; mirrored 1: at x0 on both sides."""
    position = values["position_m"]
    if values["mirrored"] == 1.0 and setup.conditions.kind in ("N-F", "F-N"):
        position = -position
    setup.p.bump_force = values["force_n"]
    setup.p.bump_x = position
    setup.p.bump_width = values["width_m"]


def seal_feature(motion: Motion, shape: float) -> Floats:
    """Return sgn(v) |P| [n] in Pa. Raises ValueError without a pressure."""
    if motion.pressure_pa is None:
        raise ValueError("no pressure; expected a motion with a pressure")
    return np.asarray(np.sign(motion.speed_m_s) * np.abs(motion.pressure_pa))


@effect(
    "seal_pressure_friction",
    "friction",
    "force",
    "seal friction grows with the pressure difference across the piston",
    EffectParameter("mu", "-", 0.0, 0.0, 0.9, 0.05, 1),
    choice("face", "-", 0.0, 0.0, 1.0),
    variants=(Variant(), Variant("smaller face", {"face": 1.0})),
    force=ForceTerm(
        "friction_n_pa",
        "N/Pa",
        "friction grows with the pressure across the piston",
        seal_feature,
        needs_pressure=True,
    ),
)
def seal(setup: Setup, values: dict[str, float]) -> None:
    """Friction mu |dP| A on a piston with the pressure difference dP across it.

    A is the piston's larger face (face 0) or its smaller one (1): they differ on the fixed rig.
    """
    share = 1.0
    if values["face"] == 1.0 and setup.conditions.system == FIXED:
        share = setup.p.area_p2 / setup.p.area_p
    setup.p.seal_mu = values["mu"] * share

"""Mechanics of the stay: free play, stops, mass, forces."""

from __future__ import annotations

from plant.effects.effect import Effect, EffectParameter
from plant.effects.setup import Setup
from plant.kernel import layout as L


def free_play(setup: Setup, values: dict[str, float]) -> None:
    """Free travel of the pistons on the stay longer or shorter (length stroke)."""
    setup.p[L.X_FREE] += values["travel_m"]


def stop_wear(setup: Setup, values: dict[str, float]) -> None:
    """The engaged end stop has moved outward."""
    setup.p[L.STOP_OFFSET] += values["offset_m"]


def added_mass(setup: Setup, values: dict[str, float]) -> None:
    """More inertia on the stay."""
    setup.p[L.M_S] += values["mass_kg"]


def external(setup: Setup, values: dict[str, float]) -> None:
    """Constant force on the stay, towards + (backward, extension)."""
    setup.p[L.F_EXTERNAL] += values["force_n"]


def detent(setup: Setup, values: dict[str, float]) -> None:
    """Ball and spring pulling into rest and engaged positions: -F sin(pi d / w), |d| < w."""
    setup.p[L.DETENT_FORCE] += values["force_n"]
    setup.p[L.DETENT_WIDTH] = values["width_m"]


def bounce(setup: Setup, values: dict[str, float]) -> None:
    """Stops rebound with this coefficient of restitution."""
    setup.p[L.RESTITUTION] = values["restitution"]


EFFECTS = (
    Effect(
        "free_play",
        "mechanics",
        "geometry",
        "free travel of the piston on the stay longer or shorter",
        (EffectParameter("travel_m", "m", 0.0, -0.012, 0.02, 0.001),),
        free_play,
    ),
    Effect(
        "stop_wear",
        "mechanics",
        "geometry",
        "the engaged end stop has moved",
        (EffectParameter("offset_m", "m", 0.0, -0.005, 0.005, 0.0003),),
        stop_wear,
    ),
    Effect(
        "added_mass",
        "mechanics",
        "force",
        "more inertia on the stay",
        (EffectParameter("mass_kg", "kg", 0.0, -0.8, 50.0, 0.5, 1),),
        added_mass,
    ),
    Effect(
        "external_force",
        "mechanics",
        "force",
        "constant force on the stay",
        (EffectParameter("force_n", "N", 0.0, -2000.0, 2000.0, 50.0),),
        external,
    ),
    Effect(
        "detent",
        "mechanics",
        "force",
        "ball-spring detent at rest and engaged positions",
        (
            EffectParameter("force_n", "N", 0.0, 0.0, 3000.0, 100.0, 1),
            EffectParameter("width_m", "m", 0.002, 2e-4, 0.006, 0.002),
        ),
        detent,
    ),
    Effect(
        "end_stop_bounce",
        "mechanics",
        "force",
        "stops rebound",
        (EffectParameter("restitution", "-", 0.0, 0.0, 0.95, 0.3, 1),),
        bounce,
    ),
)

"""Mechanics of the stay: free play, stops, mass, forces."""

from __future__ import annotations

from plant.effects.effect import EffectParameter, effect
from plant.effects.setup import Setup


@effect(
    "free_play",
    "mechanics",
    "geometry",
    "free travel of the piston on the stay longer or shorter",
    EffectParameter("travel_m", "m", 0.0, -0.012, 0.02, 0.001),
    needs=("length stroke",),
    look_alikes=("stop_wear", "dead_volume_charge"),
    sentence="The free travel on the stay is changed by {}",
)
def free_play(setup: Setup, values: dict[str, float]) -> None:
    """Free travel of the pistons on the stay longer or shorter (length stroke)."""
    setup.p.x_free += values["travel_m"]


@effect(
    "stop_wear",
    "mechanics",
    "geometry",
    "the engaged end stop has moved",
    EffectParameter("offset_m", "m", 0.0, -0.005, 0.005, 0.0003),
    look_alikes=("end_stop_bounce", "sensor_gain"),
    sentence="The engaged end stop has moved by {}",
)
def stop_wear(setup: Setup, values: dict[str, float]) -> None:
    """Move the engaged end stop outward."""
    setup.p.stop_offset += values["offset_m"]


@effect(
    "added_mass",
    "mechanics",
    "force",
    "more inertia on the stay",
    EffectParameter("mass_kg", "kg", 0.0, -0.8, 50.0, 0.5, 1),
    look_alikes=("external_force",),
    sentence="The stay carries {} more mass",
)
def added_mass(setup: Setup, values: dict[str, float]) -> None:
    """More inertia on the stay."""
    setup.p.m_s += values["mass_kg"]


@effect(
    "external_force",
    "mechanics",
    "force",
    "constant force on the stay",
    EffectParameter("force_n", "N", 0.0, -2000.0, 2000.0, 50.0),
    sentence="A constant force of {} acts on the stay",
)
def external(setup: Setup, values: dict[str, float]) -> None:
    """Constant force on the stay, towards + (backward, extension)."""
    setup.p.f_external += values["force_n"]


@effect(
    "detent",
    "mechanics",
    "force",
    "ball-spring detent at rest and engaged positions",
    EffectParameter("force_n", "N", 0.0, 0.0, 3000.0, 100.0, 1),
    EffectParameter("width_m", "m", 0.002, 2e-4, 0.006, 0.002),
    look_alikes=("external_force",),
)
def detent(setup: Setup, values: dict[str, float]) -> None:
    """Ball and spring pulling into rest and engaged positions: -F sin(pi d / w), |d| < w."""
    setup.p.detent_force += values["force_n"]
    setup.p.detent_width = values["width_m"]


@effect(
    "end_stop_bounce",
    "mechanics",
    "force",
    "stops rebound",
    EffectParameter("restitution", "-", 0.0, 0.0, 0.95, 0.3, 1),
)
def bounce(setup: Setup, values: dict[str, float]) -> None:
    """Let stops rebound with this coefficient of restitution."""
    setup.p.restitution = values["restitution"]

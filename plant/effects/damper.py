"""The oil damper: free air, a clogged outlet, misalignment."""

from __future__ import annotations

from plant.effects.effect import EffectParameter, effect
from plant.effects.setup import Setup


@effect(
    "oil_aeration",
    "damper",
    "damper",
    "more air in the oil",
    EffectParameter("air_fraction", "-", 0.0, 0.0, 0.5, 0.01, 1),
    needs=("damper",),
    look_alikes=("damper_clog",),
    sentence="The oil holds {} of air more",
)
def aeration(setup: Setup, values: dict[str, float]) -> None:
    """More free air: 1/kappa + air P_atm / P^2."""
    setup.p.air_fraction = values["air_fraction"]


@effect(
    "damper_clog",
    "damper",
    "damper",
    "small outlet of the damper reduced",
    EffectParameter("factor", "-", 1.0, 0.05, 3.0, 0.2, -1),
    needs=("damper",),
    look_alikes=("damper_misalignment",),
    sentence="The damper's small outlet is {}",
)
def clog(setup: Setup, values: dict[str, float]) -> None:
    """Small outlet times a factor."""
    setup.p.a_small *= values["factor"]


@effect(
    "damper_misalignment",
    "damper",
    "force",
    "extra friction with the damper mounted",
    EffectParameter("force_n", "N", 0.0, 0.0, 2000.0, 50.0, 1),
    needs=("damper",),
    look_alikes=("dynamic_friction",),
    sentence="The damper adds {} of friction",
)
def misalignment(setup: Setup, values: dict[str, float]) -> None:
    """Extra friction of the stay while the damper is mounted."""
    if setup.conditions.load == "damper":
        setup.p.damper_drag += values["force_n"]

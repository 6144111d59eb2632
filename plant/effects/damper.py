"""The oil damper: free air, a clogged outlet, misalignment."""

from __future__ import annotations

from plant.effects.effect import Effect, EffectParameter
from plant.effects.setup import Setup
from plant.kernel import layout as L


def aeration(setup: Setup, values: dict[str, float]) -> None:
    """More free air: 1/kappa + air P_atm / P^2."""
    setup.p[L.AIR_FRACTION] = values["air_fraction"]


def clog(setup: Setup, values: dict[str, float]) -> None:
    """Small outlet times a factor."""
    setup.p[L.A_SMALL] *= values["factor"]


def misalignment(setup: Setup, values: dict[str, float]) -> None:
    """Extra friction of the stay while the damper is mounted."""
    if setup.conditions.load == "damper":
        setup.p[L.DAMPER_DRAG] += values["force_n"]


EFFECTS = (
    Effect(
        "oil_aeration",
        "damper",
        "damper",
        "more air in the oil",
        (EffectParameter("air_fraction", "-", 0.0, 0.0, 0.5, 0.01, 1),),
        aeration,
        needs_damper=True,
    ),
    Effect(
        "damper_clog",
        "damper",
        "damper",
        "small outlet of the damper reduced",
        (EffectParameter("factor", "-", 1.0, 0.05, 3.0, 0.2, -1),),
        clog,
        needs_damper=True,
    ),
    Effect(
        "damper_misalignment",
        "damper",
        "force",
        "extra friction with the damper mounted",
        (EffectParameter("force_n", "N", 0.0, 0.0, 2000.0, 50.0, 1),),
        misalignment,
        needs_damper=True,
    ),
)

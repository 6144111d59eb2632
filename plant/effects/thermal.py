"""Heat exchange: process exponents that follow the piston's speed."""

from __future__ import annotations

from itertools import product

from plant.effects.effect import EffectParameter, Variant, choice, effect
from plant.effects.setup import Setup
from plant.kernel.layout import Parameters


@effect(
    "alpha_speed",
    "thermodynamics",
    "chamber",
    "process exponents depend on the piston's speed",
    EffectParameter("share", "-", 0.0, -1.0, 1.0, 0.1),
    EffectParameter("speed_m_s", "m/s", 0.3, 0.001, 20.0, 0.3, optional=True),
    choice("form", "-", 0.0, 0.0, 5.0),
    needs=("process exponents",),
    variants=tuple(
        Variant(
            name,
            {"form": float(form)} if form else {},
            tuple(product((0.02, 0.2, -0.02, -0.2), (0.05, 0.5))),
        )
        for form, name in enumerate(
            (
                "",
                "all exponents",
                "towards adiabatic",
                "all towards adiabatic",
                "isothermal at rest",
                "all isothermal at rest",
            )
        )
    ),
)
def alpha_speed(setup: Setup, values: dict[str, float]) -> None:
    """Exponents alpha + share f(|v|), f = 1 - exp(-|v| / speed): slow motion is less adiabatic.

    form 0: those of the volume terms; 1: all four; 2: those of the volume terms towards gamma, by
    share (gamma - alpha) f; 3: all four towards gamma; 4, 5: those of the volume terms, all four,
    towards 1 at rest: alpha + share (1 - alpha) (1 - f).
    """
    form = values["form"]
    speed = max(values["speed_m_s"], 1e-3)
    setup.p.alpha_v0 = speed
    slopes_of_volume = (
        (Parameters.alpha_speed, Parameters.alpha_1),
        (Parameters.alpha_speed_2, Parameters.alpha_2),
    )
    slopes_of_mass = (
        (Parameters.alpha_speed_m1, Parameters.alpha_m1),
        (Parameters.alpha_speed_m2, Parameters.alpha_m2),
    )
    slopes = slopes_of_volume if form in (0.0, 2.0, 4.0) else slopes_of_mass + slopes_of_volume
    for index, exponent in slopes:
        towards = 1.0
        if form >= 4.0:
            towards = setup.p[exponent] - 1.0
            setup.p[exponent] -= values["share"] * towards
        elif form >= 2.0:
            towards = setup.p.gamma - setup.p[exponent]
        setup.p[index] = values["share"] * towards / speed

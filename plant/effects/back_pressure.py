"""Back pressure: the valves discharge into a manifold or a silencer instead of the open air."""

from __future__ import annotations

from plant.effects.effect import EffectParameter, effect
from plant.effects.setup import Setup
from plant.kernel.layout import FIXED


@effect(
    "back_pressure",
    "flow restriction",
    "chamber",
    "the valves discharge against a pressure above the atmosphere's",
    EffectParameter("pressure_pa", "Pa", 0.0, 0.0, 2e5, 1e4, 1),
    look_alikes=("exhaust_clog", "residual_pressure"),
    sentence="The valves discharge against {} above atmosphere",
)
def back_pressure(setup: Setup, values: dict[str, float]) -> None:
    """Pressure behind all outlets above the atmosphere's, which acts on the rod as before."""
    setup.p.p_atm += values["pressure_pa"]
    if setup.conditions.system == FIXED:
        setup.p.f_external += values["pressure_pa"] * setup.p.area_s

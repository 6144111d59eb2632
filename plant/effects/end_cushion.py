"""An elastic cushion in front of the end stops, a rubber bumper say."""

from __future__ import annotations

from plant.effects.added_term import Slot, added_term
from plant.effects.effect import EffectParameter, effect
from plant.effects.setup import Setup


@added_term(Slot.FORCE)
def cushion(position_m: float, stiffness_n_m: float, from_m: float) -> float:
    """Return the force of the cushions at both ends on the stay [N]."""
    if position_m > from_m:
        return stiffness_n_m * (from_m - position_m)
    if position_m < -from_m:
        return -stiffness_n_m * (from_m + position_m)
    return 0.0


@effect(
    "end_cushion",
    "mechanics",
    "force",
    "an elastic cushion in front of the end stops",
    EffectParameter("stiffness_n_m", "N/m", 0.0, 0.0, 2e6, 3e4, 1),
    EffectParameter("thickness_m", "m", 0.002, 2e-4, 0.008, 0.001),
    look_alikes=("detent", "stop_wear", "end_stop_bounce"),
)
def end_cushion(setup: Setup, values: dict[str, float]) -> None:
    """Force -k (|x| - (stroke - thickness)) towards the middle, in the last part of the travel."""
    from_m = setup.p.stroke - values["thickness_m"]
    cushion.add_to(setup, stiffness_n_m=values["stiffness_n_m"], from_m=from_m)

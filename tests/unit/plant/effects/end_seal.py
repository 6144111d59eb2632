"""A spring-loaded seal that sticks at the end of the stroke."""

from math import exp

from plant.effects.added_term import Slot, added_term
from plant.effects.effect import EffectParameter, effect


@added_term(Slot.RESISTANCE)
def grip(position_m, force_n, length_m, end_m):
    """Return the grip of the seal: force_n at the end of the travel, less before it [N]."""
    left_m = max(end_m - abs(position_m), 0.0)
    return force_n * exp(-left_m / length_m)


@effect(
    "end_seal",
    "friction",
    "force",
    "a spring-loaded seal grips the stay near the end of the stroke",
    EffectParameter("force_n", "N", neutral=0.0, low=0.0, high=2000.0, typical=50.0, sign=1),
    EffectParameter("length_m", "m", neutral=0.002, low=2e-4, high=0.01, typical=0.001),
    look_alikes=("friction_bump", "static_friction"),
)
def end_seal(setup, values):
    """Resistance force_n exp(-d / length_m) at a distance d from the end of the travel."""
    grip.add_to(setup, **values, end_m=setup.p.stroke)

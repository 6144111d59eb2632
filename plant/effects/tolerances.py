"""Quantities in which healthy units, and healthy strokes, differ: how a setup follows them.

Checked by: tests/unit/sil/fitting/test_fit.py
"""

from __future__ import annotations

import math
from dataclasses import replace

from plant.devices.valve import seconds_to_ns
from plant.effects.setup import Setup
from plant.kernel import layout as L

FACTORS: dict[str, tuple[int, ...]] = {
    "friction": (L.F_STATIC_S, L.F_RUN_S, L.BETA_S, L.F_STATIC_P, L.F_RUN_P, L.BETA_P),
    "supply": (L.P_SUPPLY,),
    "flow_in": (L.K_IN,),
    "flow_out": (L.K_OUT,),
    "volume_a": (L.VOL_B, L.VOL_F),
    "volume_b": (L.VOL_N,),
}
"""Quantities that differ by a factor, and the parameters that it scales."""


def shift(setup: Setup, name: str, amount: float) -> None:
    """Change one quantity of a setup: times exp(amount), or by seconds for "rise" and "fall".

    Relative amounts add up in logarithms, as those of effects that scale the same do.
    """
    if name == "rise":
        shift_rise(setup, amount)
    elif name == "fall":
        shift_fall(setup, amount)
    else:
        factor = math.exp(amount)
        for index in FACTORS[name]:
            setup.p[index] *= factor


def shift_rise(setup: Setup, delay_s: float) -> None:
    """Change the opening delay, never below zero."""
    rise = max(0, setup.timing.rise_ns + seconds_to_ns(delay_s))
    setup.timing = replace(setup.timing, rise_ns=rise)


def shift_fall(setup: Setup, delay_s: float) -> None:
    """Change the closing delay, never below zero."""
    fall = max(0, setup.timing.fall_ns + seconds_to_ns(delay_s))
    setup.timing = replace(setup.timing, fall_ns=fall)

"""Quantities in which healthy units, and healthy strokes, differ: how a setup follows them."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache
from statistics import NormalDist

from plant.devices.valve import ValveTiming, seconds_to_ns
from plant.effects.setup import Setup
from plant.kernel.layout import Parameters

FACTORS: dict[str, tuple[int, ...]] = {
    "friction": (
        Parameters.f_static_s,
        Parameters.f_run_s,
        Parameters.beta_s,
        Parameters.f_static_p,
        Parameters.f_run_p,
        Parameters.beta_p,
    ),
    "supply": (Parameters.p_supply,),
    "flow_in": (Parameters.k_in,),
    "flow_out": (Parameters.k_out,),
    "volume_a": (Parameters.vol_b, Parameters.vol_f),
    "volume_b": (Parameters.vol_n,),
    "breakaway": (Parameters.f_static_s,),
    "viscous": (Parameters.beta_s,),
    "mass": (Parameters.m_s,),
    "spring": (Parameters.spring_k, Parameters.f_external),
    "wall_heat": (Parameters.wall_heat,),
}
"""Quantities that differ by a factor, and the parameters that it scales."""


def shift(setup: Setup, name: str, amount: float) -> None:
    """Change one quantity of a setup: times exp(amount), delays and "gauge_lag" by seconds, "wall_density" by itself.

    Relative amounts add up in logarithms. What is limited moves by standard deviations of a normal distribution that
    the limits map to its tails, so that a fit of it has no bounds.
    """
    limited = {
        "critical": (Parameters.valve_b, 0.1, 0.58),
        "kappa": (Parameters.air_kappa, 1.0, 1.45),
        "wall_ends": (Parameters.wall_ends, 0.0, 2.0),
    }
    if name in ("rise", "fall"):
        shift_delay(setup, name, amount)
    elif name == "gauge_lag":
        setup.gauge_lag_s = max(0.0, setup.gauge_lag_s + amount)
    elif name == "wall_density":
        setup.p.wall_density = max(0.0, setup.p.wall_density + amount)
    elif name in limited:
        index, low, high = limited[name]
        share = (setup.p[index] - low) / (high - low)
        normal = NormalDist()
        place = normal.inv_cdf(min(max(share, 1e-6), 1.0 - 1e-6)) + amount
        setup.p[index] = low + (high - low) * normal.cdf(place)
    elif name == "volume_b" and setup.p.air_kappa > 0.0:
        # of a cylinder's volume at the retracted end, what the piston does not sweep
        swept = setup.p.area_p2 * setup.p.stroke
        setup.p.vol_n = swept + (setup.p.vol_n - swept) * math.exp(amount)
    else:
        factor = math.exp(amount)
        values = setup.p.array.T
        for index in FACTORS[name]:
            values[index] *= factor


def shift_delay(setup: Setup, edge: str, delay_s: float) -> None:
    """Change the delay of opening ("rise") or closing ("fall"), never below zero."""
    name = f"{edge}_ns"
    delay_ns = max(0, getattr(setup.timing, name) + seconds_to_ns(delay_s))
    setup.timing = _delayed(setup.timing, name, delay_ns)


@lru_cache(maxsize=1024)
def _delayed(timing: ValveTiming, name: str, ns: int) -> ValveTiming:
    # a fit asks for the same delays again with every other quantity it moves
    return replace(timing, rise_ns=ns) if name == "rise_ns" else replace(timing, fall_ns=ns)

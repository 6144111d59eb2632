"""What differs between healthy units and healthy strokes: tolerances and scatter, with priors.

Every quantity is counted in its prior standard deviations (`[repeatability]` of the parameter
set), so that each has a standard normal prior.  None of this is a fault.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from plant import layout as L
from plant.parameters import ParameterSet
from plant.setup import Setup
from plant.valve import seconds_to_ns

# What a run of the kernel must be repeated for, in this order.
SIMULATED = ("friction", "rise", "fall", "supply", "flow_in", "flow_out", "volume_a", "volume_b")


@dataclass(frozen=True)
class Spread:
    """Standard deviations of the healthy scatter: of units (campaigns) and of strokes."""

    unit: dict[str, float]
    stroke: dict[str, float]
    position_offset_m: float
    gauge_offset_pa: float
    oil_gauge_offset_pa: float

    @classmethod
    def of(cls, parameters: ParameterSet) -> Spread:
        """The spread of a parameter set's section `repeatability`."""
        value = parameters.value
        delay = value("repeatability.unit_valve_delay_sd")
        return cls(
            unit={
                "friction": value("repeatability.unit_friction_sd"),
                "rise": delay,
                "fall": 3.0 * delay,
                "flow_in": value("repeatability.unit_flow_sd"),
                "flow_out": value("repeatability.unit_flow_sd"),
                "volume_a": value("repeatability.unit_volume_sd"),
                "volume_b": value("repeatability.unit_volume_sd"),
            },
            stroke={
                "friction": value("repeatability.friction_sd"),
                "rise": value("repeatability.valve_delay_sd"),
                "fall": value("repeatability.valve_delay_sd"),
                "supply": value("repeatability.supply_sd"),
            },
            position_offset_m=value("repeatability.unit_pot_offset_sd"),
            gauge_offset_pa=value("repeatability.unit_gauge_offset_sd"),
            oil_gauge_offset_pa=5.0 * value("repeatability.unit_gauge_offset_sd"),
        )


def shift(setup: Setup, name: str, amount: float) -> None:
    """Change one healthy quantity of a setup by a relative amount, or by seconds for delays.

    Relative amounts add up in logarithms, as those of effects that scale the same do.
    """
    p = setup.p
    factor = math.exp(amount)
    if name == "friction":
        for index in (
            L.F_STATIC_S,
            L.F_RUN_S,
            L.BETA_S,
            L.F_STATIC_P,
            L.F_RUN_P,
            L.BETA_P,
        ):
            p[index] *= factor
    elif name == "rise":
        rise = max(0, setup.timing.rise_ns + seconds_to_ns(amount))
        setup.timing = replace(setup.timing, rise_ns=rise)
    elif name == "fall":
        fall = max(0, setup.timing.fall_ns + seconds_to_ns(amount))
        setup.timing = replace(setup.timing, fall_ns=fall)
    elif name == "supply":
        p[L.P_SUPPLY] *= factor
    elif name == "flow_in":
        p[L.K_IN] *= factor
    elif name == "flow_out":
        p[L.K_OUT] *= factor
    elif name == "volume_a":
        p[L.VOL_B] *= factor
        p[L.VOL_F] *= factor
    elif name == "volume_b":
        p[L.VOL_N] *= factor
    else:
        raise ValueError(f"no healthy quantity {name!r}")

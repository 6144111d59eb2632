"""What differs between healthy units and healthy strokes: tolerances and scatter, with priors.

Every quantity is counted in its prior standard deviations (`[repeatability]` of the parameter
set), so that each has a standard normal prior.  None of this is a fault.
"""

from __future__ import annotations

from dataclasses import dataclass

from plant.parameters import ParameterSet

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
        """Return the spread of a parameter set's section `repeatability`."""
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

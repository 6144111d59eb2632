"""How far healthy units, strokes and sensors differ.

Checked by: tests/unit/sil/inference/test_fit.py
"""

from __future__ import annotations

from dataclasses import dataclass

from plant.parameters import ParameterSet


@dataclass(frozen=True)
class Spread:
    """Standard deviations of healthy tolerances (of the unit, whole campaigns) and scatter (of strokes).

    Every quantity is counted in these, so that each has a standard normal prior. offset: of sensors,
    by kind of channel, in its unit.
    """

    unit: dict[str, float]
    stroke: dict[str, float]
    offset: dict[str, float]

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
            offset={
                "position": value("repeatability.unit_pot_offset_sd"),
                "pressure": value("repeatability.unit_gauge_offset_sd"),
                "oil": 5.0 * value("repeatability.unit_gauge_offset_sd"),
            },
        )

    def size(self, name: str) -> float:
        """Return the standard deviation of a simulated quantity: of strokes, else of units."""
        return self.stroke.get(name, self.unit.get(name, 0.0))

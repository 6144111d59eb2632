"""How far healthy units, strokes and sensors differ.

Checked by: tests/unit/sil/inference/test_fit.py
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import log

import numpy as np
from numpy.typing import NDArray

from plant.parameters import ParameterSet

CYLINDER = {
    "friction": (0.3, "cylinder.coulomb"),
    "breakaway": (0.15, ""),
    "viscous": (0.3, "cylinder.viscous"),
    "mass": (0.02, "cylinder.mass"),
    "spring": (0.05, "cylinder.spring_rate"),
    "rise": (1e-3, "valve.D_rise"),
    "fall": (3e-3, "valve.D_fall"),
    "flow_in": (0.2, "cylinder.valve_c_in"),
    "flow_out": (0.2, "cylinder.valve_c_out"),
    "critical": (1.0, ""),
    "volume_a": (0.3, "cylinder.dead_volume_1"),
    "volume_b": (0.3, "cylinder.dead_volume_2"),
    "kappa": (1.5, ""),
    "wall_heat": (2.0, ""),
    "wall_density": (0.5, ""),
}
"""By quantity of a data sheet: standard deviation of its logarithm (of the delays in s; of what is limited in
normal deviations), and the value whose `low` and `high` state another one as a 95 % interval.
Breakaway is counted against the sliding friction."""


@dataclass(frozen=True)
class Spread:
    """Standard deviations of healthy tolerances (of the unit) and scatter (of strokes), which all count in them.

    offset: of sensors, by kind of channel, in its unit. root: [unit, unit], the amounts of the unit by
    independent standard normal numbers, as a calibration says they go together.
    """

    unit: dict[str, float]
    stroke: dict[str, float]
    offset: dict[str, float]
    root: NDArray[np.float64]

    @classmethod
    def of(cls, parameters: ParameterSet) -> Spread:
        """Return the spread of a parameter set: of its calibration, its data sheet, or `repeatability`."""
        value = parameters.value
        is_cylinder = "cylinder.bore" in parameters
        rows = [path for path in parameters if path.startswith("posterior.")]
        unit: dict[str, float] = {}
        root = np.zeros((0, 0))
        if rows:
            root = posterior_root([parameters.values(path) for path in rows])
            sizes = np.sqrt(np.sum(root**2, axis=1)).tolist()
            unit = dict(zip((path.partition(".")[2] for path in rows), sizes, strict=True))
        elif is_cylinder:
            unit = {name: stated(parameters, name) for name in CYLINDER}
            if value("cylinder.spring_rate") == value("cylinder.spring_preload") == 0.0:
                del unit["spring"]
        if (
            is_cylinder
        ):  # not of the unit, but of the campaign: a calibration does not carry it over
            unit["supply"] = 0.01  # share, of the gauge that states it
        delay = value("repeatability.unit_valve_delay_sd")
        gauge_pa = value("repeatability.unit_gauge_offset_sd")
        unit = unit or {
            "friction": value("repeatability.unit_friction_sd"),
            "rise": delay,
            "fall": 3.0 * delay,
            "flow_in": value("repeatability.unit_flow_sd"),
            "flow_out": value("repeatability.unit_flow_sd"),
            "volume_a": value("repeatability.unit_volume_sd"),
            "volume_b": value("repeatability.unit_volume_sd"),
        }
        full = np.diag(list(unit.values()))
        full[: len(root), : len(root)] = root
        return cls(
            unit=unit,
            stroke={
                "friction": value("repeatability.friction_sd"),
                "rise": value("repeatability.valve_delay_sd"),
                "fall": value("repeatability.valve_delay_sd"),
                "supply": value("repeatability.supply_sd"),
            },
            offset={"position": 1e-4, "pressure": 2e3, "oil": 1e4}
            if is_cylinder
            else {
                "position": value("repeatability.unit_pot_offset_sd"),
                "pressure": gauge_pa,
                "oil": 5.0 * gauge_pa,
            },
            root=full,
        )

    def size(self, name: str) -> float:
        """Return the standard deviation of a simulated quantity: of strokes, else of units."""
        return self.stroke.get(name, self.unit.get(name, 0.0))


def posterior_root(rows: Sequence[Sequence[float]]) -> NDArray[np.float64]:
    """Return the Cholesky factor [n, n] of a covariance given by the rows of its lower triangle."""
    lower = np.zeros((len(rows), len(rows)))
    for k, row in enumerate(rows):
        lower[k, : k + 1] = row
    return np.asarray(np.linalg.cholesky(lower + np.tril(lower, -1).T))


def stated(parameters: ParameterSet, name: str) -> float:
    """Return the prior deviation of a quantity of a data sheet: by its `low` and `high`, else the usual one."""
    usual, path = CYLINDER[name]
    item = parameters.entries.get(path) or parameters.entries.get(path.replace("_c_", "_cda_"))
    if item is None or item.low is None or item.high is None:
        return usual
    if path.startswith("valve."):
        return (item.high - item.low) / 3.92
    return log(item.high / item.low) / 3.92

"""How far healthy units, strokes and sensors differ.

Checked by: tests/unit/sil/inference/test_fit.py
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import log

import numpy as np
from numpy.typing import NDArray

from can_dbc.errors import InputError
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
    "wall_ends": (1.0, ""),
    "gauge_lag": (1e-3, "cylinder.gauge_lag"),
}
"""By quantity of a data sheet: standard deviation of its logarithm (of delays and lag in s; of what is limited in
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
    def of(cls, parameters: ParameterSet, calibrating: bool = False) -> Spread:
        """Return the priors of a parameter set, those of a unit from the first of these that it has.

        - `posterior`: what `opc4 calibrate` wrote into the model file
        - the data sheet of a cylinder: `low` and `high` of its values, else `CYLINDER`
        - `repeatability.unit_...` of plant/parameters/nominal.toml

        Of strokes: the rest of `repeatability`. Of a truck: `quantities` in truck/quantities.py. Raises InputError
        for rows of `posterior` that are no covariance.
        """
        is_cylinder = "cylinder.bore" in parameters

        def paths(table: str) -> dict[str, str]:
            return {path.partition(".")[2]: path for path in parameters if path.startswith(table)}

        sd = {name: parameters.value(path) for name, path in paths("repeatability.").items()}
        rows = {name: parameters.values(path) for name, path in paths("posterior.").items()}
        try:
            root = posterior_root(list(rows.values()))
        except ValueError:
            expected = "expected its rows to the diagonal, as opc4 calibrate writes them"
            raise InputError(f"{parameters.name}: posterior: no covariance; {expected}") from None
        if rows:
            unit = dict(zip(rows, np.sqrt(np.sum(root**2, axis=1)).tolist(), strict=True))
        elif is_cylinder:
            springs = (parameters.value(f"cylinder.spring_{of}") for of in ("rate", "preload"))
            # of the chambers' ends and the gauges' lines only healthy strokes say enough
            free = {"spring": any(springs), "wall_ends": calibrating, "gauge_lag": calibrating}
            # what a data sheet does not state of the valves' delays may be far off
            wider = dict.fromkeys(("rise", "fall"), 3.0 if calibrating else 1.0)
            names = [name for name in CYLINDER if free.get(name, True)]
            unit = {name: stated(parameters, name, wider.get(name, 1.0)) for name in names}
        else:
            quantities = ("valve_delay", "flow", "volume")
            delay, flow, volume = (sd[f"unit_{name}_sd"] for name in quantities)
            unit = {"friction": sd["unit_friction_sd"], "rise": delay, "fall": 3.0 * delay}
            unit |= {"flow_in": flow, "flow_out": flow, "volume_a": volume, "volume_b": volume}
        if is_cylinder:  # of the campaign, not of the unit: no calibration carries it over
            unit["supply"] = 0.01  # share, of the gauge that states it
        full = np.diag(list(unit.values()))
        full[: len(root), : len(root)] = root
        stroke = {
            "friction": sd["friction_sd"],
            "rise": sd["valve_delay_sd"],
            "fall": sd["valve_delay_sd"],
            "supply": sd["supply_sd"],
        }
        gauge_pa = 2e3 if is_cylinder else sd["unit_gauge_offset_sd"]
        position_m = 1e-4 if is_cylinder else sd["unit_pot_offset_sd"]
        offset = {"position": position_m, "pressure": gauge_pa, "oil": 5.0 * gauge_pa}
        return cls(unit, stroke, offset, full)

    def size(self, name: str) -> float:
        """Return the standard deviation of a simulated quantity: of strokes, else of units."""
        return self.stroke.get(name, self.unit.get(name, 0.0))


def posterior_root(rows: Sequence[Sequence[float]]) -> NDArray[np.float64]:
    """Return the Cholesky factor [n, n] of a covariance given by the rows of its lower triangle.

    Raises ValueError for rows of other lengths, and of no covariance.
    """
    lower = np.zeros((len(rows), len(rows)))
    for k, row in enumerate(rows):
        lower[k, : k + 1] = np.reshape(row, k + 1)
    return np.asarray(np.linalg.cholesky(lower + np.tril(lower, -1).T))


def stated(parameters: ParameterSet, name: str, wider: float = 1.0) -> float:
    """Return the prior deviation of a quantity of a data sheet: by its `low` and `high`, else the usual one, `wider` times."""
    usual, path = CYLINDER[name]
    item = parameters.entries.get(path) or parameters.entries.get(path.replace("_c_", "_cda_"))
    if item is None or item.low is None or item.high is None:
        return wider * usual
    in_s = item.unit == "s"
    width = item.high - item.low if in_s else log(item.high / item.low)
    return width / 3.92

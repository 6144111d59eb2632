"""Values of a model file that a calibration moves: read back from a stroke that its amounts have changed.

Checked by: tests/unit/sil/inference/calibrate/test_calibrate.py
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import exp, pi

import numpy as np

from plant.effects.setup import Setup
from plant.effects.stroke_conditions import StrokeConditions
from plant.effects.tolerances import FACTORS, shift
from plant.kernel.layout import Parameters
from plant.parameters import Number, ParameterSet
from plant.parameters.cylinder import area_of
from sil.campaign.campaign import Floats
from sil.inference.campaign.model import CampaignModel
from sil.inference.fit import FitResult

FLOW_MAPS = {
    Parameters.k_in: ("flow_charge.c_high", "flow_charge.c_low"),
    Parameters.k_out: ("flow_discharge.c_high", "flow_discharge.c_low"),
}


@dataclass(frozen=True)
class Calibrated:
    """A value of the model file; low, high: its 95 % interval, None for a list."""

    value: Number
    low: float | None = None
    high: float | None = None


def calibrated_values(
    parameters: ParameterSet, model: CampaignModel, fit: FitResult
) -> dict[str, Calibrated]:
    """Return by path what a fit makes of a data sheet.

    Intervals by the slopes of the values: in logarithms, of the delays as they are.
    """
    count = len(model.unit)
    root = model.spread.root
    amounts: Floats = root @ fit.shared[:count]
    covariance = root @ fit.covariance[:count, :count] @ root.T
    read = cylinder_values if "cylinder.bore" in parameters else actuator_values
    systems = {stroke.conditions.system for stroke in model.strokes}

    def at(moved: Floats) -> dict[str, Number]:
        return read(parameters, dict(zip(model.unit, moved.tolist(), strict=True)), systems)

    here = at(amounts)
    steps = 1e-4 * np.diag(np.sqrt(np.diag(covariance)))
    there = [at(amounts + step) for step in steps]
    values = {}
    for path, value in here.items():
        if isinstance(value, tuple):
            values[path] = Calibrated(value)
            continue
        by = np.array([float(one[path]) - value for one in there]) / np.diag(steps)  # type: ignore[arg-type]
        half = 1.96 * float(np.sqrt(by @ covariance @ by))
        if path.startswith("valve.") or value <= 0.0:
            low, high = max(0.0, value - half), value + half
        else:
            low, high = value * exp(-half / value), value * exp(half / value)
        values[path] = Calibrated(value, low, high) if half > 0.0 else Calibrated(value)
    return values


def cylinder_values(
    parameters: ParameterSet, amounts: Mapping[str, float], systems: set[int]
) -> dict[str, Number]:
    """Return the section [cylinder] after `amounts`; its tubes are within valves and dead volumes then."""
    setup = Setup.of(parameters, StrokeConditions("fixed", parameters.value("supply.P_s"), ()))
    for name, amount in amounts.items():
        shift(setup, name, amount)
    p = setup.p
    value = parameters.value
    swept = (
        0.25
        * pi
        * (value("cylinder.bore") ** 2 - value("cylinder.rod") ** 2)
        * value("cylinder.stroke")
    )
    values: dict[str, Number] = {
        "cylinder.dead_volume_1": float(p.vol_b),
        "cylinder.dead_volume_2": float(p.vol_n) - swept,
        "cylinder.mass": float(p.m_s),
        "cylinder.breakaway": float(p.f_static_s),
        "cylinder.coulomb": float(p.f_run_s),
        "cylinder.viscous": float(p.beta_s),
        "cylinder.spring_rate": float(p.spring_k),
        "cylinder.spring_preload": 0.0 - float(p.f_external),
        "cylinder.valve_b": float(p.valve_b),
        "cylinder.wall_heat": float(p.wall_heat),
        "cylinder.wall_density": float(p.wall_density),
        "cylinder.kappa": float(p.air_kappa),
        "cylinder.tube_length": 0.0,
        **delays(setup),
    }
    for end, area in (("in", p.k_in * p.cda_in), ("out", p.k_out * p.cda_out)):
        if f"cylinder.valve_c_{end}" in parameters:
            values[f"cylinder.valve_c_{end}"] = float(area) / area_of(1.0)
        else:
            values[f"cylinder.valve_cda_{end}"] = float(area)
    return values


def actuator_values(
    parameters: ParameterSet, amounts: Mapping[str, float], systems: set[int]
) -> dict[str, Number]:
    """Return what `amounts` change of the shifting actuator's parameters, for the rigs `systems`."""
    values: dict[str, Number] = {}
    fields = {field.start: field for field in Parameters.fields.values()}
    for name, amount in amounts.items():
        for index in FACTORS.get(name, ()):
            by_system = fields[index].paths
            paths = [by_system[s] for s in systems if by_system and by_system[s]]
            for path in (*paths, *FLOW_MAPS.get(index, ())):
                old = parameters[path].value
                if isinstance(old, tuple):
                    values[path] = tuple(exp(amount) * item for item in old)
                else:
                    values[path] = exp(amount) * old
    setup = Setup.of(parameters, StrokeConditions("fixed", parameters.value("supply.P_s"), ()))
    for name in ("rise", "fall"):
        shift(setup, name, amounts.get(name, 0.0))
    return values | delays(setup)


def delays(setup: Setup) -> dict[str, Number]:
    """Return the valves' delays of a stroke by their paths [s]."""
    timing = setup.timing
    return {"valve.D_rise": 1e-9 * timing.rise_ns, "valve.D_fall": 1e-9 * timing.fall_ns}

"""Strokes and runs that several claims use, each made once, and what is read from them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache
from types import MappingProxyType
from typing import Any

import numpy as np

from plant.effects.setup import Setup
from plant.effects.stroke_conditions import StrokeConditions
from plant.parameters import ParameterSet, load
from plant.systems.setup import make_setup
from plant.systems.stroke import Stroke, run_setup
from sil.campaign.campaign import Floats
from sil.simulation.in_memory import Run, run_in_memory
from sil.simulation.load_scenario import load as load_scenario

SUPPLY_PA = 900000.0
ATMOSPHERE_PA = 101325.0
VALVE = {"fixed": "1", "N-B": "B", "B-N": "N", "N-F": "F", "F-N": "N"}
COMMAND_S = 0.01

Change = Callable[[Setup], None]


@cache
def nominal() -> ParameterSet:
    """Return the calibrated parameter set."""
    return load("nominal")


def run(
    kind: str,
    *,
    until_s: float = 0.3,
    step_s: float = 1e-4,
    scale: Mapping[int, float] = MappingProxyType({}),
    put: Mapping[int, float] = MappingProxyType({}),
    change: Change = lambda setup: None,
    parameters: ParameterSet | None = None,
    **conditions: Any,
) -> Stroke:
    """Run a lab stroke: 9 bar, its valve commanded on at 10 ms and left on.

    scale and put: factors and values of packed parameters, by their index in `plant.kernel.layout`.
    change: any other change of the setup. parameters: another set than `nominal`. conditions: fields of `StrokeConditions`.
    """
    conditions.setdefault("supply_pressure_pa", SUPPLY_PA)
    conditions.setdefault("commands", ((COMMAND_S, VALVE[kind], 0.98),))
    setup = make_setup(parameters or nominal(), StrokeConditions(kind=kind, **conditions))
    for index, factor in scale.items():
        setup.p[index] *= factor
    for index, value in put.items():
        setup.p[index] = value
    change(setup)
    time_s = (np.arange(round(until_s / step_s) + 1) * step_s).astype(np.float64)
    return run_setup(setup, time_s, internal=False)


def value(path: str) -> float:
    """Return a value of the calibrated parameter set by its path, in the unit of the set."""
    return nominal().value(path)


@cache
def plain(kind: str) -> Stroke:
    """Return the nominal lab stroke of a kind."""
    return run(kind)


@cache
def loop(name: str, **settings: Any) -> Run:
    """Return a shipped scenario run in memory."""
    return run_in_memory(load_scenario(name, settings=settings))


def ms(*times_s: float) -> tuple[float, ...]:
    """Return times in ms, or lengths in mm."""
    return tuple(1e3 * each for each in times_s)


def peak_bar(stroke: Stroke, chamber: str) -> float:
    """Return the greatest pressure in a chamber in bar."""
    return float(np.max(stroke.pressure_pa(chamber))) / 1e5


def speed(stroke: Stroke) -> float:
    """Return the impact speed [m/s], 0 for none."""
    return stroke.impact.speed_m_s if stroke.impact else 0.0


def arrival(stroke: Stroke) -> float:
    """Return the time of the impact [s], infinite for none."""
    return stroke.impact.time_s if stroke.impact else float("inf")


def first_motion_s(stroke: Stroke) -> float:
    """Return the time at which the stay begins to move. Raises ValueError if it does not."""
    impact = stroke.impact
    moved = np.flatnonzero(np.abs(stroke.position_m - stroke.position_m[0]) > 5e-5)
    if impact is None or len(moved) == 0:
        raise ValueError("the stay does not move")
    return float(stroke.time_s[moved[0]])


def relative_errors(measured: Floats, simulated: Floats) -> tuple[float, float]:
    """Return the mean and maximum relative error, 3.69 and 3.70, of two signals [n] of one unit."""
    error = np.abs(measured - simulated) / np.max(np.abs(measured))
    return float(np.mean(error)), float(np.max(error))

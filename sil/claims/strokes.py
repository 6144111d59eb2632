"""Strokes that several claims look at, run once each."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np

from plant.effects.setup import Setup
from plant.effects.stroke_conditions import StrokeConditions
from plant.kernel import layout as L
from plant.parameters import ParameterSet, load
from plant.systems.setup import make_setup
from plant.systems.stroke import Stroke, run_setup

SUPPLY_PA = 900000.0
ATMOSPHERE_PA = 101325.0
VALVE = {"fixed": "1", "N-B": "B", "B-N": "N", "N-F": "F", "F-N": "N"}
COMMAND_S = 0.01

Change = Callable[[Setup], None]


@cache
def nominal() -> ParameterSet:
    """The calibrated parameter set."""
    return load("nominal")


def conditions(kind: str, **changes: object) -> StrokeConditions:
    """A lab stroke: its valve commanded on at 10 ms and left on, 9 bar."""
    base = StrokeConditions(
        kind=kind,
        supply_pressure_pa=SUPPLY_PA,
        commands=((COMMAND_S, VALVE[kind], 0.98),),
    )
    return replace(base, **changes)  # type: ignore[arg-type]


def run(
    kind: str,
    *,
    until_s: float = 0.3,
    step_s: float = 1e-4,
    change: Change | None = None,
    **changes: object,
) -> Stroke:
    """Run a stroke of a kind, with changed conditions, and a change of its setup."""
    setup = make_setup(nominal(), conditions(kind, **changes))
    if change is not None:
        change(setup)
    time_s = (np.arange(round(until_s / step_s) + 1) * step_s).astype(np.float64)
    return run_setup(setup, time_s, internal=False)


@cache
def plain(kind: str) -> Stroke:
    """The nominal lab stroke of a kind."""
    return run(kind)


def first_motion_s(stroke: Stroke) -> float:
    """Instant at which the stay begins to move for good: last breakaway before the stop."""
    impact = stroke.impact
    moved = np.flatnonzero(np.abs(stroke.position_m - stroke.position_m[0]) > 5e-5)
    if impact is None or len(moved) == 0:
        raise ValueError("the stay does not move")
    return float(stroke.time_s[moved[0]])


def scaled(index: int, factor: float) -> Change:
    """A change that multiplies one packed parameter."""

    def change(setup: Setup) -> None:
        setup.p[index] *= factor

    return change


def both(*changes: Change) -> Change:
    """Several changes as one."""

    def change(setup: Setup) -> None:
        for one in changes:
            one(setup)

    return change


def radius(factor: float) -> Change:
    """A piston of another radius in the fixed-piston actuator; the dead volumes stay.

    Areas grow with r^2, the swept volumes with them: chamber two starts larger, ends as it was.
    """

    def change(setup: Setup) -> None:
        p = setup.p
        dead = p[L.VOL_N] - p[L.AREA_P2] * p[L.STROKE]
        p[L.AREA_P] *= factor**2
        p[L.AREA_P2] = p[L.AREA_P] - p[L.AREA_S]
        p[L.VOL_N] = dead + p[L.AREA_P2] * p[L.STROKE]

    return change


def relative_errors(measured: np.ndarray, simulated: np.ndarray) -> tuple[float, float]:
    """Mean and maximum relative error of the thesis, 3.69 and 3.70, normalised by max |y|."""
    error = np.abs(measured - simulated) / np.max(np.abs(measured))
    return float(np.mean(error)), float(np.max(error))

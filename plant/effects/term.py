"""A bounded non-parametric term in exactly one equation: what none of the named effects is."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from .. import layout as L
from ..setup import Curve, Setup
from .effect import Effect, EffectParameter
from .valves import shift_fall, shift_rise

OPENING, CLOSING, SUPPLY, POSITION, GAUGE = 10.0, 11.0, 12.0, 13.0, 14.0
"""Equations beside the kernel's: when valves move, what feeds them, what sensors tell."""

OF_SENSORS = (POSITION, GAUGE)

LEVELS: dict[float, Callable[[Setup], float]] = {
    3.0: lambda setup: float(np.log10(max(setup.conditions.rest_s, 1e-3))),
    4.0: lambda setup: setup.conditions.progress,
    5.0: lambda setup: float(VALVES.index(setup.charged_chamber)),
}
"""Variables that have one value a stroke."""

VALVES = ("1", "B", "N", "F")


def unnamed(setup: Setup, values: dict[str, float]) -> None:
    """Nodes over a variable, joined by straight lines, added to an equation.

    equation: 1 force on the stay [N]; 2.. flow T m_dot of chamber 1.. [K kg/s]; 5 resistance of
    the stay [N]; 6, 7 share of the charge and discharge flows, of P/P_s and P/P_atm; 8 flow out
    of every chamber [K kg/s], of its pressure; 9 shift of the process exponents, of speed;
    10, 11 delay of opening and closing [s]; 12 share of the supply pressure; 13 error of the
    control unit's position [m]; 14 error of the gauges [Pa], of pressure.
    variable: 0 time, 1 position, 2 speed or the chamber's pressure; with one level a stroke (5, 6,
    7, 10-12): 3 log10 of the rest before the stroke, 4 where it stands in its campaign, 0 first to 1
    last, 5 the valve that drives it (1, B, N, F: 0 to 3).
    """
    nodes = np.atleast_1d(np.asarray(values["nodes"], dtype=np.float64))
    if len(nodes) > L.TERM_NODES:
        raise ValueError(f"{len(nodes)} nodes; at most {L.TERM_NODES}")
    equation = values["equation"]
    curve = Curve(values["low"], values["step"], nodes)
    level_of = LEVELS.get(values["variable"])
    level = 0.0 if level_of is None else float(curve.at(np.array(level_of(setup))))
    if equation == OPENING:
        shift_rise(setup, level)
    elif equation == CLOSING:
        shift_fall(setup, level)
    elif equation == SUPPLY:
        setup.p[L.P_SUPPLY] *= max(0.2, 1.0 + level)
    elif equation == POSITION:
        setup.internal_error_m = curve
    elif equation == GAUGE:
        setup.gauge_error_pa = curve
    if equation >= OPENING:
        return
    if level_of is not None:
        nodes = np.full(1, level)
    p = setup.p
    p[L.TERM_EQUATION] = values["equation"]
    p[L.TERM_VARIABLE] = values["variable"]
    p[L.TERM_LOW] = values["low"]
    p[L.TERM_STEP] = values["step"]
    p[L.TERM_COUNT] = float(len(nodes))
    p[L.TERM_0 : L.TERM_0 + len(nodes)] = nodes


EFFECTS = (
    Effect(
        "unnamed",
        "unnamed",
        "force",
        "a term that none of the named effects is, by its values on a grid",
        (
            EffectParameter("equation", "-", 0.0, 0.0, GAUGE, 1.0),
            EffectParameter("variable", "-", 0.0, 0.0, 5.0, 1.0),
            EffectParameter("low", "-", 0.0, -1e7, 1e7, 1.0),
            EffectParameter("step", "-", 1.0, 1e-9, 1e7, 1.0),
            EffectParameter("nodes", "-", 0.0, -1e6, 1e6, 1.0, listed=True),
        ),
        unnamed,
    ),
)

"""A bounded non-parametric term in exactly one equation: what none of the named effects is."""

from __future__ import annotations

import numpy as np

from .. import layout as L
from ..setup import Setup
from .effect import Effect, EffectParameter

EQUATIONS = {
    "force": 1.0,
    "flow 1": 2.0,
    "flow 2": 3.0,
    "flow 3": 4.0,
    "friction": 5.0,
    "charge flow": 6.0,
    "discharge flow": 7.0,
    "leak": 8.0,
    "exponents": 9.0,
}
VARIABLES = {"time": 0.0, "position": 1.0, "own": 2.0, "rest": 3.0}


def unnamed(setup: Setup, values: dict[str, float]) -> None:
    """Nodes over a variable, joined by straight lines, added to an equation.

    equation: 1 force on the stay [N]; 2.. flow T m_dot of chamber 1.. [K kg/s]; 5 resistance of
    the stay [N]; 6, 7 share of the charge and discharge flows, of P/P_s and P/P_atm; 8 flow out
    of every chamber [K kg/s], of its pressure; 9 shift of the process exponents, of speed.
    variable: 0 time, 1 position, 2 speed or the chamber's pressure, 3 log10 of the rest before the
    stroke (equation 5: one level a stroke).
    """
    nodes = np.atleast_1d(np.asarray(values["nodes"], dtype=np.float64))
    if len(nodes) > L.TERM_NODES:
        raise ValueError(f"{len(nodes)} nodes; at most {L.TERM_NODES}")
    p = setup.p
    if values["variable"] == 3.0 and values["equation"] == 5.0:
        place = np.log10(max(setup.conditions.rest_s, 1e-3))
        grid = values["low"] + values["step"] * np.arange(len(nodes))
        nodes = np.full(1, np.interp(place, grid, nodes))
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
            EffectParameter("equation", "-", 0.0, 0.0, 9.0, 1.0),
            EffectParameter("variable", "-", 0.0, 0.0, 3.0, 1.0),
            EffectParameter("low", "-", 0.0, -1e7, 1e7, 1.0),
            EffectParameter("step", "-", 1.0, 1e-9, 1e7, 1.0),
            EffectParameter("nodes", "-", 0.0, -1e6, 1e6, 1.0, listed=True),
        ),
        unnamed,
    ),
)

"""A bounded non-parametric term in exactly one equation: what none of the named effects is."""

from __future__ import annotations

import numpy as np

from .. import layout as L
from ..setup import Setup
from .effect import Effect, EffectParameter

EQUATIONS = {"force": 1.0, "flow 1": 2.0, "flow 2": 3.0, "flow 3": 4.0}
VARIABLES = {"time": 0.0, "position": 1.0, "own": 2.0}


def unnamed(setup: Setup, values: dict[str, float]) -> None:
    """Nodes over a variable (0 time, 1 position, 2 speed or the chamber's pressure), joined by
    straight lines, added to an equation (1 force on the stay [N], 2.. flow T m_dot of chamber 1..
    [K kg/s])."""
    nodes = np.atleast_1d(np.asarray(values["nodes"], dtype=np.float64))
    if len(nodes) > L.TERM_NODES:
        raise ValueError(f"{len(nodes)} nodes; at most {L.TERM_NODES}")
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
            EffectParameter("equation", "-", 0.0, 0.0, 4.0, 1.0),
            EffectParameter("variable", "-", 0.0, 0.0, 2.0, 1.0),
            EffectParameter("low", "-", 0.0, -1e7, 1e7, 1.0),
            EffectParameter("step", "-", 1.0, 1e-9, 1e7, 1.0),
            EffectParameter("nodes", "-", 0.0, -1e6, 1e6, 1.0, listed=True),
        ),
        unnamed,
    ),
)

"""A bounded non-parametric term in exactly one equation: what none of the named effects is."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from plant.effects.effect import Effect, EffectParameter
from plant.effects.setup import Curve, Setup
from plant.effects.tolerances import shift
from plant.errors import InputError
from plant.kernel import layout as L
from plant.kernel.packing import Floats

LEVELLED = {
    10.0: "rise",
    11.0: "fall",
    12.0: "supply",
    15.0: "friction",
    16.0: "flow_in",
    17.0: "flow_out",
}
"""Equations beside the kernel's with one level a stroke: quantities of `plant.effects.tolerances`."""

POSITION, GAUGE = 13.0, 14.0
OF_SENSORS = (POSITION, GAUGE)

VALVES = ("1", "B", "N", "F")

LEVELS: dict[float, Callable[[Setup], float]] = {
    3.0: lambda setup: float(np.log10(max(setup.conditions.rest_s, 1e-3))),
    4.0: lambda setup: setup.conditions.progress,
    5.0: lambda setup: float(VALVES.index(setup.charged_chamber)),
}
"""Variables that have one value a stroke."""


def unnamed(setup: Setup, values: dict[str, float]) -> None:
    """Nodes over a variable, joined by straight lines, added to an equation.

    equation: 1 force on the stay [N]; 2.. flow T m_dot of chamber 1.. [K kg/s]; 5 resistance of
    the stay [N]; 6, 7 share of the charge and discharge flows, of P/P_s and P/P_atm; 8 flow out
    of every chamber [K kg/s], of its pressure; 9 shift of the process exponents, of speed;
    13 error of the control unit's position [m]; 14 error of the gauges [Pa], of pressure. With one
    level a stroke: 10, 11 delay of opening and closing [s]; 12, 15, 16, 17 logarithm of a factor on
    supply pressure, friction, charge and discharge flows.
    variable: 0 time, 1 position, 2 speed or pressure; of levels: 3 log10 of the rest before the
    stroke [s], 4 where it stands in its campaign, 0 first to 1 last, 5 the valve that drives it (1,
    B, N, F: 0 to 3).
    """
    nodes = np.atleast_1d(np.asarray(values["nodes"], dtype=np.float64))
    if len(nodes) > L.TERM_NODES:
        raise ValueError(f"{len(nodes)} nodes; at most {L.TERM_NODES}")
    equation = values["equation"]
    curve = Curve(values["low"], values["step"], nodes)
    if equation in LEVELLED:
        if values["variable"] not in LEVELS:
            raise InputError(
                f"[effect.unnamed]: equation {equation:g} of variable {values['variable']:g}; expected "
                "a variable with one level a stroke: 3, 4 or 5"
            )
        level = curve.at(np.array(LEVELS[values["variable"]](setup)))
        shift(setup, LEVELLED[equation], float(level))
    elif equation == POSITION:
        setup.internal_error_m = curve
    elif equation == GAUGE:
        setup.gauge_error_pa = curve
    else:
        into_kernel(setup.p, values, nodes)


def into_kernel(p: Floats, values: dict[str, float], nodes: Floats) -> None:
    """Write a term of equations 1 to 9 where the kernel reads it."""
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
            EffectParameter("equation", "-", 0.0, 0.0, 17.0, 1.0),
            EffectParameter("variable", "-", 0.0, 0.0, 5.0, 1.0),
            EffectParameter("low", "-", 0.0, -1e7, 1e7, 1.0),
            EffectParameter("step", "-", 1.0, 1e-9, 1e7, 1.0),
            EffectParameter("nodes", "-", 0.0, -1e6, 1e6, 1.0, listed=True),
        ),
        unnamed,
    ),
)

"""A bounded non-parametric term in exactly one equation: none of the named effects."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from plant.effects.added_term import ARGUMENTS, write_term
from plant.effects.effect import EffectParameter, Scope, Values, effect
from plant.effects.setup import Curve, Setup
from plant.effects.tolerances import shift
from plant.errors import InputError
from plant.kernel.compiled import c_function
from plant.kernel.layout import FIXED, TERM_NODES, Over, Slot
from plant.kernel.packing import Floats
from plant.kernel.views import TERM
from plant.parts.term import AGAINST_MOTION, POSITION, PRESSURE, SPEED, TIME, tabulated

LEVELLED = {
    Slot.RISE: "rise",
    Slot.FALL: "fall",
    Slot.SUPPLY: "supply",
    Slot.FRICTION: "friction",
    Slot.CHARGE_LEVEL: "flow_in",
    Slot.DISCHARGE_LEVEL: "flow_out",
}
"""Slots with one level a stroke, and the quantities of `plant.effects.tolerances` they change."""

LEVELS: dict[float, Callable[[Setup], float]] = {
    Over.REST: lambda setup: float(np.log10(max(setup.conditions.rest_s, 1e-3))),
    Over.PROGRESS: lambda setup: setup.conditions.progress,
    Over.VALVE: lambda setup: float("1BNF".index(setup.charged_chamber)),
}
"""Variables that have one value a stroke."""


@dataclass(frozen=True)
class TermForm:
    """A term that a diagnosis tries; typical: size worth reporting; most: bound of its values, in typical sizes."""

    name: str
    cause_class: str
    slot: Slot
    over: Over
    low: float
    high: float
    count: int
    typical: float
    unit: str
    what: str
    on: str
    most: float = 200.0

    @property
    def step(self) -> float:
        """Distance of the nodes."""
        return (self.high - self.low) / (self.count - 1)


TRAVEL, ON_POSITION = (-0.013, 0.013, 14), "position [m]"
REST, BY_REST = (0.0, 3.0, 7), "rest before the stroke [log10 s]"
PROGRESS, BY_PROGRESS = (0.0, 1.0, 6), "course of the campaign, first stroke 0, last 1"
VALVE, BY_VALVE = (0.0, 3.0, 4), "driving valve: 1, B, N, F"
FORCE, DRAG = "a force on the stay", "resistance against the stay's motion"
ALL_FRICTION, OPENING = "the logarithm of a factor on all friction", "a change of the opening delay"

# fmt: off
FORMS = (
    TermForm("force of position", "mechanics", Slot.FORCE, Over.POSITION, *TRAVEL, 20.0, "N",
             FORCE, ON_POSITION),
    TermForm("force of time", "mechanics", Slot.FORCE, Over.TIME, 0.0, 0.3, 16, 20.0, "N",
             FORCE, "time [s]"),
    TermForm("friction of speed", "friction", Slot.RESISTANCE, Over.SPEED, 0.0, 1.6, 9, 10.0, "N",
             DRAG, "speed [m/s]"),
    TermForm("friction of position", "friction", Slot.RESISTANCE, Over.POSITION, *TRAVEL, 10.0, "N",
             DRAG, ON_POSITION),
    TermForm("charge flow of pressure", "flow restriction", Slot.CHARGE, Over.SPEED, 0.1, 1.0, 9,
             0.05, "-", "a relative change of the charge flows",
             "chamber pressure over supply pressure"),
    TermForm("discharge flow of pressure", "flow restriction", Slot.DISCHARGE, Over.SPEED, 1.0, 9.0,
             9, 0.05, "-", "a relative change of the discharge flows",
             "chamber pressure over atmosphere"),
    TermForm("leak of pressure", "leak", Slot.LEAK, Over.SPEED, 1e5, 9e5, 8, 0.1, "K kg/s",
             "a flow out of every chamber", "chamber pressure [Pa]"),
    TermForm("exponent of speed", "thermodynamics", Slot.EXPONENT, Over.SPEED, 0.0, 1.6, 7, 0.05, "-",
             "a shift of the process exponents of compression", "piston speed [m/s]"),
    TermForm("friction of rest", "friction", Slot.FRICTION, Over.REST, *REST, 0.2, "-",
             ALL_FRICTION, BY_REST, 12.0),
    TermForm("friction of progress", "friction", Slot.FRICTION, Over.PROGRESS, *PROGRESS, 0.2, "-",
             ALL_FRICTION, BY_PROGRESS, 12.0),
    TermForm("opening delay of rest", "valve timing", Slot.RISE, Over.REST, *REST, 2e-3, "s",
             OPENING, BY_REST),
    TermForm("opening delay of progress", "valve timing", Slot.RISE, Over.PROGRESS, *PROGRESS, 2e-3,
             "s", OPENING, BY_PROGRESS),
    TermForm("opening delay of valve", "valve timing", Slot.RISE, Over.VALVE, *VALVE, 2e-3, "s",
             OPENING, BY_VALVE),
    TermForm("closing delay of valve", "valve timing", Slot.FALL, Over.VALVE, *VALVE, 5e-3, "s",
             "a change of the closing delay", BY_VALVE),
    TermForm("charge flow of valve", "flow restriction", Slot.CHARGE_LEVEL, Over.VALVE, *VALVE, 0.05,
             "-", "the logarithm of a factor on the charge flow", BY_VALVE, 40.0),
    TermForm("supply of progress", "supply", Slot.SUPPLY, Over.PROGRESS, *PROGRESS, 0.02, "-",
             "the logarithm of a factor on the supply pressure", BY_PROGRESS, 40.0),
    TermForm("internal position", "internal sensor", Slot.POSITION, Over.POSITION, *TRAVEL, 2e-4, "m",
             "an error of the control unit's position", ON_POSITION),
    TermForm("gauge of pressure", "gauge", Slot.GAUGE, Over.SPEED, 1e5, 9e5, 9, 5e3, "Pa",
             "an error of the pressure gauges", "pressure [Pa]"),
)
# fmt: on


def scope_of_term(values: Values) -> Scope:
    """Return what a term belongs to, by its slot and variable."""
    if values.get("equation") in (Slot.POSITION, Slot.GAUGE):
        return "instrument"
    return "stroke" if values.get("variable") in (Over.TIME, *LEVELS) else "unit"


@effect(
    "unnamed",
    "unnamed",
    "force",
    "a term that is none of the named effects, by its values on a grid",
    EffectParameter("equation", "-", 0.0, 0.0, 17.0, 1.0),
    EffectParameter("variable", "-", 0.0, 0.0, 5.0, 1.0),
    EffectParameter("low", "-", 0.0, -1e7, 1e7, 1.0),
    EffectParameter("step", "-", 1.0, 1e-9, 1e7, 1.0),
    EffectParameter("nodes", "-", 0.0, -1e6, 1e6, 1.0, listed=True),
    scope=scope_of_term,
    nonparametric=True,
)
def term(setup: Setup, values: dict[str, float]) -> None:
    """Nodes over a variable (`Over`), joined by straight lines, added to an equation (`Slot`).

    FORCE [N]; FLOW_1 to FLOW_3: T m_dot of a chamber [K kg/s]; RESISTANCE [N] of the stay; CHARGE and
    DISCHARGE: share of the flows, of P/P_s and P/P_atm; LEAK: flow out of every chamber [K kg/s], of
    its pressure; EXPONENT: shift of the process exponents, of speed; POSITION: error of the control
    unit's position [m]; GAUGE: error of the gauges [Pa], of pressure; RISE, FALL: delay of opening
    and closing [s]; SUPPLY, FRICTION, CHARGE_LEVEL, DISCHARGE_LEVEL: logarithm of a factor.

    Raises ValueError for too many nodes, InputError for a level of something that changes during a
    stroke.
    """
    nodes = np.atleast_1d(np.asarray(values["nodes"], dtype=np.float64))
    if len(nodes) > TERM_NODES:
        raise ValueError(f"{len(nodes)} nodes; at most {TERM_NODES}")
    equation = values["equation"]
    curve = Curve(values["low"], values["step"], nodes)
    if equation in LEVELLED:
        if values["variable"] not in LEVELS:
            raise InputError(
                f"[effect.{term.id}]: equation {equation:g} of variable {values['variable']:g}; "
                "expected a variable with one level a stroke: 3, 4 or 5"
            )
        level = curve.at(np.array(LEVELS[values["variable"]](setup)))
        shift(setup, LEVELLED[Slot(int(equation))], float(level))
    elif equation == Slot.POSITION:
        setup.internal_error_m = curve
    elif equation == Slot.GAUGE:
        setup.gauge_error_pa = curve
    else:
        add_table(setup, values, nodes)


def add_table(setup: Setup, values: Mapping[str, float], nodes: Floats) -> None:
    """Add a term, nodes [n], where the equations read it."""
    slot = Slot(int(values["equation"]))
    if slot == Slot.FLOW_3 and setup.conditions.system == FIXED:
        slot = Slot.FLOW_2
    offered = ARGUMENTS[slot].values()
    over = {Over.TIME: TIME, Over.POSITION: POSITION}.get(Over(int(values["variable"])), SPEED)
    if over not in offered:
        over = SPEED if SPEED in offered else PRESSURE
    if slot == Slot.FORCE and over == SPEED:
        over = AGAINST_MOTION
    grid = [over, values["low"], values["step"], len(nodes)]
    write_term(setup, slot, table_address(), [*grid, *nodes.tolist()])


@functools.cache
def table_address() -> int:
    """Return the address of the compiled `tabulated`."""
    return int(c_function(tabulated, TERM).address)

"""Terms that none of the named causes is: a bounded smooth function in exactly one equation.

Each term is a candidate like any other, with the identifier "unnamed"; its parameters are the
values at the nodes of a grid.
Checked by: tests/unit/sil/diagnosis/test_terms.py
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from plant.effects import CATALOGUE, Effect, EffectParameter
from plant.effects.setup import Setup
from sil.fitting.hypotheses import Candidate, Starts


@dataclass(frozen=True)
class TermPlace:
    """Where a term may enter: its equation and variable (codes of plant.effects.term), its grid.

    most: bound of its values, in typical sizes.
    """

    name: str
    klass: str
    equation: float
    variable: float
    low: float
    high: float
    count: int
    typical: float
    unit: str
    what: str
    on: str
    most: float = 200.0


# what has one level a stroke: the grid's ends and nodes, and what it is called
REST, BY_REST = (0.0, 3.0, 7), "rest before the stroke [log10 s]"
PROGRESS, BY_PROGRESS = (0.0, 1.0, 6), "course of the campaign, first stroke 0, last 1"
VALVE, BY_VALVE = (0.0, 3.0, 4), "driving valve: 1, B, N, F"

PLACES = (
    TermPlace(
        "force of position",
        "mechanics",
        1.0,
        1.0,
        -0.013,
        0.013,
        14,
        20.0,
        "N",
        "a force on the stay",
        "position [m]",
    ),
    TermPlace(
        "force of time",
        "mechanics",
        1.0,
        0.0,
        0.0,
        0.3,
        16,
        20.0,
        "N",
        "a force on the stay",
        "time [s]",
    ),
    TermPlace(
        "friction of speed",
        "friction",
        5.0,
        2.0,
        0.0,
        1.6,
        9,
        10.0,
        "N",
        "resistance against the stay's motion",
        "speed [m/s]",
    ),
    TermPlace(
        "friction of position",
        "friction",
        5.0,
        1.0,
        -0.013,
        0.013,
        14,
        10.0,
        "N",
        "resistance against the stay's motion",
        "position [m]",
    ),
    TermPlace(
        "charge flow of pressure",
        "flow restriction",
        6.0,
        2.0,
        0.1,
        1.0,
        9,
        0.05,
        "-",
        "a relative change of the charge flows",
        "chamber pressure over supply pressure",
    ),
    TermPlace(
        "discharge flow of pressure",
        "flow restriction",
        7.0,
        2.0,
        1.0,
        9.0,
        9,
        0.05,
        "-",
        "a relative change of the discharge flows",
        "chamber pressure over atmosphere",
    ),
    TermPlace(
        "leak of pressure",
        "leak",
        8.0,
        2.0,
        1e5,
        9e5,
        8,
        0.1,
        "K kg/s",
        "a flow out of every chamber",
        "chamber pressure [Pa]",
    ),
    TermPlace(
        "exponent of speed",
        "thermodynamics",
        9.0,
        2.0,
        0.0,
        1.6,
        7,
        0.05,
        "-",
        "a shift of the process exponents of compression",
        "piston speed [m/s]",
    ),
    TermPlace(
        "friction of rest",
        "friction",
        15.0,
        3.0,
        *REST,
        0.2,
        "-",
        "the logarithm of a factor on all friction",
        BY_REST,
        12.0,
    ),
    TermPlace(
        "friction of progress",
        "friction",
        15.0,
        4.0,
        *PROGRESS,
        0.2,
        "-",
        "the logarithm of a factor on all friction",
        BY_PROGRESS,
        12.0,
    ),
    TermPlace(
        "opening delay of rest",
        "valve timing",
        10.0,
        3.0,
        *REST,
        2e-3,
        "s",
        "a change of the opening delay",
        BY_REST,
    ),
    TermPlace(
        "opening delay of progress",
        "valve timing",
        10.0,
        4.0,
        *PROGRESS,
        2e-3,
        "s",
        "a change of the opening delay",
        BY_PROGRESS,
    ),
    TermPlace(
        "opening delay of valve",
        "valve timing",
        10.0,
        5.0,
        *VALVE,
        2e-3,
        "s",
        "a change of the opening delay",
        BY_VALVE,
    ),
    TermPlace(
        "closing delay of valve",
        "valve timing",
        11.0,
        5.0,
        *VALVE,
        5e-3,
        "s",
        "a change of the closing delay",
        BY_VALVE,
    ),
    TermPlace(
        "charge flow of valve",
        "flow restriction",
        16.0,
        5.0,
        *VALVE,
        0.05,
        "-",
        "the logarithm of a factor on the charge flow",
        BY_VALVE,
        40.0,
    ),
    TermPlace(
        "supply of progress",
        "supply",
        12.0,
        4.0,
        *PROGRESS,
        0.02,
        "-",
        "the logarithm of a factor on the supply pressure",
        BY_PROGRESS,
        40.0,
    ),
    TermPlace(
        "internal position",
        "internal sensor",
        13.0,
        1.0,
        -0.013,
        0.013,
        14,
        2e-4,
        "m",
        "an error of the control unit's position",
        "position [m]",
    ),
    TermPlace(
        "gauge of pressure",
        "gauge",
        14.0,
        2.0,
        1e5,
        9e5,
        9,
        5e3,
        "Pa",
        "an error of the pressure gauges",
        "pressure [Pa]",
    ),
)


def grid(place: TermPlace) -> np.ndarray:
    """The nodes of a place's grid."""
    return np.linspace(place.low, place.high, place.count)


ROUGHNESS = 0.5
"""By how many typical sizes a node may leave the line of its neighbours: what no stroke reaches
follows that line."""

SIZES = (0.5, 2.0, 6.0)
"""Where a search begins, in typical sizes, beside nothing: of either sign and every shape."""

CATEGORIES = 4
"""A grid of so few nodes is one of things, not of a quantity: each alone is a shape too."""


def starts_of(place: TermPlace) -> Starts:
    """Points to begin a search from: nothing; level, rising and falling curves of several sizes."""
    rising = np.linspace(0.0, 1.0, place.count)
    shapes = [np.ones(place.count), rising, rising[::-1]]
    if place.count <= CATEGORIES:
        shapes += list(np.eye(place.count))
    curves = [np.zeros(place.count)]
    curves += [
        sign * size * place.typical * shape
        for size in SIZES
        for shape in shapes
        for sign in (1.0, -1.0)
    ]
    return tuple(tuple(float(value) for value in curve) for curve in curves)


def term_candidate(place: TermPlace) -> Candidate:
    """The term at a place as a candidate."""
    whole = CATALOGUE["unnamed"]
    names = tuple(f"node_{k:02d}" for k in range(place.count))

    def change(setup: Setup, values: dict[str, float]) -> None:
        whole.change(
            setup,
            {
                "equation": place.equation,
                "variable": place.variable,
                "low": place.low,
                "step": (place.high - place.low) / (place.count - 1),
                "nodes": tuple(values[name] for name in names),  # type: ignore[dict-item]
            },
        )

    limit = place.most * place.typical
    parameters = tuple(
        EffectParameter(name, place.unit, 0.0, -limit, limit, place.typical) for name in names
    )
    effect = Effect("unnamed", place.klass, whole.equation, place.what, parameters, change)
    return Candidate(
        effect,
        place.name,
        parameters,
        starts_of(place),
        told_class=place.klass,
        roughness=0.0 if place.count <= CATEGORIES else ROUGHNESS,
    )


def term_candidates() -> list[tuple[TermPlace, Candidate]]:
    """All terms."""
    return [(place, term_candidate(place)) for place in PLACES]


def is_term(candidate: Candidate) -> bool:
    """Whether a candidate is a non-parametric term."""
    return candidate.id == "unnamed"


def place_of(candidate: Candidate) -> TermPlace:
    """The place of a term."""
    return next(place for place in PLACES if place.name == candidate.variant)

"""Non-parametric terms, tried when the best named hypothesis leaves structure.

A term is a bounded smooth function in exactly one equation: a candidate like any other, whose
parameters are the values at the nodes of a grid.
Checked by: tests/unit/sil/inference/campaign/test_terms.py
"""

from __future__ import annotations

import numpy as np

from plant.effects import Effect, EffectParameter
from plant.effects.effect import Starts
from plant.effects.setup import Setup
from plant.effects.term import FORMS, TermForm, term
from sil.inference.candidate import Candidate


def _starts_of(form: TermForm) -> Starts:
    """Return points to begin a search from: zero; level, rising and falling curves of several sizes.

    In a form of categories each alone is a shape too.
    """
    rising = np.linspace(0.0, 1.0, form.count)
    shapes = [np.ones(form.count), rising, rising[::-1]]
    if is_categorical(form):
        shapes += list(np.eye(form.count))
    curves = [np.zeros(form.count)]
    curves += [
        sign * size * form.typical * shape
        for size in (0.5, 2.0, 6.0)
        for shape in shapes
        for sign in (1.0, -1.0)
    ]
    return tuple(tuple(float(value) for value in curve) for curve in curves)


def is_categorical(form: TermForm) -> bool:
    """Return whether a form's nodes are things, such as valves, not values of a quantity."""
    return form.count <= 4


def term_candidate(form: TermForm) -> Candidate:
    """Return a term as a candidate."""
    names = tuple(f"node_{k:02d}" for k in range(form.count))

    def change(setup: Setup, values: dict[str, float]) -> None:
        nodes = tuple(values[name] for name in names)
        grid = {"equation": form.slot, "variable": form.over, "low": form.low, "step": form.step}
        term.change(setup, {**grid, "nodes": nodes})  # type: ignore[dict-item]

    limit = form.most * form.typical
    parameters = tuple(
        EffectParameter(name, form.unit, 0.0, -limit, limit, form.typical) for name in names
    )
    effect = Effect(
        term.id, form.cause_class, term.equation, form.what, parameters, change, nonparametric=True
    )
    # typical sizes by which a node may leave the line of its neighbours, which no stroke may reach
    roughness = 0.0 if is_categorical(form) else 0.5
    return Candidate(
        effect, form.name, parameters, _starts_of(form), roughness=roughness, fills_table=True
    )


def form_of(candidate: Candidate) -> TermForm:
    """Return the form of a term."""
    return next(form for form in FORMS if form.name == candidate.variant)

"""Non-parametric terms, tried when the best named hypothesis leaves structure.

A term is a bounded smooth function in exactly one equation: a candidate like any other, whose
parameters are the values at the nodes of a grid.
Checked by: tests/unit/sil/inference/campaign/test_terms.py
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from plant.effects import Effect, EffectParameter
from plant.effects.effect import Starts
from plant.effects.setup import Setup
from plant.effects.term import FORMS, TermForm, term
from sil.inference.candidate import Candidate, compatible
from sil.inference.evidence import strained
from sil.inference.search import Search, Task
from sil.inference.verdict import Judged, Verdict

ROUGHNESS = 0.5
"""By how many typical sizes a node may leave the line of its neighbours: what no stroke reaches
follows that line."""

SIZES = (0.5, 2.0, 6.0)
"""Where a search begins, in typical sizes, in addition to zero: of either sign and every shape."""

CATEGORIES = 4
"""A grid of so few nodes is one of things, not of a quantity: each alone is a shape too."""


def _starts_of(form: TermForm) -> Starts:
    """Return points to begin a search from: zero; level, rising and falling curves of several sizes."""
    rising = np.linspace(0.0, 1.0, form.count)
    shapes = [np.ones(form.count), rising, rising[::-1]]
    if form.count <= CATEGORIES:
        shapes += list(np.eye(form.count))
    curves = [np.zeros(form.count)]
    curves += [
        sign * size * form.typical * shape
        for size in SIZES
        for shape in shapes
        for sign in (1.0, -1.0)
    ]
    return tuple(tuple(float(value) for value in curve) for curve in curves)


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
    roughness = 0.0 if form.count <= CATEGORIES else ROUGHNESS
    return Candidate(
        effect, form.name, parameters, _starts_of(form), roughness=roughness, fills_table=True
    )


def form_of(candidate: Candidate) -> TermForm:
    """Return the form of a term."""
    return next(form for form in FORMS if form.name == candidate.variant)


TERM_ITERATIONS = 6
MOST_TERMS = 2

SMALL = 1e-3
"""A misfit beyond noise of this share of the healthy model's is a detail of the cause's form."""


def try_terms(search: Search, verdict: Verdict[Judged], judged: Sequence[Judged]) -> bool:
    """Fit non-parametric terms alone and with the best single; True if any was tried.

    Only if the leading hypothesis leaves more than the band of a clean campaign and a detail, or
    owes its agreement to scatter that healthy strokes do not have.
    """
    best = min(judged, key=lambda item: item.score)
    detail = SMALL * max(1.0, verdict.healthy.whole.excess) + best.whole.detail
    if best.whole.beyond <= detail and not strained(best.training):
        return False
    tasks = []
    singles = search.fits.of_size(1)
    parents = [search.healthy]
    if singles and singles[0].cost < 0.5 * search.healthy.cost:
        parents.append(singles[0])
    for candidate in map(term_candidate, FORMS):
        for parent in parents:
            if not compatible(candidate, parent.candidates):
                continue
            starts = tuple((*parent.point, start) for start in candidate.starts)
            begin = (parent.shared, parent.stroke)
            both = (*parent.candidates, candidate)
            tasks.append(Task(both, starts, begin, TERM_ITERATIONS))
    done = search.run_tasks(tasks)
    search.polish(done[:MOST_TERMS])
    return bool(done)

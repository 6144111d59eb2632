"""Non-parametric terms in the kernel: equal to named effects where those are special cases."""

from __future__ import annotations

import numpy as np
import pytest

from plant.effects import CATALOGUE
from plant.parameters import load
from plant.prediction import Predictor, copied
from plant.setup import make_setup
from sil.diagnosis.terms import PLACES, term_candidate
from tests.unit.sil.diagnosis.made_campaign import conditions_of

SAMPLES = (np.arange(1, 400) * 500_000).astype(np.int64)


def states(change, kind: str = "N-B") -> np.ndarray:
    setup = copied(make_setup(load(), conditions_of(kind, 900000.0)))
    change(setup)
    return Predictor(SAMPLES, 1e-9).states(setup)


@pytest.mark.parametrize("place", PLACES, ids=lambda place: place.name)
@pytest.mark.parametrize("kind", ["fixed", "B-N"])
def test_zero_nodes_change_nothing(place, kind: str) -> None:
    candidate = term_candidate(place)
    zero = {p.name: 0.0 for p in candidate.parameters}
    same = states(lambda setup: candidate.change(setup, zero), kind)
    assert np.allclose(same, states(lambda setup: None, kind), rtol=1e-6, atol=5e-8)


@pytest.mark.parametrize(
    ("place", "level", "effect", "values"),
    [
        ("charge flow of pressure", -0.2, "inlet_clog", {"factor": 0.8}),
        ("discharge flow of pressure", -0.3, "exhaust_clog", {"factor": 0.7}),
        ("force of position", 60.0, "external_force", {"force_n": 60.0}),
        ("force of time", 60.0, "external_force", {"force_n": 60.0}),
    ],
)
@pytest.mark.parametrize("kind", ["fixed", "N-B"])
def test_constant_nodes_are_a_named_effect(place, level, effect, values, kind) -> None:
    item = next(p for p in PLACES if p.name == place)
    candidate = term_candidate(item)
    nodes = {p.name: level for p in candidate.parameters}
    term = states(lambda setup: candidate.change(setup, nodes), kind)
    named = states(lambda setup: CATALOGUE[effect].apply(setup, values), kind)
    nominal = states(lambda setup: None, kind)
    assert np.allclose(term, named, rtol=1e-5, atol=1e-8)
    assert not np.allclose(term, nominal, rtol=1e-3, atol=1e-6)


@pytest.mark.parametrize("place", ["friction of position", "friction of speed", "friction of rest"])
def test_constant_resistance_is_coulomb_friction(place: str) -> None:
    candidate = term_candidate(next(p for p in PLACES if p.name == place))
    nodes = {p.name: 40.0 for p in candidate.parameters}

    def more(setup) -> None:
        from plant import layout as L

        setup.p[L.F_LINKAGE] += 40.0

    for kind in ("fixed", "F-N"):
        term = states(lambda setup: candidate.change(setup, nodes), kind)
        assert np.allclose(term, states(more, kind), rtol=1e-6, atol=5e-8)

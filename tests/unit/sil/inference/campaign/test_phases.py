"""Phases of simulated strokes, in their order."""

from __future__ import annotations

import numpy as np

from plant.batch.prediction import Predictor
from plant.parameters import load
from plant.systems.setup import make_setup
from sil.inference.campaign.phases import PHASES, phases
from tests.support.made_campaign import conditions_of

TIME_S = np.arange(1, 3000) * 1e-4


def of(kind: str) -> list[str]:
    setup = make_setup(load(), conditions_of(kind, 900000.0))
    states = Predictor(np.rint(TIME_S * 1e9).astype(np.int64)).states(setup)
    return [PHASES[k] for k in phases(TIME_S, states, setup)]


def order(found: list[str]) -> list[str]:
    return [name for k, name in enumerate(found) if k == 0 or found[k - 1] != name]


def test_the_fixed_piston_breaks_away_moves_and_hits() -> None:
    found = of("fixed")
    assert order(found)[:6] == ["rest", "valve delay", "filling", "breakaway", "motion", "impact"]
    assert order(found)[-1] == "venting"
    assert found[50] == "rest" and found[150] == "valve delay"


def test_in_the_length_stroke_a_piston_walks_first() -> None:
    found = order(of("B-N"))
    assert "walk" in found and "contact" in found
    assert found.index("walk") < found.index("contact")

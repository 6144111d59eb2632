"""Values that cannot be simulated are counted, the same in any number of processes."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from plant.errors import IntegrationError
from sil.inference.campaign.diagnosis import left_out
from sil.inference.candidate import candidates
from sil.inference.fit import Fitter
from sil.inference.refused import Refusals, Tried
from sil.inference.workers import fitted

ALL = {item.name: item for item in candidates(set())}
CLOG, FORCE = (ALL["exhaust_clog"],), (ALL["external_force"],)


class Model:
    """One stroke of one number, which cannot be simulated where a clog's parameter is positive."""

    unit = offsets = ()

    def name_of(self, k):
        return "stroke_001.csv"

    def residual(self, k, shared, scatter, causes):
        if shared[0] > 0.0:
            raise IntegrationError("too many events")
        return np.zeros(1)

    def effect_values(self, causes, scaled):
        return ({"factor": 1.0 + scaled[0]},)


def tried_at(*places: float, workers: int = 1) -> Refusals:
    fitter = Fitter(Model())

    def work(place: float) -> float:
        return fitter.cost(np.array([place]), np.zeros((1, 0)), CLOG, (0,))

    costs = fitted(fitter, work, places, workers)
    assert [np.isinf(cost) for cost in costs] == [place > 0.0 for place in places]
    return fitter.refusals


def test_refused_values_are_counted_and_the_first_is_reported() -> None:
    found = tried_at(-0.5, 0.25, 0.5)
    first = "factor 1.25 in stroke_001.csv: too many events"
    assert found == {"exhaust_clog": Tried(("exhaust_clog",), 3, 2, 0, first)}
    assert str(found["exhaust_clog"]) == (
        f"2 of 3 values tried cannot be simulated: left out; the first: {first}"
    )


def test_the_count_is_the_same_in_two_processes() -> None:
    assert tried_at(-0.5, 0.25, 0.5, workers=2) == tried_at(-0.5, 0.25, 0.5)


def test_the_healthy_model_is_counted_by_the_name_of_its_fit() -> None:
    assert refused((), count=2) == {"healthy": Tried((), 2, 2, 0, "x")}


def test_a_fit_given_up_is_reported_too() -> None:
    found = Refusals()
    found.add(CLOG, None)
    found.lose(CLOG, IntegrationError("the step became too small"))
    text = str(found["exhaust_clog"])
    assert text.endswith(", 1 of its fits given up; the first: the step became too small")


def findings(refusals: Refusals, claimed=(), scores=(), fits=None) -> list[str]:
    fits = fits or {}
    search = SimpleNamespace(first=[], fits=fits, scores=scores)
    training = SimpleNamespace(evidence=lambda: 100.0)
    verdict = SimpleNamespace(
        claimed=claimed, probabilities={}, leader=SimpleNamespace(training=training)
    )
    return [str(item) for item in left_out(refusals, search, verdict, "rig")]


def fit_of(causes, evidence: float) -> SimpleNamespace:
    return SimpleNamespace(candidates=causes, evidence=lambda: evidence)


def refused(causes, count: int = 1, lost: int = 0) -> Refusals:
    found = Refusals()
    for _ in range(count):
        found.add(causes, IntegrationError("x"))
    for _ in range(lost):
        found.lose(causes, IntegrationError("x"))
    return found


def test_refusals_of_a_leading_cause_are_findings_and_others_are_not() -> None:
    both = refused(CLOG)
    both.join(refused(FORCE))
    fits = {item[0].name: fit_of(item, 200.0) for item in (CLOG, FORCE)}
    (text,) = findings(both, claimed=("exhaust_clog",), fits=fits)
    assert text.startswith("rig: exhaust_clog: 1 of 1 value tried")
    assert findings(refused(()), claimed=("exhaust_clog",)) == []  # the healthy model's own


@pytest.mark.parametrize(
    ("scored", "lost", "reported"), [(False, 0, True), (True, 0, False), (True, 1, True)]
)
def test_a_cause_that_was_never_simulated_or_never_fitted_is_reported(
    scored, lost, reported
) -> None:
    scores = [SimpleNamespace(candidate=FORCE[0])] if scored else []
    found = findings(refused(FORCE, lost=lost), scores=scores)
    assert [text.startswith("rig: external_force: not judged: ") for text in found] == [
        True
    ] * reported


@pytest.mark.parametrize(("evidence", "reported"), [(50.0, True), (150.0, False)])
def test_a_better_explanation_that_was_given_up_is_reported(evidence, reported) -> None:
    fits = {"external_force": fit_of(FORCE, evidence)}
    found = findings(refused(FORCE, lost=1), fits=fits)
    assert ["not judged" in text for text in found] == [True] * reported

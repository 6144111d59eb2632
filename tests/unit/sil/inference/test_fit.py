"""The fit on made campaigns: derivatives, recovery, scores."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from plant.errors import IntegrationError
from plant.parameters import Parameter, ParameterSet, load
from sil.inference.campaign.diagnosis import left_out
from sil.inference.candidate import candidates
from sil.inference.evidence import misfit, strained
from sil.inference.fit import Fitter, Refusals, Tried
from sil.inference.screening import Screening, screen
from sil.inference.workers import fitted
from tests.support.made_campaign import made, model_of

ALL = {item.name: item for item in candidates(("internal position", "length stroke"))}


def with_effect(name: str, **values: float) -> ParameterSet:
    base = load()
    table = {
        key: Parameter(
            value, next(p.unit for p in ALL[name].parameters if p.name == key), "hidden by the test"
        )
        for key, value in values.items()
    }
    return ParameterSet(base.name, base.entries, {name: table})


def test_a_clean_campaign_stands_on_the_floor(clean_model) -> None:
    fit = Fitter(clean_model).fit()
    found = misfit(clean_model, fit)
    assert found.rms == pytest.approx(1.0, abs=0.1)
    for name, channel in found.channels.items():
        assert channel.rms < channel.band + 0.02, name
    assert np.all(np.abs(fit.shared) < 4.0)
    assert screen(Fitter(clean_model), fit, list(ALL.values()))[0].gain < 12.0


def test_the_smallest_size_costs_a_healthy_fit_what_it_should(tmp_path) -> None:
    """With the cause at that size in noise-free strokes, no tolerance or scatter explains it."""
    fitter = Fitter(model_of(made(tmp_path, seed=9, count=4)))
    fit = fitter.fit()
    for name in ("valve_open_delay", "exhaust_clog"):
        (score,) = screen(fitter, fit, [ALL[name]])
        value = Screening(fitter, fit).smallest(score, 15.0)
        assert value is not None
        causes, values = (ALL[name],), ({ALL[name].parameters[0].name: value},)
        twin = model_of(made(tmp_path, seed=9, count=4))
        for k in range(twin.size):
            offsets = twin.offset_columns[k] @ fit.shared[len(twin.unit) :]
            twin.measure(k, twin.changed(k, fit.shared, fit.stroke[k], causes, values) + offsets)
        healthy = Fitter(twin).fit(start=fit.shared, scatter=fit.stroke)
        cost = healthy.cost - 0.5 * (np.sum(fit.shared**2) + np.sum(fit.stroke**2))
        assert 8.0 < cost < 25.0, (name, value)


def test_a_size_beyond_its_bounds_would_not_be_noticed(clean_model) -> None:
    fitter = Fitter(clean_model)
    fit = fitter.fit()
    (score,) = screen(fitter, fit, [ALL["exhaust_clog"]])
    assert Screening(fitter, fit).smallest(score, 1e9) is None


def test_a_hidden_effect_is_recovered_with_its_score_first(tmp_path) -> None:
    model = model_of(made(tmp_path, with_effect("exhaust_clog", factor=0.8), seed=5, count=5))
    fitter = Fitter(model)
    healthy = fitter.fit()
    scores = screen(fitter, healthy, list(ALL.values()))
    assert scores[0].gain > 500.0
    assert scores[0].candidate.id == "exhaust_clog"
    start = np.concatenate([np.zeros(healthy.layout.healthy), [-0.5]])
    fit = fitter.fit((ALL["exhaust_clog"],), start=start)
    assert misfit(model, fit).rms == pytest.approx(1.0, abs=0.1)
    assert fit.values[0]["factor"] == pytest.approx(0.8, abs=0.03)
    sd = fit.covariance[-1, -1] ** 0.5 * np.log(1.2)
    assert 0.005 < sd < 0.02  # no better than the unit's own tolerance of its flows
    assert fitter.fit((ALL["inlet_clog"],), start=start).evidence() - fit.evidence() > 100.0


def test_frozen_parameters_stay(clean_model) -> None:
    fitter = Fitter(clean_model)
    n = len(clean_model.layout(()).names)
    start = np.linspace(-0.5, 0.5, n)
    fit = fitter.fit(start=start, use=(0, 1), freeze=range(n), iterations=3)
    assert np.array_equal(fit.shared, start)
    assert np.any(fit.stroke[:2] != 0.0)
    assert np.all(fit.stroke[2:] == 0.0)


def test_scatter_that_healthy_strokes_do_not_have_is_strained() -> None:
    def fit(scatter: np.ndarray, unit: np.ndarray) -> Any:
        layout = SimpleNamespace(healthy=len(unit))
        return SimpleNamespace(
            stroke=scatter, shared=unit, use=tuple(range(len(scatter))), layout=layout
        )

    rng = np.random.default_rng(5)
    for _ in range(200):
        assert not strained(fit(rng.standard_normal((10, 4)), rng.standard_normal(14)))
    wide = rng.standard_normal((10, 4))
    wide[:, 1] *= 3.0
    assert strained(fit(wide, np.zeros(14)))
    assert strained(fit(np.zeros((10, 4)), np.array([*np.zeros(13), 7.9])))
    assert not strained(fit(np.zeros((10, 4)), np.array([*np.zeros(13), 4.5])))


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
    found = findings(refused(FORCE, lost=1), fits={"external_force": fit_of(FORCE, evidence)})
    assert ["not judged" in text for text in found] == [True] * reported

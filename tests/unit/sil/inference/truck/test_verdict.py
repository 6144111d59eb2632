"""From fits to a verdict: one normalised set, and what stands beside failed shifts."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sil.inference.thresholds import UNNAMED
from sil.inference.truck.causes import catalogue
from sil.inference.truck.fit import Fit
from sil.inference.truck.verdict import Verdict, by_id, decide, reported, weighed
from tests.unit.sil.inference.truck.test_causes import only

CAUSES = catalogue()
QUIET: Any = SimpleNamespace(deviating=lambda _fit: 0, model=range(5))
FITTERS = {True: QUIET, False: QUIET}


def fit(name: str, evidence: float, noise: float = 1.0, size: float = 2.0) -> Fit:
    cause = only(name) if name else None
    zeros = np.zeros((1, 1))
    return Fit(cause, size if name else 0.0, zeros[0], zeros, zeros[0], noise, evidence=evidence)


def judged(
    fits: list[Fit],
    far: int = 0,
    failed: int = 0,
    ends: tuple[float, float] = (1.0, 3.0),
    shifts: int = 5,
) -> Verdict:
    fitter: Any = SimpleNamespace(
        deviating=lambda _fit: far,
        misfit_cost=lambda _fit: 50.0,
        profile=lambda _fit: ends,
        model=range(shifts),
    )
    return decide(fits, CAUSES, {True: fitter, False: fitter}, failed)


def test_probabilities_are_one_normalised_set() -> None:
    fits = [fit("", 0.0), fit("detent", 3.0), fit("detent", 2.0), fit("supply_low", 1.0)]
    hypotheses, unnamed = weighed(fits, CAUSES, FITTERS)
    assert len(hypotheses) == 3
    assert sum(item.probability for item in hypotheses) + unnamed == pytest.approx(1.0)
    assert sum(by_id(hypotheses, unnamed).values()) == pytest.approx(1.0)
    leader = max(item.probability for item in hypotheses)
    assert unnamed == pytest.approx(0.02 * leader)


def test_between_causes_evidence_counts_a_third() -> None:
    hypotheses, _ = weighed(
        [fit("", 0.0), fit("detent", 33.0), fit("supply_low", 30.0)], CAUSES, FITTERS
    )
    p = {item.fit.id: item.probability for item in hypotheses}
    assert p["detent"] / p["supply_low"] == pytest.approx(np.e, rel=1e-6)
    assert p["healthy"] < 1e-9


def test_the_evidence_of_a_cause_is_the_mean_over_its_variants() -> None:
    variants = [cause for cause in CAUSES if cause.id == "alpha_speed"]
    fits = [fit("", 0.0), fit("detent", 30.0)]
    fits += [replace(fits[1], cause=cause) for cause in variants]
    hypotheses, _ = weighed(fits, CAUSES, FITTERS)
    p = by_id(hypotheses, 0.0)
    assert len(variants) > 6 and p["alpha_speed"] == pytest.approx(p["detent"])
    # one variant alone: a share of the mean, which counts a third as all evidence does
    hypotheses, _ = weighed(fits[:3], CAUSES, FITTERS)
    p = by_id(hypotheses, 0.0)
    assert p["detent"] / p["alpha_speed"] == pytest.approx(len(variants) ** (1 / 3))


@pytest.mark.parametrize(
    ("evidence", "kind"), [(0.0, "consistent"), (4.5, "cannot_tell"), (30.0, "named")]
)
def test_the_verdict_follows_from_the_probability_of_a_healthy_truck(
    evidence: float, kind: str
) -> None:
    found = judged([fit("", 0.0), fit("detent", evidence)])
    assert found.kind == kind
    assert [item.fit.id for item in found.causes] == (["detent"] if kind == "named" else [])
    assert bool(found.findings) == (kind == "cannot_tell")


def test_causes_that_are_alike_are_ambiguous() -> None:
    found = judged([fit("", 0.0), fit("detent", 31.0), fit("supply_low", 30.0)])
    assert found.kind == "ambiguous"
    assert [item.fit.id for item in found.causes] == ["detent", "supply_low"]


def test_a_cause_whose_interval_holds_nothing_is_not_named() -> None:
    found = judged([fit("", 0.0), fit("detent", 30.0)], ends=(0.0, 3.0))
    assert (found.kind, found.causes) == (UNNAMED, ())


def test_minima_that_are_hardly_worse_widen_the_interval() -> None:
    others = [(30.0, 2.0, 10.0), (28.0, 4.0, 14.0), (20.0, 9.0, 30.0)]
    detents = [replace(fit("detent", e, size=size), cost=cost) for e, size, cost in others]
    assert judged([fit("", 0.0), *detents]).causes[0].interval == (1.0, 4.0)


def test_what_leaves_far_more_than_noise_has_no_name() -> None:
    found = judged([fit("", 0.0, 40.0), fit("detent", 30.0, 30.0)])
    assert (found.kind, found.causes) == (UNNAMED, ())
    # little of what a healthy truck leaves does not keep a cause from being named
    assert judged([fit("", 0.0, 40.0), fit("detent", 90.0, 1.3)]).kind == "named"


@pytest.mark.parametrize(("left", "kind"), [(70.0, UNNAMED), (2.0, "named")])
def test_deviations_that_repeat_beside_a_cause_count_by_their_share(left: float, kind: str) -> None:
    """A cause that explains some positions by noise alone and leaves two shifts far off is not named."""
    fitter: Any = SimpleNamespace(
        deviating=lambda _fit: 2,
        misfit_cost=lambda fit: 150.0 if fit.cause is None else left,
        profile=lambda _fit: (1.0, 3.0),
        model=range(5),
    )
    fits = [fit("", 0.0), fit("detent", 70.0)]
    assert decide(fits, CAUSES, {True: fitter, False: fitter}, 0).kind == kind


@pytest.mark.parametrize("how", [{"failed": 2}, {"far": 2}])
def test_nothing_beside_failures_and_repeated_deviations_is_healthy(how: dict[str, int]) -> None:
    for evidence in (-3.0, 4.5):
        found = judged([fit("", 0.0), fit("detent", evidence)], **how)
        assert found.kind not in ("consistent", "cannot_tell")
        assert found.findings
    assert judged([fit("", 0.0)], **how).kind == UNNAMED


def test_two_shifts_of_which_one_failed_name_no_cause() -> None:
    fits = [fit("", 0.0), fit("detent", 70.0)]
    assert judged(fits, failed=1, shifts=3).kind == "named"
    few = judged(fits, failed=1, shifts=2)
    assert (few.kind, few.causes) == (UNNAMED, ())
    assert few.findings[0] == "1 shift did not reach the gear commanded"
    assert few.findings[1] == "2 shifts cannot tell one cause from another"


def test_one_deviation_does_not_repeat() -> None:
    assert judged([fit("", 0.0)], far=1).kind == "consistent"


def test_of_many_causes_that_are_alike_the_likeliest_are_reported() -> None:
    ids = list(dict.fromkeys(cause.id for cause in CAUSES))
    fits = [fit("", 0.0), *(fit(name, 30.0) for name in ids), fit("detent", 30.0)]
    hypotheses, unnamed = weighed(fits, CAUSES, FITTERS)
    probabilities = by_id(hypotheses, unnamed)
    assert max(p for name, p in probabilities.items() if name != UNNAMED) < 0.1
    assert len(reported(hypotheses, probabilities)) > 15

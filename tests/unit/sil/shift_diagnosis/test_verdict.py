"""What would show, and what looks the same, by hand-made information."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from sil.shift_diagnosis.linear import Linear
from sil.shift_diagnosis.model import Cause, catalogue
from sil.shift_diagnosis.page import alike_of, groups_of, noticed_of
from sil.shift_diagnosis.verdict import (
    ALARM,
    CERTAIN,
    LARGEST,
    Detectable,
    Judged,
    detectable_of,
    distances,
    verdict_of,
    weighed,
)


def only(name: str) -> Cause:
    return next(cause for cause in catalogue() if cause.effect.id == name)


LATE, DELAYED, HOLLOW = only("valve_open_delay"), only("sensor_delay"), only("exhaust_clog")
FORCE, SKEWED = only("external_force"), only("friction_asymmetry")


def linear(causes: list[Cause], slopes: list[list[float]]) -> Linear:
    """One shift whose pulses are shown in full, next to a quantity of the truck that does nothing."""
    columns = np.array([[0.0] * len(slopes[0]), *slopes]).T
    n = len(columns)
    return Linear(
        ("friction",), tuple(causes), np.zeros(1 + len(causes)), (np.zeros(n),), (1e-3 * columns,),
        (1e6 * np.eye(n),), np.zeros(1),
    )  # fmt: skip


def test_the_other_cause_takes_its_best_size() -> None:
    information = np.array([[4.0, 3.0], [3.0, 9.0]])
    d = distances(information, [LATE, DELAYED], 0, 6.0)
    # b = 6 * 3 / 9 = 2: what is left is a^2 (4 - 3^2 / 9)
    assert d == pytest.approx([0.0, 36.0 * 3.0])


def test_the_other_cause_is_physical_and_not_larger_than_the_limit() -> None:
    information = np.array([[100.0, 1.0], [1.0, 0.01]])
    # by b = 6 * 1 / 0.01 = 600 the two would be the same
    allowed = 36.0 * 100.0 - 12.0 * LARGEST + 0.01 * LARGEST**2
    assert distances(information, [LATE, DELAYED], 0, 6.0)[1] == pytest.approx(allowed)
    # of a clog, only a negative size is physical
    assert HOLLOW.sign == -1
    assert distances(information, [LATE, HOLLOW], 0, 6.0)[1] == pytest.approx(3600.0)
    assert distances(information, [HOLLOW, LATE], 0, -6.0)[1] == pytest.approx(3600.0)


def test_of_a_cause_of_both_signs_the_nearer_counts() -> None:
    information = np.array([[1.0, -1.0], [-1.0, 1.0]])
    assert distances(information, [FORCE, LATE], 0, 6.0)[1] == pytest.approx(0.0)
    assert distances(information, [LATE, FORCE], 0, 6.0)[1] == pytest.approx(0.0)
    assert distances(information, [LATE, DELAYED], 0, 6.0)[1] == pytest.approx(36.0)


def test_sizes_end_where_the_parameter_does() -> None:
    low, high = SKEWED.sizes(LARGEST)
    assert (low, high) == pytest.approx((-0.95 / 0.3, 0.95 / 0.3))
    assert LATE.sizes(LARGEST) == (0.0, LARGEST)
    assert HOLLOW.sizes(LARGEST) == (-LARGEST, 0.0)
    assert only("hose_droop").sizes(LARGEST) == (0.0, LARGEST)


def test_what_would_be_noticed_at_no_size_looks_like_no_cause() -> None:
    slopes = [[5.0, 0.0], [5.0, 0.1], [0.0, 1e-6]]
    found = detectable_of(linear([LATE, DELAYED, FORCE], slopes), 3)
    late, delayed, nothing = found
    assert late.size is not None and late.alike == ("sensor_delay",)
    assert delayed.size is not None and delayed.alike == ("valve_open_delay",)
    assert (nothing.size, nothing.value, nothing.alike) == (None, None, ())


def test_causes_are_alike_whichever_was_tested() -> None:
    found = (Detectable(LATE, 1.0, ()), Detectable(DELAYED, 9.0, ("valve_open_delay",)))
    diagnosis = SimpleNamespace(detectable=found)
    assert alike_of(diagnosis, LATE) == ("sensor_delay",)
    assert alike_of(diagnosis, DELAYED) == ("valve_open_delay",)
    (group,) = groups_of(diagnosis)
    assert group["causes"] == ["sensor_delay", "valve_open_delay"]


def test_what_would_show_is_the_first_variant_of_each_cause() -> None:
    bumps = [cause for cause in catalogue() if cause.effect.id == "friction_bump"][:2]
    found = tuple(
        Detectable(cause, size, ())
        for cause, size in ((bumps[0], 4.0), (bumps[1], 2.0), (LATE, 1.0), (FORCE, None))
    )
    assert noticed_of(SimpleNamespace(detectable=found)) == [found[0], found[2]]


def judged(cause: Cause | None, cost: float, shifts: int) -> Judged:
    """A hypothesis whose fit is to so many shifts, a cause's size 1 with a deviation of 0.3."""
    linear = SimpleNamespace(misfit=np.ones(shifts))
    fit = SimpleNamespace(
        cause=cause, linear=linear, estimate=np.ones(1), covariance=np.full((1, 1), 0.09)
    )
    return Judged(fit, cost, 1.0)


@pytest.mark.parametrize(("behind", "shifts", "named"), [
    (3.0, 10, False), (15.0, 10, True), (15.0, 30, True), (15.0, 120, False), (80.0, 120, True),
])  # fmt: skip
def test_evidence_between_causes_ends_where_models_of_trucks_do(
    behind: float, shifts: int, named: bool
) -> None:
    """Of 120 shifts it counts as that of 30; a healthy truck is excluded by all of it."""
    hypotheses = [
        judged(LATE, 0.0, shifts),
        judged(FORCE, behind, shifts),
        judged(None, 15.0, shifts),
    ]
    found = {item.id: item.probability for item in weighed(hypotheses, 20)}
    assert (found["valve_open_delay"] > CERTAIN) == named
    assert found["healthy"] < ALARM
    assert sum(found.values()) == pytest.approx(1.0)


def test_evidence_against_a_cause_counts_no_more_than_it_is_known() -> None:
    hypotheses = [judged(LATE, 0.0, 10), judged(FORCE, 15.0, 10), judged(None, 15.0, 10)]
    sure, unsure = (
        {item.id: item.probability for item in weighed(hypotheses, 20, {FORCE.effect.id: apart})}
        for apart in (1.0, 30.0)
    )
    assert sure["valve_open_delay"] > CERTAIN > unsure["valve_open_delay"] > 0.5
    assert unsure["healthy"] == pytest.approx(sure["healthy"])


def test_many_causes_that_do_next_to_nothing_are_no_alarm_together() -> None:
    others = [cause for cause in catalogue() if cause.effect.id != LATE.effect.id]
    firsts = list({cause.effect.id: cause for cause in others}.values())[:19]
    hypotheses = [judged(cause, 6.0, 120) for cause in firsts]
    hypotheses += [judged(LATE, 0.0, 120), judged(None, 6.0, 120)]
    found = {item.id: item.probability for item in weighed(hypotheses, 20)}
    assert found["healthy"] > ALARM
    # by Bayes' rule: 0.5 e^-6 against 0.5 / 20 (1 + 19 e^-6)
    assert found["healthy"] == pytest.approx(0.0452, abs=1e-3)


@pytest.mark.parametrize(("behind", "spread"), [(20.0, True), (1e4, False)])
def test_probability_of_causes_that_are_not_reported_is_stated(behind: float, spread: bool) -> None:
    causes = list({cause.effect.id: cause for cause in catalogue()}.values())[:20]
    hypotheses = [judged(cause, behind * (k > 1), 120) for k, cause in enumerate(causes)]
    found = weighed([*hypotheses, judged(None, 100.0, 120)], 20)
    probabilities = {item.id: item.probability for item in found}
    shown = [Detectable(cause, 1.0, ()) for cause in causes]
    verdict, findings = verdict_of(found, probabilities, shown)
    assert verdict == "ambiguous"
    others = sorted(p for name, p in probabilities.items() if name != "healthy")[:-2]
    assert (sum(others) > 0.1) == spread
    assert findings == spread * [
        f"the other {sum(others):.2f} of the probability is spread over 18 causes, none above "
        f"{max(others):.2g}"
    ]


@pytest.mark.parametrize(("minima", "verdict"), [((), "named"), ((-0.5, 2.5), "ambiguous")])
def test_a_cause_whose_size_may_be_nil_is_not_named(
    minima: tuple[float, ...], verdict: str
) -> None:
    late = replace(judged(LATE, 0.0, 10), minima=minima)
    found = weighed([late, judged(FORCE, 80.0, 10), judged(None, 80.0, 10)], 20)
    probabilities = {item.id: item.probability for item in found}
    assert verdict_of(found, probabilities, [Detectable(LATE, 1.0, ())])[0] == verdict

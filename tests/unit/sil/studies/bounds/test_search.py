"""The searches: both find, nothing is lost from attempt to attempt, knots do not change a policy."""

from __future__ import annotations

import numpy as np
import pytest
from msgspec.structs import replace

from plant.parameters import load
from sil.studies.bounds.policy import NO_PULSE, Timing, places_of
from sil.studies.bounds.search import Problem, Progress, random_stem, softest_alone

PARAMETERS, TODAY = load("nominal"), Timing(0.008, 0.035)


def test_each_search_is_softer_than_the_plain_push_and_forgets_nothing() -> None:
    problem = Problem(PARAMETERS, TODAY, 0.01, (1300.0,))
    plain_m_s = problem.judge.plain.impact_m_s.max()
    first = problem.cma(Progress(), [], 200)
    assert first.worst_m_s < plain_m_s
    assert problem.judged(first, problem.judge).worst_m_s[0] == first.worst_m_s
    again = problem.cma(Progress(), [], 200)
    assert again == first
    _, unused = places_of("F", len(first.knots_s))
    assert set(first.policy[0, unused.ravel()]) == {NO_PULSE}
    other = problem.differential(first, 128)
    assert other.worst_m_s <= first.worst_m_s and [n for n, *_ in other.history] == [200, 328]


def test_more_knots_are_the_same_policy() -> None:
    problem, rng = Problem(PARAMETERS, TODAY, 0.01, (1300.0,)), np.random.default_rng(5)
    policy, places = problem.answering(Progress(values=random_stem(rng).tolist()), 2)
    values = policy.policy[0]
    values[places[-12:]] = rng.standard_normal(12)
    policy = replace(policy, values=values.tolist())
    finer, _ = problem.answering(policy, 3)
    assert len(finer.values) > len(policy.values)
    np.testing.assert_allclose(problem.answering(finer, 2)[0].values, policy.values)


@pytest.mark.slow
def test_a_load_that_is_known_is_far_softer() -> None:
    assert softest_alone(PARAMETERS, TODAY, 1300.0, 78.0, 3200).worst_m_s < 0.55

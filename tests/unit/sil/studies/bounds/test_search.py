"""The searches: both find, nothing is lost from attempt to attempt, knots do not change a policy."""

from __future__ import annotations

import numpy as np
import pytest
from msgspec.structs import replace

from plant.parameters import load
from sil.studies.bounds.policy import NO_PULSE, SwitchingDelays, places_of
from sil.studies.bounds.search import BoundProblem, SearchProgress, random_stem, softest_alone

PARAMETERS, TODAY = load("nominal"), SwitchingDelays(0.008, 0.035)


def test_each_search_is_softer_than_the_plain_push_and_forgets_nothing() -> None:
    problem = BoundProblem(PARAMETERS, TODAY, 0.01, (1300.0,), impulses_n_s=(100.0, 140.0))
    plain_m_s = problem.judge.plain.impact_m_s.max()
    for search in (problem.cma, problem.linear):
        first = search(SearchProgress(), 200)
        assert first.worst_m_s < plain_m_s
        assert problem.judged(first, problem.judge).worst_m_s[0] == first.worst_m_s
        assert search(SearchProgress(), 200) == first
        _, unused = places_of("F", len(first.knots_s))
        assert set(first.policy[0, unused.ravel()]) == {NO_PULSE}
        second = search(first, 300)
        assert second.worst_m_s <= first.worst_m_s
        assert second.history[:1] == first.history and second.history[1][0] > first.history[0][0]


def test_linear_programs_lower_the_hardest_stop() -> None:
    quick = SwitchingDelays(0.008, 0.005)
    problem = BoundProblem(PARAMETERS, quick, 0.005, (1300.0,), impulses_n_s=(100.0, 140.0))
    (begun,) = problem.begin(np.random.default_rng(0))
    end = problem.linear(SearchProgress(), 900)
    before_m_s, after_m_s = (problem.costs(each, each.policy, 1)[0] for each in (begun, end))
    assert after_m_s < before_m_s - 0.04


def test_more_knots_are_the_same_policy() -> None:
    problem, rng = BoundProblem(PARAMETERS, TODAY, 0.01, (1300.0,)), np.random.default_rng(5)
    policy, places = problem.answering(SearchProgress(values=random_stem(rng).tolist()), 2)
    values = policy.policy[0]
    values[places[-12:]] = rng.standard_normal(12)
    policy = replace(policy, values=values.tolist())
    finer, _ = problem.answering(policy, 3)
    assert len(finer.values) > len(policy.values)
    np.testing.assert_allclose(problem.answering(finer, 2)[0].values, policy.values)


@pytest.mark.slow
def test_a_load_that_is_known_is_far_softer() -> None:
    assert softest_alone(PARAMETERS, TODAY, 1300.0, 78.0, 3200).worst_m_s < 0.4

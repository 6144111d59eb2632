"""The searches: both find, nothing is lost from attempt to attempt, knots do not change a policy."""

from __future__ import annotations

import numpy as np
import pytest

from plant.parameters import load
from sil.studies.bounds.policy import Timing
from sil.studies.bounds.search import (
    Problem,
    Progress,
    evolve,
    random_stem,
    softest_alone_m_s,
    with_knots,
)

PARAMETERS, TODAY = load("nominal"), Timing(0.008, 0.035)


def test_evolution_finds_a_minimum_and_is_reproducible() -> None:
    def costs(points: np.ndarray) -> np.ndarray:
        return np.abs(points - [1.0, -2.0]).max(axis=1)

    best, again = (evolve(costs, np.zeros(2), 1.0, 800, 12, seed=1) for _ in range(2))
    np.testing.assert_allclose(best, [1.0, -2.0], atol=1e-2)
    np.testing.assert_array_equal(best, again)


def test_each_search_is_softer_than_the_plain_push_and_forgets_nothing() -> None:
    problem = Problem(PARAMETERS, TODAY, 0.01, (1300.0,))
    plain_m_s = problem.judge.plain.impact_m_s.max()
    first = problem.cma(Progress(), [], 300)
    assert first.worst_m_s < plain_m_s
    assert problem.judged(first, problem.judge).worst_m_s[0] == first.worst_m_s
    second = problem.cma(first, [Progress()], 100)
    assert second.worst_m_s <= first.worst_m_s and [n for n, *_ in second.history] == [300, 400]
    other = problem.differential(first, 100)
    assert other.worst_m_s <= first.worst_m_s < plain_m_s


def test_more_knots_are_the_same_policy() -> None:
    rng = np.random.default_rng(5)
    values = with_knots(Progress(values=random_stem(rng).tolist()), [0.1, 0.2])
    values = values + rng.standard_normal(len(values))
    policy = Progress(0.0, [0.1, 0.2], values.tolist())
    finer = Progress(0.0, [0.1, 0.15, 0.2], with_knots(policy, [0.1, 0.15, 0.2]).tolist())
    np.testing.assert_allclose(with_knots(finer, [0.1, 0.2]), values)


@pytest.mark.slow
def test_a_load_that_is_known_is_far_softer() -> None:
    assert softest_alone_m_s(PARAMETERS, TODAY, 1300.0, 78.0, 1500) < 0.5

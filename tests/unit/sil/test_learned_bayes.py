"""The Gaussian process of the reference by trials, against closed forms."""

from __future__ import annotations

from math import exp, sqrt

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from tests.bench._learned_bayes import Process, acts, candidates
from tests.bench._learned_programmes import NONE, tidy

OWN = Process(2.0, 0.5, np.array([1.0, 4.0]))


def matern(distance: float) -> float:
    r = sqrt(5.0) * distance
    return 4.0 * (1.0 + r + r * r / 3.0) * exp(-r)


def test_the_kernel_is_that_of_matern() -> None:
    a, b = np.array([[0.0, 0.0]]), np.array([[0.3, -1.6], [0.0, 0.0]])
    assert OWN.kernel(a, b) == pytest.approx(np.array([[matern(0.5), 4.0]]))


def test_one_value_moves_the_mean_by_its_share() -> None:
    """mean k y / (k0 + n2), variance k0 - k2 / (k0 + n2): Rasmussen and Williams 2006, 2.25, 2.26."""
    x, y, new = np.zeros((1, 2)), np.array([3.0]), np.array([[0.0, 0.0], [0.0, 2.0], [90.0, 0.0]])
    mean, sd = OWN.at(new, x, y)
    for k, covariance in enumerate((4.0, matern(0.5), 0.0)):
        assert mean[k] == pytest.approx(covariance / 4.25 * 3.0)
        assert sd[k] == pytest.approx(sqrt(4.0 - covariance**2 / 4.25))


def test_before_any_value_it_is_the_prior() -> None:
    mean, sd = OWN.at(np.ones((3, 2)), np.zeros((0, 2)), np.zeros(0))
    assert mean.tolist() == [0.0] * 3
    assert sd.tolist() == [2.0] * 3


def test_the_evidence_is_the_density_of_the_values() -> None:
    rng = np.random.default_rng(0)
    x, y = rng.standard_normal((12, 2)), rng.standard_normal(12)
    covariance = OWN.kernel(x, x) + 0.25 * np.eye(12)
    expected = multivariate_normal(np.zeros(12), covariance).logpdf(y)
    assert OWN.log_evidence(x, y) == pytest.approx(expected)


def test_a_coordinate_that_says_nothing_gets_a_long_length() -> None:
    rng = np.random.default_rng(1)
    x = rng.uniform(-2.0, 2.0, (60, 2))
    y = np.sin(3.0 * x[:, 0]) + 0.05 * rng.standard_normal(60)
    fitted = Process(1.0, 0.1, np.array([1.0, 1.0])).fitted(x, y)
    assert fitted.lengths[1] > 2.0 * fitted.lengths[0]
    assert fitted.log_evidence(x, y) > Process(1.0, 0.1, np.array([1.0, 1.0])).log_evidence(x, y)
    mean, sd = fitted.at(np.array([[0.5, 0.0]]), x, y)
    assert mean[0] == pytest.approx(np.sin(1.5), abs=3.0 * sd[0] + 0.05)


def test_a_filling_alone_is_the_last_one() -> None:
    none, one = [-1.0] * 4, [12.0, 155.0, -1.0, -1.0]
    found = acts(np.array([none, one, [4.0, 70.0, 12.0, 155.0]]), 0.13)
    first, last = [-0.09, 0.03], [-0.01, 0.035]
    plain = [-0.03, 0.0]
    assert found == pytest.approx(np.array([plain * 2, plain + last, first + last]))


def test_the_candidates_are_the_plain_push_and_tidy_programmes() -> None:
    found = candidates(0.13, np.random.default_rng(0))
    assert np.array_equal(found, tidy(found))
    assert np.array_equal(found[:1], NONE)
    assert (found[1:, 0] >= 0.0).mean() > 0.9
    assert len(np.unique(found, axis=0)) > 1000

"""Minimisation by samples: closed forms, and kinks that stop slopes."""

from __future__ import annotations

import numpy as np
import pytest

from sil.shift_diagnosis.evolution import evolved


def test_the_least_of_a_narrow_ellipsoid_is_found_whatever_its_direction() -> None:
    rng = np.random.default_rng(3)
    axes = np.linalg.qr(rng.normal(size=(6, 6)))[0]
    form = axes @ np.diag(np.logspace(0.0, 4.0, 6)) @ axes.T
    least = rng.normal(size=6)

    def costs(points: list[np.ndarray]) -> np.ndarray:
        return np.array([(p - least) @ form @ (p - least) for p in points])

    found = evolved(costs, np.zeros(6), np.eye(6), 400)
    assert found == pytest.approx(least, abs=1e-3)
    assert np.array_equal(found, evolved(costs, np.zeros(6), np.eye(6), 400))


def test_small_kinks_do_not_hide_the_valley() -> None:
    """Slopes see the kinks alone: there are forty of them between the start and the least."""

    def costs(points: list[np.ndarray]) -> np.ndarray:
        return np.array([np.sum(p**2 + 2.0 * np.abs(np.sin(10.0 * p))) for p in points])

    start = np.full(4, 3.0)
    found = evolved(costs, start, np.eye(4), 200)
    assert costs([found])[0] < 0.1 * costs([start])[0]


def test_nothing_better_is_the_start_itself() -> None:
    def costs(points: list[np.ndarray]) -> np.ndarray:
        return np.array([float(np.abs(p).sum() > 0.0) for p in points])

    assert np.array_equal(evolved(costs, np.zeros(3), np.eye(3), 20), np.zeros(3))

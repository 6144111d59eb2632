"""Minimisation without slopes: the covariance matrix adaptation evolution strategy.

The recorded position has kinks, so a residual has many small minima, and Gauss-Newton steps end in the
nearest. Samples of a whole region see what they have in common.
Source: Hansen, The CMA Evolution Strategy: A Tutorial, arXiv:1604.00772, figure 6 and table 1.
Checked by: tests/unit/sil/shift_diagnosis/test_evolution.py
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np

from sil.shift_diagnosis.linear import Floats

SEED: Final = 1
FIRST_STEP: Final = 0.3
"""Standard deviation of the first samples, as a share of the given one."""
SMALLEST: Final = 1e-3
"""Share at which samples no longer differ."""


def evolved(
    costs: Callable[[list[Floats]], Floats],
    start: Floats,
    covariance: Floats,
    generations: int,
    samples: int = 20,
) -> Floats:
    """Return the best point [p] found around a start [p]; the start itself if none is better.

    costs: of points. covariance [p, p]: the shape of the first samples. Deterministic.
    """
    rng, n = np.random.default_rng(SEED), len(start)
    parents = samples // 2
    raw = np.log((samples + 1) / 2.0) - np.log(np.arange(1.0, parents + 1.0))
    weights = raw / raw.sum()
    effective = 1.0 / float(weights @ weights)
    path_rate = (4.0 + effective / n) / (n + 4.0 + 2.0 * effective / n)
    step_rate = (effective + 2.0) / (n + effective + 5.0)
    damping = 1.0 + 2.0 * max(0.0, np.sqrt((effective - 1.0) / (n + 1.0)) - 1.0) + step_rate
    rank_one = 2.0 / ((n + 1.3) ** 2 + effective)
    rank_many = min(
        1.0 - rank_one, 2.0 * (effective - 2.0 + 1.0 / effective) / ((n + 2.0) ** 2 + effective)
    )
    expected = np.sqrt(n) * (1.0 - 1.0 / (4.0 * n) + 1.0 / (21.0 * n * n))
    # in coordinates in which the first samples are alike in every direction
    first = np.linalg.cholesky(covariance + 1e-9 * np.diag(np.diag(covariance)) + 1e-12 * np.eye(n))
    mean, sigma, shape = np.zeros(n), FIRST_STEP, np.eye(n)
    path, step_path = np.zeros(n), np.zeros(n)
    best, least = start, float(costs([start])[0])
    for generation in range(generations):
        squares, axes = np.linalg.eigh(shape)
        lengths = np.sqrt(np.maximum(squares, 1e-12))
        steps = (rng.normal(size=(samples, n)) * lengths) @ axes.T
        points = [start + first @ (mean + sigma * step) for step in steps]
        found = costs(points)
        order = np.argsort(found)
        if found[order[0]] < least:
            best, least = points[order[0]], float(found[order[0]])
        chosen = steps[order[:parents]]
        step = weights @ chosen
        mean = mean + sigma * step
        white = axes @ ((axes.T @ step) / lengths)
        step_path = (1.0 - step_rate) * step_path + np.sqrt(
            step_rate * (2.0 - step_rate) * effective
        ) * white
        length = float(np.linalg.norm(step_path))
        usual = length / np.sqrt(1.0 - (1.0 - step_rate) ** (2 * (generation + 1)))
        moving = float(usual < (1.4 + 2.0 / (n + 1.0)) * expected)
        path = (1.0 - path_rate) * path + moving * np.sqrt(
            path_rate * (2.0 - path_rate) * effective
        ) * step
        lost = (1.0 - moving) * rank_one * path_rate * (2.0 - path_rate)
        shape = (
            (1.0 - rank_one - rank_many + lost) * shape
            + rank_one * np.outer(path, path)
            + rank_many * (chosen.T * weights) @ chosen
        )
        sigma *= float(np.exp(step_rate / damping * (length / expected - 1.0)))
        if sigma * float(lengths.max()) < SMALLEST:
            break
    return best

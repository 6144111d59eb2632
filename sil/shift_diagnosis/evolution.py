"""Minimisation without slopes by CMA-ES (library `cma`).

The recorded position has kinks, so a residual has many small minima, and Gauss-Newton steps end in the
nearest. Samples of a whole region see what they have in common.
Checked by: tests/unit/sil/shift_diagnosis/test_evolution.py
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from sil.shift_diagnosis.linear import Floats


def evolved(
    costs: Callable[[list[Floats]], Floats],
    start: Floats,
    covariance: Floats,
    generations: int,
    samples: int = 20,
) -> Floats:
    """Return the best point [p] found around a start [p]; the start itself if none is better.

    costs: of points. covariance [p, p]: the shape of the first samples, whose standard deviation is
    0.3 of it. Deterministic.
    """
    import cma

    n = len(start)
    rng = np.random.default_rng(1)
    # in coordinates in which the first samples are alike in every direction
    first = np.linalg.cholesky(covariance + 1e-9 * np.diag(np.diag(covariance)) + 1e-12 * np.eye(n))
    options = {
        "popsize": samples,
        "maxiter": generations,
        "tolx": 1e-3,
        "seed": np.nan,
        "randn": lambda *shape: rng.standard_normal(shape),
        "verbose": -9,
    }
    search = cma.CMAEvolutionStrategy(np.zeros(n), 0.3, options)
    best, least = start, float(costs([start])[0])
    while not search.stop():
        steps = search.ask()
        points = [start + first @ step for step in steps]
        values = costs(points)
        if values.min() < least:
            best, least = points[int(np.argmin(values))], float(values.min())
        search.tell(steps, list(values))
    return best

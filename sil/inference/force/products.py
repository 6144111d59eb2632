"""Least squares from products of columns, group by group, with each group held out in turn.

Checked by: tests/unit/sil/inference/force/test_rig.py
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sil.campaign.campaign import Floats


def products(
    columns: Floats, target: Floats, fold: NDArray[np.int64]
) -> tuple[Floats, Floats, Floats]:
    """Return the products of columns [n, k] and target [n] in each group held out: [f, k, k], [f, k], [f]."""
    rows = [np.flatnonzero(fold == number) for number in np.unique(fold)]
    parts = [(columns[r], target[r]) for r in rows]
    return (
        np.array([c.T @ c for c, _ in parts]),
        np.array([c.T @ y for c, y in parts]),
        np.array([float(y @ y) for _, y in parts]),
    )


def solved(grams: Floats, sides: Floats) -> tuple[Floats, Floats]:
    """Return the solution of products [f, k, k], [f, k]: [k], and with every group held out [f, k]."""
    gram, side = grams.sum(axis=0), sides.sum(axis=0)
    guard = 1e-10 * np.trace(gram) * np.eye(len(side))
    without = np.linalg.solve(gram - grams + guard, (side - sides)[:, :, None])[:, :, 0]
    return np.linalg.solve(gram + guard, side), without


def jackknife(differences: Floats) -> Floats:
    """Return standard deviations [k] from solutions with each group left out, less the whole [f, k].

    Neighbouring samples are not independent; strokes nearly are.
    """
    count = len(differences)
    return np.asarray(np.sqrt((count - 1) / count * np.sum(differences**2, axis=0)))

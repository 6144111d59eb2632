"""Normal equations of a campaign's fit: each stroke's scatter eliminated on its own.

Source: Schur elimination as in bundle adjustment (Triggs et al. 2000).
Checked by: tests/unit/sil/inference/test_fit.py
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sil.inference.problem import Block, Floats, Shared

FARTHEST_SD = 4.5
"""No healthy quantity is tried farther out than this: friction and flows stay positive."""

Inner = dict[int, tuple[Floats, Floats, Floats]]
"""By stroke: inverse of its scatter's information, coupling with the shared parameters, gradient."""

Bounds = dict[int, tuple[NDArray[np.bool_], Floats]]
"""By stroke: which of its scatter is set on its bounds, and how far it moves for that."""


def arrow(
    blocks: dict[int, Block],
    spread: Floats,
    shared: Floats,
    layout: Shared,
    weight: float = 1.0,
    on: Bounds | None = None,
) -> tuple[Floats, Floats, Inner]:
    """Return normal matrix and gradient of the shared parameters, the strokes' scatter eliminated.

    spread: [strokes, scatter]; shared: [shared]; no unit. weight: of the residuals against the
    priors; on: by default what is on its bound and presses outward. Result [shared, shared],
    [shared] and what each stroke's scatter needs.
    """
    n = len(layout.names)
    normal: Floats = np.zeros((n, n))
    gradient: Floats = np.zeros(n)
    inner: Inner = {}
    for k, block in blocks.items():
        r, a, b, aa, hus, bb = _weighted(block, weight)
        if on is None:
            gs: Floats = b.T @ r - spread[k]
            at_bound = (np.abs(spread[k]) >= FARTHEST_SD) & (gs * spread[k] > 0.0)
        else:
            at_bound = np.zeros(b.shape[1], dtype=bool)
            if k in on:
                at_bound, moved = on[k]
                r = r - b @ np.where(at_bound, moved, 0.0)
            gs = b.T @ r - spread[k]
        if at_bound.any():
            hus, bb = np.where(at_bound, 0.0, hus), np.where(at_bound | at_bound[:, None], 0.0, bb)
            gs = np.where(at_bound, 0.0, gs)
        inverse = np.asarray(np.linalg.inv(bb + np.eye(b.shape[1])), dtype=np.float64)
        normal += aa - hus @ inverse @ hus.T
        gradient += a.T @ r - hus @ (inverse @ gs)
        inner[k] = (inverse, hus, gs)
    normal += layout.prior
    gradient -= layout.prior @ shared
    return normal, gradient, inner


def _weighted(block: Block, weight: float) -> tuple[Floats, ...]:
    """Return residual, derivatives by shared and scatter, and the products of these, weighted."""
    if weight not in block.weighted:
        root = weight**0.5
        a, b = root * block.shared, root * block.scatter
        block.weighted.clear()
        block.weighted[weight] = root * block.residual, a, b, a.T @ a, a.T @ b, b.T @ b
    return block.weighted[weight]


def scattered(spread: Floats, inner: Inner, moved: Floats) -> Floats:
    """Return the scatter of strokes that goes with a step `moved` of the shared parameters.

    spread: [strokes, scatters], moved: [shared], both in steps of the fit's scaled parameters.
    """
    there = spread.copy()
    for k, (inverse, hus, gs) in inner.items():
        there[k] += inverse @ (gs - hus.T @ moved)
    return there

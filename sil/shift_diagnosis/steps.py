"""Steps, lines and ramps in weighted estimates: what they explain, and how well they are known.

Checked by: tests/unit/sil/shift_diagnosis/test_track.py
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

LEAST: Final = 1e-12
"""Precision of cells that say nothing of a parameter: differences of sums can be 0 or below."""


def _sums(h: Floats) -> tuple[Floats, Floats]:
    """Return the precision before each cell [m] or [m, p], and from it on; never quite 0."""
    before = np.cumsum(h, axis=0) - h
    after = h.sum(axis=0) - before
    return np.maximum(before, LEAST), np.maximum(after, LEAST)


def of_difference(h: Floats, parts: Floats) -> Floats:
    """Return the part [m, p] of the variance of means after and before each cell, less each other.

    h: precision [m, p] of the cells; parts: squared precision times the variance that counts.
    """
    before_h, after_h = _sums(h)
    before = np.cumsum(parts, axis=0) - parts
    after = parts.sum(axis=0) - before
    found = after / after_h**2
    found[1:] += before[1:] / before_h[1:] ** 2
    return np.asarray(found)


def residual(h: Floats, a: Floats) -> float:
    """Return chi squared of estimates a [m] of precision h [m] about their mean."""
    return float(np.sum(h * (a - np.average(a, weights=h)) ** 2))


def step_gains(h: Floats, a: Floats) -> Floats:
    """Return chi squared gained by a step before each cell [m] or [m, p]; 0 before the first."""
    score = h * a
    before_h, after_h = _sums(h)
    before = np.cumsum(score, axis=0) - score
    after = score.sum(axis=0) - before
    gains = np.zeros_like(h)
    mean = after[1:] / after_h[1:] - before[1:] / before_h[1:]
    gains[1:] = mean**2 / (1.0 / after_h[1:] + 1.0 / before_h[1:])
    return gains


def line_of(t: Floats, a: Floats, h: Floats) -> tuple[Floats, Floats, Floats]:
    """Return the weighted straight line at t [m], its value at 0 and slope [2], covariance [2, 2]."""
    design = np.stack([np.ones_like(t), t], axis=1)
    scale = np.array([1.0, 1.0 / max(1.0, float(np.abs(t).max()))])
    design = design * scale
    covariance = np.linalg.inv(design.T @ (design * h[:, None]) + 1e-12 * np.eye(2))
    estimate = covariance @ (design.T @ (h * a))
    return design @ estimate, estimate * scale, covariance * np.outer(scale, scale)


def ramp_costs(t: Floats, a: Floats, h: Floats) -> Floats:
    """Return chi squared [m] of a level that becomes a line at each cell."""
    rest = a - np.average(a, weights=h)
    ramps = np.maximum(0.0, t - t[:, None])
    ramps -= (ramps @ h / h.sum())[:, None]
    gains = (ramps @ (h * rest)) ** 2 / np.maximum(ramps**2 @ h, 1e-12)
    return np.asarray(np.sum(h * rest**2) - gains)


def drift_instead(t: Floats, a: Floats, h: Floats, at: int, later: Floats) -> tuple[float, float]:
    """Return chi squared that one drift gains, and by how much two changes explain more.

    t, a, h: mid, estimate and precision [m] of the cells; at: the cell of the first change; later: the
    estimates from it on, without its own drift if it is one.
    """
    drift = float(ramp_costs(t, a, h).min())
    second = min(
        float((residual(h[at:], later) - step_gains(h[at:], later)).min()),
        float(ramp_costs(t[at:], later, h[at:]).min()),
    )
    return residual(h, a) - drift, drift - residual(h[:at], a[:at]) - second

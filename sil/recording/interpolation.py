"""Cubic interpolation; importing scipy's would take longer than a whole run."""

from __future__ import annotations

import numpy as np

from sil.recording.run_record import Floats


def hermite(times: Floats, values: Floats, slopes: Floats, at: Floats) -> Floats:
    """Return a cubic Hermite interpolant: [n] in the unit of `values`, for `at` [n] in s.

    `times` in s, `values` and their `slopes` per s: [m]; `at` lies within `times`.

    With s = (t - t_i)/h: y = (1 + 2s)(1 - s)^2 y_i + s (1 - s)^2 h m_i
    + s^2 (3 - 2s) y_i+1 + s^2 (s - 1) h m_i+1.
    """
    i = np.clip(np.searchsorted(times, at, side="right") - 1, 0, len(times) - 2)
    h = times[i + 1] - times[i]
    s = (at - times[i]) / h
    r = 1.0 - s
    return np.asarray(
        r * r * ((1.0 + 2.0 * s) * values[i] + s * h * slopes[i])
        + s * s * ((3.0 - 2.0 * s) * values[i + 1] - r * h * slopes[i + 1])
    )


def monotone_slopes(times: Floats, values: Floats) -> Floats:
    """Return slopes [m], per s, with which the interpolant is monotone wherever its samples are.

    `times` in s and `values`: [m], three or more.

    Weighted harmonic mean of the neighbouring differences, 0 where these change sign; at the ends
    the three-point formula, limited. Source: Fritsch and Butland 1984, as in scipy's PCHIP.
    """
    h, d = np.diff(times), np.diff(values) / np.diff(times)
    slopes = np.zeros(len(times))
    w1, w2 = 2.0 * h[1:] + h[:-1], h[1:] + 2.0 * h[:-1]
    same = d[:-1] * d[1:] > 0.0
    slopes[1:-1][same] = ((w1 + w2)[same]) / (w1[same] / d[:-1][same] + w2[same] / d[1:][same])
    slopes[0] = _end_slope(h[0], h[1], d[0], d[1])
    slopes[-1] = _end_slope(h[-1], h[-2], d[-1], d[-2])
    return slopes


def _end_slope(h0: float, h1: float, d0: float, d1: float) -> float:
    slope = ((2.0 * h0 + h1) * d0 - h0 * d1) / (h0 + h1)
    if slope * d0 <= 0.0:
        return 0.0
    if d0 * d1 <= 0.0 and abs(slope) > 3.0 * abs(d0):
        return 3.0 * d0
    return slope

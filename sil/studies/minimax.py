"""The step that lowers the hardest impact of a policy, as a linear programme of its slopes."""

from __future__ import annotations

import numpy as np

from sil.studies.policies import Arrivals, Floats, Ints

DIFFERENCE = 0.005
"""Step of the finite differences, in 10 ms."""
LATE_M_S_PER_S = 300.0
"""What a late arrival costs while a policy is refined."""
MEAN_WEIGHT = 0.05
"""Weight of the loads that are not the worst."""
EASY = 0.8
"""Branches of loads below this share of the worst load are left as they are."""
LOST_M_S = 6.0
"""Cost of a load that does not arrive."""


def merits(
    arrivals: Arrivals, price_m_s_per_s: float = LATE_M_S_PER_S, late_m_s: float = 0.0
) -> Floats:
    """Return costs [..., loads] in m/s; for a late arrival more: late_m_s and its delay at a price."""
    late_s = np.where(np.isfinite(arrivals.late_s), arrivals.late_s, 0.0)
    cost = arrivals.parts_m_s.max(axis=-1) + price_m_s_per_s * np.maximum(late_s, 0.0)
    cost += late_m_s * (late_s > 0.0)
    found: Floats = np.where(np.isfinite(arrivals.late_s), cost, LOST_M_S)
    return found


def programme(
    active: Ints,
    first: Arrivals,
    second: Arrivals,
    reach: float,
    price_m_s_per_s: float = LATE_M_S_PER_S,
) -> Floats | None:
    """Return the step [variables] in 10 ms, at most `reach`, that lowers the worst impact most.

    Variables of the segments, active [n, 2], then of the branch of each load. Loads whose arrival a variable does
    not change have a slope of NaN.
    """
    from scipy.optimize import linprog

    base, late_s = second.parts_m_s[0, 0], second.late_s[0, 0]
    loads, parts = base.shape
    n, size = len(active), len(second.late_s) - 1
    width = n + loads * size

    def slope(found: Floats, at: Floats, most: float) -> Floats:
        slopes = (found - at) / DIFFERENCE
        known: Floats = np.where(np.isfinite(slopes), slopes, 0.0)
        return np.clip(known, -most, most)

    def rows(stem: Floats, own: Floats, load: int) -> Floats:
        row = np.zeros(width + 2 * loads + 1)
        row[:n] = stem
        row[n + load * size : n + (load + 1) * size] = own
        return row

    matrix, limits = [], []
    for load in range(loads):
        for part in range(parts):
            at = base[load, part]
            if at < 0.3 * base[load].max():
                continue
            row = rows(
                slope(first.parts_m_s[:, 0, load, part], at, 50.0),
                slope(second.parts_m_s[1:, 0, load, part], at, 50.0),
                load,
            )
            row[width + load] = -1.0
            matrix.append(row)
            limits.append(-at)
        row = rows(
            1e3 * slope(first.late_s[:, 0, load], late_s[load], 0.05),
            1e3 * slope(second.late_s[1:, 0, load], late_s[load], 0.05),
            load,
        )
        row[width + loads + 1 + load] = -1.0
        matrix.append(row)
        limits.append(-1e3 * late_s[load] - 0.005)
        row = np.zeros(width + 2 * loads + 1)
        row[width + load], row[width + loads] = 1.0, -1.0
        matrix.append(row)
        limits.append(0.0)
    price = np.zeros(width + 2 * loads + 1)
    price[width : width + loads] = MEAN_WEIGHT
    price[width + loads] = 1.0
    price[width + loads + 1 :] = 1e-3 * price_m_s_per_s
    bounds = np.zeros((len(price), 2))
    bounds[:width] = -reach, reach
    easy = base.max(axis=1) < EASY * base.max()
    bounds[n:width][np.repeat(easy, size)] = 0.0
    bounds[width:, 1] = np.inf
    result = linprog(price, np.array(matrix), np.array(limits), bounds=bounds, method="highs")
    return None if result.x is None else result.x[:width]

"""Position-driven mode: a measured motion in, pressures of the fixed piston's chambers out (thesis 3.4.2)."""

from __future__ import annotations

import numpy as np

from plant.effects.setup import Setup
from plant.systems.driven import chamber_along
from plant.systems.stroke import valve_moves


def pressures_along(setup: Setup, time_s: np.ndarray, position_m: np.ndarray) -> np.ndarray:
    """Pressures [n, 2] of the fixed piston's chambers along a measured position [Pa]."""
    conditions = setup.conditions
    p = setup.p
    time_s = np.asarray(time_s, dtype=np.float64)
    moves = valve_moves(setup, round(float(time_s[-1]) * 1e9))
    out = np.zeros((2, len(time_s)))
    volumes = (p.vol_b + p.area_p * position_m, p.vol_n - p.area_p2 * position_m)
    for index, volume in enumerate(volumes):
        charged = conditions.chambers[index] in conditions.charged_before
        rows = [(0.0, float(charged), 0.0)]
        rows += [(t * 1e-9, u, slope) for t, which, u, slope in moves if which == index]
        begin = p.p_supply if charged else p.p_atm
        chamber_along(time_s, volume, begin, np.array(rows), p.array, setup.c, out[index])
    return np.ascontiguousarray(out.T)

"""Position-driven mode: a measured motion in, pressures of the fixed piston's chambers out (thesis 3.4.2)."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from scipy.integrate import solve_ivp

from plant.effects.setup import Setup
from plant.kernel.compiled import kernel
from plant.kernel.layout import flow_map, parameters
from plant.parts.chamber import chamber
from plant.systems.stroke import valve_moves


@kernel
def pressure_rate(pressure, u, volume, rate, p, c):  # type: ignore[no-untyped-def]
    p = parameters(p)
    alphas = (p.alpha_m1, p.alpha_1, p.alpha_m2, p.alpha_2)
    flows = flow_map(c)
    return chamber(pressure, p.t_gas, u, 0.0, volume, rate, p.p_supply, alphas, p, flows)[0]


def pressures_along(setup: Setup, time_s: np.ndarray, position_m: np.ndarray) -> np.ndarray:
    """[n, 2] in Pa, of valves that move at once; the position is straight between samples."""
    p = setup.p
    moves = valve_moves(setup, round(float(time_s[-1]) * 1e9))

    def along(which: int, volumes: np.ndarray) -> np.ndarray:
        rates = np.append(np.diff(volumes) / np.diff(time_s), 0.0)

        def slope(t: float, pressure: np.ndarray, u: float) -> float:
            rate = rates[np.searchsorted(time_s, t, side="right") - 1]
            volume = np.interp(t, time_s, volumes)
            return float(pressure_rate(pressure[0], u, volume, rate, p.array, setup.c))

        edges_s = [0.0, *(t * 1e-9 for t, chamber, *_ in moves if chamber == which), time_s[-1]]
        pressures, last = np.empty(len(time_s)), p.p_atm
        for k, ends in enumerate(pairwise(edges_s)):
            inside = (time_s >= ends[0]) & (time_s <= ends[1])
            how = {"args": (float(k % 2),), "max_step": 1e-4, "rtol": 1e-8, "atol": 1.0}
            solved = solve_ivp(slope, ends, [last], dense_output=True, **how)
            pressures[inside], last = solved.sol(time_s[inside])[0], solved.y[0, -1]
        return pressures

    volumes = p.vol_b + p.area_p * position_m, p.vol_n - p.area_p2 * position_m
    return np.column_stack([along(k, volume) for k, volume in enumerate(volumes)])

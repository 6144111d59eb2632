"""Enclosures of the held actuator and of the stay's motion, for `sil.studies.lower_bound`.

Each function names the lemma of docs/explanation/lower_bound.md that it uses.
"""

# mypy: disallow-untyped-defs=False

from __future__ import annotations

from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from can_dbc.errors import InputError
from plant.kernel.layout import Parameters
from plant.parameters import ParameterSet

Floats = NDArray[np.float64]

STEP_S = 2.5e-4
SLACK_PA, SLACK_N = 1e-3, 1e-3
"""Widening of pressures and forces in each step, far above rounding (1e-9)."""
MAP_SLACK = 2e-3
"""Share by which compared pressures may differ: f_out(P)/P is monotone but for a quarter of it."""

compiled: Any = numba.njit(cache=True)
"""All compiled functions are in this file, so that numba's cache notices every edit."""


@compiled
def charge(p_pa, maps):
    """Return f_in(P) [K kg/s], 0 above the supply."""
    y = max(p_pa / maps[0], maps[1])
    if y > 1.0:
        return 0.0
    if y < maps[2]:
        return maps[0] * (maps[3] + y * (maps[4] + y * (maps[5] + y * maps[6])))
    return maps[0] * (maps[7] + y * (maps[8] + y * (maps[9] + y * (maps[10] + y * maps[11]))))


@compiled
def discharge(p_pa, maps):
    """Return f_out(P) [K kg/s], 0 below the atmosphere."""
    z = p_pa / maps[12]
    if z < 1.0:
        return 0.0
    if z < maps[13]:
        return maps[12] * (
            maps[14] + z * (maps[15] + z * (maps[16] + z * (maps[17] + z * maps[18])))
        )
    return maps[12] * (maps[19] + z * (maps[20] + z * maps[21]))


@compiled
def chamber_bounds(surely, possibly, low_pa, high_pa, fill, vent, maps, low, high):
    """Enclose the pressure of a chamber of constant volume [Pa] -> low, high [steps + 1].

    surely, possibly: steps in which its valve is open under all, under some of the commands.
    fill, vent: R alpha_m / V [1/(K kg) Pa]. f_in falls and f_out grows with the pressure (Lemma 1).
    """
    atmosphere = maps[12]
    low[0], high[0] = low_pa, high_pa
    for i in range(len(surely)):
        if surely[i]:
            top = low_pa + STEP_S * fill * charge(low_pa, maps)
            low_pa += STEP_S * fill * charge(top, maps)
        else:
            low_pa -= STEP_S * vent * discharge(low_pa, maps)
        if possibly[i]:
            high_pa += STEP_S * fill * charge(high_pa, maps)
        else:
            bottom = max(high_pa - STEP_S * vent * discharge(high_pa, maps), atmosphere)
            high_pa -= STEP_S * vent * discharge(bottom, maps)
        low_pa = max(low_pa - SLACK_PA, atmosphere)
        high_pa += SLACK_PA
        low[i + 1], high[i + 1] = low_pa, high_pa


@compiled
def extremes(low_b, high_n, begin, end, from_s, to_s, own, fill, maps):
    """Return the lowest P_B and highest P_N [Pa] of the held actuator some time after the release.

    begin, end: first and last step of the release; from_s, to_s: time after it. own: steps after
    which the commands are the load's own: the most braking ones. fill: of `chamber_bounds`, of N.
    """
    last = len(low_b) - 1
    first = min(begin + int(from_s / STEP_S), last)
    p_b, p_n = low_b[first], high_n[first]
    until = end + int(to_s / STEP_S) + 1
    for i in range(first, min(until, end + own, last) + 1):
        p_b = min(p_b, low_b[i])
        p_n = max(p_n, high_n[i])
    if until >= begin + own - 1:
        for i in range(max(min(begin + own - 1, last), 0), min(end + own, last) + 1):
            p_b = min(p_b, low_b[i])
            p_n = max(p_n, high_n[i])
        p_n += max(0.0, to_s - (own - 2) * STEP_S) * fill * charge(p_n, maps)
    return max(p_b, maps[12]), p_n


@compiled
def stop_speed(low_b, high_n, begin, end, own, fill, maps, path, body):
    """Return a speed [m/s] that the stay has at least at its stop; 0 if it may turn back (Lemma 4).

    path [6, x]: position, volume ratios of B and N to the power 1.05, barrier, earliest time, in SI
    units; body: A, A_p, A_s, mass, friction, viscous friction, static friction, P_F.
    """
    area, area_p, area_s, mass, run_n, beta, static_n, p_f = body
    speed = energy = time_s = 0.0
    for i in range(path.shape[1] - 1):
        dx = path[0, i + 1] - path[0, i]
        guess_s = 2e-3 if i == 0 else dx / speed
        after = 0.0
        for _ in range(60):
            p_b, p_n = extremes(
                low_b, high_n, begin, end, path[4, i], time_s + guess_s, own, fill, maps
            )
            drive = (1.0 - MAP_SLACK) * path[1, i + 1] * area * p_b
            drive -= (1.0 + MAP_SLACK) * path[2, i + 1] * area_p * p_n + area_s * p_f + path[3, i]
            if i == 0 and drive <= static_n:
                return 0.0
            fastest = np.sqrt(2.0 * max(energy, energy + drive * dx) / mass)
            after = energy + (drive - run_n - beta * fastest - SLACK_N) * dx
            if after <= 0.0:
                return 0.0
            needed_s = 2.0 * dx / (speed + np.sqrt(2.0 * after / mass)) * (1.0 + 1e-9)
            if needed_s <= guess_s:
                break
            guess_s = max(1.2 * guess_s, 1.02 * needed_s)
        else:
            return 0.0
        energy = after
        speed = np.sqrt(2.0 * energy / mass) * (1.0 - 1e-12)
        time_s += needed_s
    return speed


def map_coefficients(parameters: ParameterSet, p: Parameters) -> Floats:
    """Return supply, limits and polynomials of both flow maps, in SI units, as `charge` takes them [22]."""
    value, values = parameters.value, parameters.values
    charging = ("flow_charge.y_min", "flow_charge.y_split")
    return np.array(
        [
            p.p_supply,
            *(value(name) for name in charging),
            *values("flow_charge.c_high"),
            *values("flow_charge.c_low"),
            p.p_atm,
            value("flow_discharge.z_split"),
            *values("flow_discharge.c_low"),
            *values("flow_discharge.c_high"),
        ]
    )


def check_maps(maps: Floats) -> None:
    """Refuse flow maps [22], in SI units, without the monotony that Lemma 1 and 2 need. Raises InputError.

    The slope between the points of a fine grid is bounded by the greatest second derivative.
    """
    supply, y_min, y_split, atmosphere, z_split = maps[[0, 1, 2, 12, 13]]
    top = 1.1 * supply / atmosphere
    pieces = (
        (maps[3:7], y_min, y_split, -1.0),
        (maps[7:12], y_split, 1.0, -1.0),
        (maps[14:19], 1.0, z_split, 1.0),
        (maps[19:22], z_split, top, 1.0),
    )
    wrong = [k for k, piece in enumerate(pieces) if not is_monotone(*piece)]
    joints = (maps[3:7], maps[7:12], y_split), (maps[14:19], maps[19:22], z_split)
    jumps = [abs(np.polyval(a[::-1], at) / np.polyval(b[::-1], at) - 1.0) for a, b, at in joints]
    z = np.linspace(1.0, top, 20_000)
    share = np.array([discharge(atmosphere * each, maps) for each in z]) / z
    falls = np.maximum.accumulate(share) > (1.0 + 0.25 * MAP_SLACK) * share
    if wrong or max(jumps) > 1e-6 or falls[1:].any():
        raise InputError(
            "bound: expected flow maps of which f_in falls and f_out and f_out/P grow with P, "
            "which the proof of the lower bound covers"
        )


def is_monotone(coefficients: Floats, low: float, high: float, sign: float) -> bool:
    """Return whether a polynomial (ascending coefficients [k], any unit) has a slope of one sign."""
    x, half = np.linspace(low, high, 20_001, retstep=True)
    first = np.polynomial.polynomial.polyder(coefficients)
    second = np.polynomial.polynomial.polyder(np.abs(first))
    steepest = np.polynomial.polynomial.polyval(high, second)
    slope = sign * np.polynomial.polynomial.polyval(x, first)
    return bool((slope > float(half) * steepest).all())

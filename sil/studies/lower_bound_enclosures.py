"""Enclosures of the held actuator and of the stay's motion, for `sil.studies.lower_bound`.

Each function names the lemma of docs/explanation/lower_bound.md that it uses.
"""

# mypy: disallow-untyped-defs=False

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from can_dbc.errors import InputError
from plant.kernel.compiled import kernel
from plant.kernel.layout import FlowMap, flow_map
from plant.parts.flow import charge, discharge

Floats = NDArray[np.float64]

STEP_S = 2.5e-4
SLACK_PA, SLACK_N = 1e-3, 1e-3
"""Widening of pressures and forces in each step, far above rounding (1e-9)."""
MAP_SLACK = 2e-3
"""Share by which compared pressures may differ: f_out(P)/P is monotone but for a quarter of it."""


@kernel
def chamber_bounds(surely, possibly, low_pa, high_pa, fill, vent, air, low, high):
    """Enclose the pressure of a chamber of constant volume [Pa] -> low, high [steps + 1].

    surely, possibly: steps in which its valve is open under all, under some of the commands.
    fill, vent: R alpha_m / V [1/(K kg) Pa]; air: supply, atmosphere [Pa], `FlowMap`. f_in falls and f_out grows with the pressure (Lemma 1).
    """
    supply, atmosphere, c = air[0], air[1], flow_map(air[2])
    low[0], high[0] = low_pa, high_pa
    for i in range(len(surely)):
        if surely[i]:
            top = low_pa + STEP_S * fill * max(charge(low_pa, supply, c), 0.0)
            low_pa += STEP_S * fill * max(charge(top, supply, c), 0.0)
        else:
            low_pa -= STEP_S * vent * max(discharge(low_pa, atmosphere, c), 0.0)
        if possibly[i]:
            high_pa += STEP_S * fill * max(charge(high_pa, supply, c), 0.0)
        else:
            out = max(discharge(high_pa, atmosphere, c), 0.0)
            bottom = max(high_pa - STEP_S * vent * out, atmosphere)
            high_pa -= STEP_S * vent * max(discharge(bottom, atmosphere, c), 0.0)
        low_pa = max(low_pa - SLACK_PA, atmosphere)
        high_pa += SLACK_PA
        low[i + 1], high[i + 1] = low_pa, high_pa


@kernel
def extremes(low_b, high_n, begin, end, from_s, to_s, own, fill, air):
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
        alone_s = max(0.0, to_s - (own - 2) * STEP_S)
        p_n += alone_s * fill * max(charge(p_n, air[0], flow_map(air[2])), 0.0)
    return max(p_b, air[1]), p_n


@kernel
def stop_speed(low_b, high_n, begin, end, own, fill, air, path, body):
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
                low_b, high_n, begin, end, path[4, i], time_s + guess_s, own, fill, air
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


def check_maps(c: FlowMap, supply_pa: float, atmosphere_pa: float) -> None:
    """Refuse flow maps without the monotony that Lemma 1 and 2 need. Raises InputError.

    The slope between the points of a fine grid is bounded by the greatest second derivative.
    """
    top = 1.1 * supply_pa / atmosphere_pa
    pieces = (
        (c.charge_high, c.y_min, c.y_split, -1.0),
        (c.charge_low, c.y_split, 1.0, -1.0),
        (c.discharge_low, 1.0, c.z_split, 1.0),
        (c.discharge_high, c.z_split, top, 1.0),
    )
    monotone = all(is_monotone(*piece) for piece in pieces)
    value = np.polynomial.polynomial.polyval
    jumps = [
        abs(value(at, a) / value(at, b) - 1.0)
        for a, b, at in (
            (c.charge_high, c.charge_low, c.y_split),
            (c.discharge_low, c.discharge_high, c.z_split),
        )
    ]
    z = np.linspace(1.0, top, 20_000)
    share = np.where(z < c.z_split, value(z, c.discharge_low), value(z, c.discharge_high)) / z
    falls = np.maximum.accumulate(share) > (1.0 + 0.25 * MAP_SLACK) * share
    if not monotone or max(jumps) > 1e-6 or falls[1:].any():
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

"""Chapter 4.1 and 6.3: the quickest soft stop, by optimal control with valves that may be half open.

Minimise the arrival of the fixed piston subject to an impact of at most `SOFT_M_S`, over controls
0 <= u <= 1 of both valves, constant over intervals of `STEP_S`. All process exponents are 1: only then
do the equations depend linearly on u, as Pontryagin's principle asks for a bang-bang solution. The
derivative of the Lagrangian by u in an interval is the integral of the costates' switching function
over it; sequential linear programmes with a trust region find a point that satisfies its signs.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linprog

from plant.batch.batch import Strokes, simulate_batch
from plant.effects.stroke_conditions import StrokeConditions
from plant.systems.setup import make_setup
from tests.claims.claim import Outcome, judged
from tests.claims.strokes import SUPPLY_PA, nominal

Floats = NDArray[np.float64]

SOFT_M_S = 0.3
STEP_S = 1.2e-3
INTERVALS = 20
CHANGE = 1e-4
PRICE_MS = 200.0
"""Merit of an impact that is too hard, ms per m/s."""
ROUNDS = 250


def _arrivals(controls: Floats) -> tuple[Floats, Floats]:
    """Return arrival [n] in ms and impact [n] in m/s under controls [n, 2 INTERVALS]."""
    exponents = {f"alpha.{name}": 1.0 for name in ("alpha_m1", "alpha_1", "alpha_m2", "alpha_2")}
    conditions = StrokeConditions("fixed", SUPPLY_PA, ((0.0, "1", 0.98),))
    base = Strokes.from_setups([make_setup(nominal().override(exponents), conditions)], 0.1)
    n = len(controls)
    switches = np.zeros((n, 2 * INTERVALS, 4))
    switches[:, :, 0] = np.repeat(STEP_S * np.arange(INTERVALS), 2)
    switches[:, 1::2, 1] = 1.0
    switches[:, 0::2, 2], switches[:, 1::2, 2] = np.hsplit(controls, 2)
    packed = np.repeat(base.packed, n, axis=0)
    found = simulate_batch(replace(base, packed=packed, switches=switches), lanes=False)
    return 1e3 * found.arrival_s, found.impact_speed_m_s


def _derivatives(u: Floats) -> tuple[float, float, Floats, Floats]:
    """Return arrival, impact, and their derivatives by each control."""
    side = CHANGE * np.where(u > 0.5, -1.0, 1.0)
    late_ms, speed_m_s = _arrivals(np.vstack([u, u + np.diag(side)]))
    by_time, by_speed = ((x[1:] - x[0]) / side for x in (late_ms, speed_m_s))
    return float(late_ms[0]), float(speed_m_s[0]), by_time, by_speed


def quickest(u: Floats) -> tuple[Floats, float, Floats]:
    """Return the best controls from a start [2 INTERVALS], the arrival in ms, the Lagrangian's derivative.

    Controls are shares of full opening; the derivative [2 INTERVALS] is in ms.
    """

    def merit(late_ms: float, speed_m_s: float) -> float:
        return late_ms + PRICE_MS * max(0.0, speed_m_s - SOFT_M_S)

    radius, (late_ms, speed, by_time, by_speed) = 0.3, _derivatives(u)
    for _ in range(ROUNDS):
        ends = zip(np.maximum(-u, -radius), np.minimum(1.0 - u, radius), strict=True)
        step = linprog(
            np.append(by_time, PRICE_MS),
            A_ub=np.append(by_speed, -1.0)[None],
            b_ub=[SOFT_M_S - speed],
            bounds=[*ends, (0.0, None)],
        )
        trial = np.clip(u + step.x[:-1], 0.0, 1.0)
        found = _derivatives(trial)
        if merit(*found[:2]) < merit(late_ms, speed) - 1e-9:
            u, (late_ms, speed, by_time, by_speed) = trial, found
            radius = min(0.5, 1.5 * radius)
        else:
            radius *= 0.5
        if radius < 1e-5:
            break
    between = (u > 0.02) & (u < 0.98) & (by_speed != 0.0)
    price = -by_time[between] @ by_speed[between] / (by_speed[between] @ by_speed[between])
    return u, late_ms, by_time + price * by_speed


def _f64_bang_bang() -> Outcome:
    rng = np.random.default_rng(0)
    push = np.concatenate([np.ones(INTERVALS), np.zeros(INTERVALS)])
    starts = (push, np.abs(push - 0.4 * rng.random(2 * INTERVALS)))
    (u, late_ms, slope), (_, other_ms, _) = (quickest(start) for start in starts)
    acts = np.tile(STEP_S * np.arange(INTERVALS) < 1e-3 * late_ms, 2)
    between = acts & (u > 0.02) & (u < 0.98)
    right = np.where(u > 0.5, slope <= 1e-3, slope >= -1e-3)[acts & ~between]
    good = between.sum() <= 2 and bool(right.all()) and abs(late_ms - other_ms) < 1e-3
    switch_ms = 1e3 * STEP_S * float(u[:INTERVALS].sum())
    counts = int(between.sum()), int(acts.sum()), int(right.sum()), len(right)
    return judged(good, late_ms, SOFT_M_S, switch_ms, *counts)

"""Phases of a stroke: valve delay, filling, walk, breakaway, contact, motion, impact, venting, return.

Checked by: tests/unit/sil/diagnosis/test_phases.py
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from plant.effects.setup import Setup
from plant.kernel.layout import FIXED, FixedState, LengthState

Floats = NDArray[np.float64]

PHASES = (
    "rest",
    "valve delay",
    "filling",
    "walk",
    "breakaway",
    "contact",
    "motion",
    "impact",
    "venting",
    "return",
)

MOVING_M_S = 1e-3
EDGE_S = 0.003
"""Breakaway, contact and impact last this long."""


def phases(time_s: Floats, states: Floats, setup: Setup) -> NDArray[np.int64]:
    """Phase of every instant, as indices of PHASES, from the simulated motion.

    Breakaway is the start of a motion from rest, contact one that a walking piston brought about,
    return a motion after the driving chamber's valve has closed.

    time_s: [n] in s; states: [n, states] in SI units; result [n].
    """
    conditions = setup.conditions
    fixed = conditions.system == FIXED
    name = {phase: k for k, phase in enumerate(PHASES)}
    out = np.full(len(time_s), name["rest"], dtype=np.int64)
    opens = [t for t, _v, duty in conditions.commands if duty >= setup.timing.duty_open]
    closes = [t for t, _v, duty in conditions.commands if duty <= setup.timing.duty_closed]
    begin = min(opens, default=min(closes, default=0.0))
    open_s = begin + setup.timing.rise_ns / 1e9
    out[time_s >= begin] = name["valve delay"]
    out[time_s >= open_s] = name["filling"]
    later = [t for t in closes if t > begin]
    vent_s = min(later) + setup.timing.fall_ns / 1e9 if later else np.inf
    out[time_s >= vent_s] = name["venting"]
    speed = np.abs(states[:, FixedState.v if fixed else LengthState.v_s])
    stay = speed > MOVING_M_S
    if not fixed:
        pistons = (
            np.maximum(np.abs(states[:, LengthState.v_1]), np.abs(states[:, LengthState.v_2]))
            > MOVING_M_S
        )
        out[pistons & ~stay & (time_s < vent_s)] = name["walk"]
    else:
        pistons = np.zeros(len(time_s), dtype=bool)
    out[stay] = name["motion"]
    out[stay & (time_s >= vent_s)] = name["return"]
    for first, last in runs(stay):
        walked = first > 0 and pistons[first - 1]
        start = (time_s >= time_s[first]) & (time_s < time_s[first] + EDGE_S) & stay
        if time_s[first] < vent_s:
            out[start] = name["contact"] if walked else name["breakaway"]
        if last + 1 < len(time_s):
            end = time_s[last]
            out[(time_s > end - 0.5 * EDGE_S) & (time_s <= end + EDGE_S)] = name["impact"]
    return out


def runs(flags: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """First and last index of every run of true values.

    flags: [n].
    """
    edges = np.diff(np.concatenate([[0], flags.astype(np.int8), [0]]))
    begins, ends = np.flatnonzero(edges == 1), np.flatnonzero(edges == -1) - 1
    return [(int(a), int(b)) for a, b in zip(begins, ends, strict=True)]

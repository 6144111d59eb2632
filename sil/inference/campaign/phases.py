"""Phases of a stroke: valve delay, filling, walk, breakaway, contact, motion, impact, venting, return.

Checked by: tests/unit/sil/inference/campaign/test_phases.py
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from plant.effects.setup import Setup
from plant.kernel.layout import FIXED, FixedState, LengthState
from sil.campaign.campaign import Floats
from sil.recording.runs import true_runs

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
    number = {phase: k for k, phase in enumerate(PHASES)}
    out = np.full(len(time_s), number["rest"], dtype=np.int64)
    opens = [t for t, _v, duty in conditions.commands if duty >= setup.timing.duty_open]
    closes = [t for t, _v, duty in conditions.commands if duty <= setup.timing.duty_closed]
    begin = min(opens, default=min(closes, default=0.0))
    later = [t for t in closes if t > begin]
    vent_s = min(later) + setup.timing.fall_ns / 1e9 if later else np.inf
    out[time_s >= begin] = number["valve delay"]
    out[time_s >= begin + setup.timing.rise_ns / 1e9] = number["filling"]
    out[time_s >= vent_s] = number["venting"]
    if conditions.system == FIXED:
        stay = np.abs(states[:, FixedState.v]) > MOVING_M_S
        pistons = np.zeros(len(time_s), dtype=bool)
    else:
        stay = np.abs(states[:, LengthState.v_s]) > MOVING_M_S
        both = np.abs(states[:, [LengthState.v_1, LengthState.v_2]])
        pistons = both.max(axis=1) > MOVING_M_S
    out[pistons & ~stay & (time_s < vent_s)] = number["walk"]
    out[stay] = number["motion"]
    out[stay & (time_s >= vent_s)] = number["return"]
    for first, beyond in true_runs(stay):
        walked = first > 0 and pistons[first - 1]
        start = (time_s >= time_s[first]) & (time_s < time_s[first] + EDGE_S) & stay
        if time_s[first] < vent_s:
            out[start] = number["contact" if walked else "breakaway"]
        if beyond < len(time_s):
            end = time_s[beyond - 1]
            out[(time_s > end - 0.5 * EDGE_S) & (time_s <= end + EDGE_S)] = number["impact"]
    return out

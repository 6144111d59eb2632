"""One equation at a time: a measured motion in, pressures out; measured pressures in, motion out.

`pressures_along` (thesis 3.4.2) leaves the stay's force balance out: its friction plays no part, so a
deviation belongs to flow, volume, exponents or valve timing.  `motion_along` leaves the chambers
out: a deviation belongs to friction, masses or loads.  Both systems; all contacts and stops as in the
whole model.
Checked by: tests/physics/test_driven.py
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np

from plant.effects.setup import Setup
from plant.equations.length_stroke import TOUCH_M
from plant.integrator.hybrid import NS
from plant.kernel.layout import LengthState, pressure_slice
from plant.kernel.packing import Floats
from plant.systems import driven
from plant.systems.stroke import StrokeSystem, valve_moves


def pressures_along(setup: Setup, time_s: Floats, position_m: Floats) -> Floats:
    """Pressures [n, chambers] along a measured position of the stay, smoothed before [Pa].

    From rest at time 0; the position is straight between samples.  The length stroke's
    pistons move as the pressures and the moving stay drive them.
    """
    if setup.conditions.kind == "fixed":
        return driven.pressures_along(setup, time_s, position_m)
    system = ImposedSystem(setup)
    system.free_stay()
    out = np.zeros((len(time_s), 3))
    out[0] = system.pressures_pa
    for k, (end_ns, moves) in enumerate(intervals(setup, time_s)):
        left_s = (end_ns - system.now_ns) / NS
        system.impose_speed((position_m[k + 1] - system.position_m) / left_s)
        system.advance(end_ns, moves)
        out[k + 1] = system.pressures_pa
    return out


def motion_along(setup: Setup, time_s: Floats, pressures_pa: Floats) -> Floats:
    """Position of the stay [n] driven by measured pressures [n, chambers], from rest at time 0 [m].

    Raises ValueError if the shapes differ.  Between two samples the pressures are the mean of both.
    """
    if pressures_pa.shape != (len(time_s), len(setup.conditions.chambers)):
        raise ValueError(f"pressures: shape {pressures_pa.shape}; expected samples x chambers")
    system = ImposedSystem(setup)
    out = np.zeros(len(time_s))
    out[0] = system.position_m
    for k, (end_ns, _moves) in enumerate(intervals(setup, time_s)):
        system.impose_pressures(0.5 * (pressures_pa[k] + pressures_pa[k + 1]))
        system.advance(end_ns)
        out[k + 1] = system.position_m
    return out


class ImposedSystem(StrokeSystem):
    """A stroke of which one part follows a record instead of its equation."""

    def __init__(self, setup: Setup) -> None:
        super().__init__(replace(setup, p=setup.p.copy()), tolerance=1e-7)

    def free_stay(self) -> None:
        """Take the stay's stops, loads and damper away, and its motion from all forces."""
        p = self._p
        p.sync_impulse = p.spring_k = p.f_external = p.detent_force = 0.0
        p.stop_offset = 1.0
        p.m_s = 1e9  # kg: nothing turns the stay from its motion
        self._m.damper = 0

    def impose_speed(self, speed_m_s: float) -> None:
        """Give the stay a speed, and to the pistons that it then meets."""
        y, far = self._y, self._p.x_free - TOUCH_M
        y[LengthState.v_s] = speed_m_s
        for x, v, away in (
            (LengthState.x_1, LengthState.v_1, -1.0),
            (LengthState.x_2, LengthState.v_2, 1.0),
        ):
            gap = y[x] + away * y[LengthState.x_s]
            opening = y[v] + away * speed_m_s
            if (gap <= TOUCH_M and opening < 0.0) or (gap >= far and opening > 0.0):
                y[v] = -away * speed_m_s
        self._control.starting = 1

    def impose_pressures(self, pressures_pa: Floats) -> None:
        """Give the chambers their pressures [chambers], in their order [Pa], instead of equations."""
        self._p.vol_b = self._p.vol_n = self._p.vol_f = 1e9  # m^3: nothing changes the pressures
        self._y[pressure_slice(self._system)] = pressures_pa


def intervals(setup: Setup, time_s: Floats) -> list[tuple[int, list[Any]]]:
    """For every interval between samples: its end [ns] and the valves' moves within it."""
    ends = np.rint(np.asarray(time_s) * NS).astype(np.int64)
    moves = valve_moves(setup, int(ends[-1]))
    return [
        (int(end), [move for move in moves if begin <= move[0] < end])
        for begin, end in pairwise(ends.tolist())
    ]

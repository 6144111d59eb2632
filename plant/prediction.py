"""Many runs of one stroke with changing parameters: the kernel without ceremony.

The same equations and kernel as `plant.stroke`; no quadratures, no event objects.  Used by fits,
which call it thousands of times.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from . import layout as L
from .filling import filling_curves
from .hybrid import NS, REASONS, WORKSPACE, IntegrationError
from .integrate import DONE, EVENT_COLUMNS, advance, start
from .packing import Floats, active_states, initial_state, modes, scales
from .setup import Setup
from .stroke import lagged, valve_moves

FIT_TOLERANCE = 1e-7


@dataclass
class Predictor:
    """States of one stroke at fixed instants, for any variation of its setup.

    sample_ns: instants, ascending; the last one ends the simulation.
    """

    sample_ns: NDArray[np.int64]
    tolerance: float = FIT_TOLERANCE
    _workspace: Floats = field(default_factory=lambda: np.zeros(WORKSPACE))
    _events: Floats = field(default_factory=lambda: np.zeros((512, EVENT_COLUMNS)))

    def states(self, setup: Setup) -> Floats:
        """States [n, states] at the instants; pressures behind the lines' lag if there is one.

        Raises IntegrationError if the motion cannot be continued.
        """
        conditions = setup.conditions
        system = conditions.system
        p = setup.p
        position: str | float
        position = conditions.start_offset_m if system == L.FIXED else conditions.kind[0]
        y = initial_state(system, p, position=position, charged=conditions.charged_before)
        first, count = (L.FP1, 2) if system == L.FIXED else (L.PB, 3)
        names = conditions.chambers
        for chamber, pressure in setup.residual_pa.items():
            y[first + names.index(chamber)] += pressure
        m = modes(system, conditions.loads())
        m[L.M_LINE] = 1 if setup.has_line else 0
        n = active_states(system, m)
        u0 = np.zeros(3)
        for index, name in enumerate(names):
            u0[index] = 1.0 if name in conditions.charged_before else 0.0
        end_ns = int(self.sample_ns[-1])
        moves = valve_moves(setup, end_ns)
        rows = np.zeros((len(moves), 4))
        for k, (instant, chamber_index, target, slope) in enumerate(moves):
            rows[k] = (instant / NS, chamber_index, target, slope)
        samples = self.sample_ns / NS
        out = np.zeros((len(samples), n))
        counts = np.zeros(4, dtype=np.int64)
        start(y, m, p, self._workspace)
        code = advance(
            end_ns / NS,
            y,
            m,
            u0,
            np.zeros(3),
            p,
            setup.c,
            scales(system),
            n,
            0,
            self.tolerance,
            np.array([1e-4]),
            rows,
            samples,
            out,
            self._events,
            counts,
            self._workspace,
            *filling_curves(setup.c),
        )
        if code != DONE:
            raise IntegrationError(f"integration stopped: {REASONS[code]}")
        if setup.gauge_lag_s > 0.0:
            out[:, first : first + count] = lagged(
                samples, out[:, first : first + count], setup.gauge_lag_s
            )
        return out


def copied(setup: Setup) -> Setup:
    """A setup that can be changed without changing the original."""
    twin = copy.copy(setup)
    twin.p = setup.p.copy()
    twin.residual_pa = dict(setup.residual_pa)
    return twin

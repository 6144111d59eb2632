"""Many runs of one stroke with changing parameters: the kernel without ceremony.

The same equations and kernel as `plant.stroke`; no quadratures, no event objects.  Used by fits,
which call it thousands of times.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from . import layout as L
from .batch import BATCH_TOLERANCE, Strokes
from .filling import filling_curves
from .hybrid import NS, REASONS, WORKSPACE, IntegrationError
from .integrate import DONE, EVENT_COLUMNS, advance, start
from .packing import Floats, Ints, active_states, initial_state, modes, scales
from .setup import Setup
from .stroke import lagged, valve_moves
from .tangents import neighbours

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
    _happened: int = 0
    _like: tuple | None = None
    _ready: tuple[Ints, Floats, Floats] = field(init=False)

    @property
    def happened(self) -> Floats:
        """Events of the last call of `states`, rows of `plant.integrate.EVENT_COLUMNS`."""
        return self._events[: self._happened]

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
        end_ns = int(self.sample_ns[-1])
        like = (conditions, setup.timing, setup.creep_s, setup.has_line)
        if self._like != like:
            m = modes(system, conditions.loads())
            m[L.M_LINE] = 1 if setup.has_line else 0
            u0 = np.zeros(3)
            for index, name in enumerate(names):
                u0[index] = 1.0 if name in conditions.charged_before else 0.0
            moves = [(at / NS, *move) for at, *move in valve_moves(setup, end_ns)]
            self._like = like
            self._ready = (m, u0, np.array(moves, dtype=np.float64).reshape(-1, 4))
        fresh_m, fresh_u0, rows = self._ready
        m = fresh_m.copy()
        u0 = fresh_u0.copy()
        n = active_states(system, m)
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
        self._happened = int(counts[0])
        if code != DONE:
            raise IntegrationError(f"integration stopped: {REASONS[code]}")
        if setup.gauge_lag_s > 0.0:
            out[:, first : first + count] = lagged(
                samples, out[:, first : first + count], setup.gauge_lag_s
            )
        return out

    def derivatives(
        self,
        setup: Setup,
        moved: Sequence[Setup],
        steps: Sequence[float],
        columns: Sequence[int] | None = None,
        tolerance: float = BATCH_TOLERANCE,
    ) -> tuple[Floats, list[Floats | None]]:
        """States at the instants, and their derivatives by what was moved; [n, columns] each.

        moved: setups next to `setup`, each with one quantity changed by its step, which should be a
        share of about `plant.tangents.MOVE` of the quantity's size; columns: states wanted, all that
        move by default.  The events move along.  None where a neighbour did not meet the same
        events, or where the lanes do not cover the stroke (oil damper, leaks, gearbox): there a
        difference of two runs of `states` is all there is.

        Raises IntegrationError if the motion of `setup` cannot be continued.
        """
        if len(moved) != len(steps):
            raise ValueError(f"{len(moved)} setups and {len(steps)} steps")
        setups = [setup, *moved]
        system = setup.conditions.system
        strokes = Strokes.from_setups(setups, int(self.sample_ns[-1]) / NS)
        wanted = range(active_states(system, strokes.modes[0])) if columns is None else columns
        if not strokes.in_lanes[0]:
            return self.states(setup)[:, list(wanted)], [None] * len(moved)
        result, alike = neighbours(strokes, self.sample_ns / NS, wanted, tolerance)
        if result.status[0] != DONE:
            raise IntegrationError(f"integration stopped: {REASONS[int(result.status[0])]}")
        first, count = (L.FP1, 2) if system == L.FIXED else (L.PB, 3)
        pressures = [k for k, place in enumerate(wanted) if first <= place < first + count]
        for one, samples in zip(setups, result.samples, strict=True):
            if one.gauge_lag_s > 0.0:
                samples[:, pressures] = lagged(
                    self.sample_ns / NS, samples[:, pressures], one.gauge_lag_s
                )
        base = result.samples[0]
        return base, [
            (result.samples[k + 1] - base) / step if alike[k + 1] else None
            for k, step in enumerate(steps)
        ]


def copied(setup: Setup) -> Setup:
    """A setup that can be changed without changing the original."""
    twin = copy.copy(setup)
    twin.p = setup.p.copy()
    twin.residual_pa = dict(setup.residual_pa)
    return twin

"""Many runs of one stroke with changing parameters, for fits: no quadratures, no event objects."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from plant.batch.batch import BATCH_TOLERANCE, Drive, Strokes, drive_of
from plant.batch.singles import EVENT_ROOM
from plant.batch.tangents import Followers, to_quotients
from plant.devices.valve import NS_PER_S
from plant.effects.setup import Setup
from plant.effects.stroke_conditions import StrokeConditions
from plant.errors import IntegrationError
from plant.integrator.filling_curves import filling_curves
from plant.integrator.hybrid import NO_GRID, REASONS
from plant.integrator.integrate import advance
from plant.integrator.loop import DONE
from plant.integrator.workspace import Control, Run
from plant.kernel.layout import EventRow, Modes, pressure_slice
from plant.kernel.packing import FIRST_STEP_S, Floats, Ints, active_states, scales
from plant.systems.stroke import gauged


class _Ready(NamedTuple):
    """What a stroke's conditions and its valves' timing decide."""

    conditions: StrokeConditions
    rows: Drive
    moves: Floats
    states: int
    run: Floats
    control: Ints

    @classmethod
    def of(cls, setup: Setup, end_ns: int, tolerance: float) -> _Ready:
        system = setup.conditions.system
        modes, valves, moves = drive_of(setup, end_ns)
        run, control = Run.zeros(), Control.zeros(np.int64)
        control.modes, run.u0 = modes, valves
        typical = scales(system)
        run.scale[: len(typical)] = typical
        run.tolerance, run.end, run.wanted = tolerance, end_ns / NS_PER_S, FIRST_STEP_S
        control.states = active_states(system, Modes(control.modes))
        control.starting = 1
        rows = modes[None], valves[None], moves[None]
        states = int(control.states)
        return cls(setup.conditions, rows, moves, states, run.array, control.array)


def _driven_alike(one: Setup, other: Setup) -> bool:
    """Return True if modes and valves of two strokes are the same."""
    if one.conditions is other.conditions and one.timing is other.timing:
        same_valves = one.creep_s == other.creep_s and one.spool is other.spool
        return same_valves and one.has_line == other.has_line
    return one.driven_by == other.driven_by


class Predictor:
    """States of one stroke, for any variation of its setup, at `sample_ns`: ascending, the last one is the end."""

    def __init__(self, sample_ns: NDArray[np.int64], tolerance: float = 1e-7) -> None:
        self.sample_ns = sample_ns
        self.tolerance = tolerance
        self._sample_s = sample_ns / NS_PER_S
        self._run, self._control = np.zeros(Run.size), np.zeros(Control.size, dtype=np.int64)
        self._events = np.zeros((EVENT_ROOM, EventRow.size))
        self._happened = 0
        self._ready: dict[tuple[object, ...], _Ready] = {}
        self._followers: Followers | None = None

    @property
    def happened(self) -> Floats:
        """Events of the last call of `states` [events, EventRow.size], SI units."""
        return self._events[: self._happened]

    def _prepared(self, setup: Setup) -> _Ready:
        # the conditions by identity: they are slow to compare
        key = (id(setup.conditions), setup.timing, setup.creep_s, setup.has_line, setup.spool)
        ready = self._ready.get(key)
        if ready is None or ready.conditions is not setup.conditions:
            if len(self._ready) == 256:  # kinds of strokes
                self._ready.clear()
            ready = _Ready.of(setup, int(self.sample_ns[-1]), self.tolerance)
            self._ready[key] = ready
        return ready

    def states(self, setup: Setup) -> Floats:
        """States [n, states] at the instants, SI units, as gauges show them. Raises IntegrationError where it cannot go on."""
        ready = self._prepared(setup)
        y = setup.initial_state()
        run, control = self._run, self._control
        run[:] = ready.run
        run[: len(y)] = y
        control[:] = ready.control
        out = np.empty((len(self._sample_s), ready.states))
        code = advance(
            run, control, setup.p.array, setup.c, ready.moves, self._sample_s, out, self._events,
            filling_curves(setup.c), NO_GRID,
        )  # fmt: skip
        self._happened = int(control[Control.events])
        if code != DONE:
            raise IntegrationError(f"integration stopped: {REASONS[code]}")
        if not setup.exact_gauges:
            pressures = pressure_slice(setup.conditions.system)
            out[:, pressures] = gauged(setup, self._sample_s, out[:, pressures])
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
        share of about `plant.batch.tangents.MOVE` of the quantity's size; columns: states wanted, all that
        move by default.  The events move along.  None where a neighbour did not meet the same events.

        Raises IntegrationError if the motion of `setup` cannot be continued.
        """
        if len(moved) != len(steps):
            raise ValueError(f"{len(moved)} setups and {len(steps)} steps")
        setups = [setup, *moved]
        ready = self._prepared(setup)
        if all(_driven_alike(one, setup) for one in moved):
            strokes = Strokes.driven(setups, ready.rows, self._sample_s[-1:])
        else:
            strokes = Strokes.from_setups(setups, float(self._sample_s[-1]))
        wanted = range(ready.states) if columns is None else columns
        if self._followers is None:
            self._followers = Followers(self._sample_s)
        status, samples, alike = self._followers.run(strokes, wanted, tolerance)
        if status != DONE:
            raise IntegrationError(f"integration stopped: {REASONS[status]}")
        if not all(one.exact_gauges for one in setups):
            measured = range(*pressure_slice(strokes.system).indices(strokes.initial.shape[1]))
            pressures = [place for place, column in enumerate(wanted) if column in measured]
            for one, states in zip(setups, samples, strict=True):
                states[:, pressures] = gauged(one, self._sample_s, states[:, pressures])
        to_quotients(samples.reshape(len(setups), -1), np.array(steps, dtype=np.float64))
        base, *rates = samples
        same = alike[1:].tolist()
        return base, [rate if one else None for rate, one in zip(rates, same, strict=True)]

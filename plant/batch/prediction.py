"""Many runs of one stroke with changing parameters, for fits, and how it changes with them.

Derivatives are differences along one frozen sequence of steps: the stroke runs once and notes where its steps end; the
same stroke with a parameter moved by a tiny amount then takes those very steps, in the lanes where they cover it,
without error control, but locates its own events, resets at its own instants and rests for its own time.  Both are the
same smooth function of the parameter, so the difference quotient carries the motion of the events and is good to many
digits.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from can_dbc.instants import NS_PER_S
from plant.batch.batch import BATCH_TOLERANCE, Drive, Strokes, drive_of, fill_still
from plant.batch.lane_control import Result
from plant.batch.lanes import Batch, Room, room_for_results, run_lanes
from plant.batch.singles import EVENT_ROOM, run_singles
from plant.effects.setup import Setup
from plant.effects.stroke_conditions import StrokeConditions
from plant.errors import IntegrationError
from plant.integrator.filling import filling_curves
from plant.integrator.hybrid import NO_GRID, REASONS
from plant.integrator.integrate import advance
from plant.integrator.loop import DONE, Control, Run
from plant.kernel.compiled import kernel
from plant.kernel.layout import EventRow, Modes, pressure_slice
from plant.kernel.packing import FIRST_STEP_S, Floats, Ints, active_states, scales
from plant.systems.stroke import gauged

MOVE = 1e-6
"""A share of a parameter's size by which a neighbour is moved: truncation and rounding stay small."""


class Followers:
    """A stroke and others next to it along its own steps, again and again at the same instants.

    sample_s : instants [s] in s, ascending
    """

    def __init__(self, sample_s: Floats) -> None:
        self._instants = np.ascontiguousarray(sample_s)[None]
        self._room = Room.of(len(sample_s), steps=4096)

    def run(
        self, strokes: Strokes, columns: Sequence[int], tolerance: float
    ) -> tuple[int, Floats, NDArray[np.bool_]]:
        """Status of the first stroke, samples [n, s, columns] in SI units, and which [n] are alike it.

        The others differ from it by a share of about `MOVE`. Those that are alike went through the same steps and
        events; then the difference of their samples, by the parameter's, is a derivative. The samples of the rest mean
        nothing.
        """
        n, states = len(strokes), strokes.initial.shape[1]
        covered = strokes.in_lanes
        wanted = np.array(columns, dtype=np.int64)
        batch = Batch._make((*strokes.arrays, self._instants, wanted, scales(strokes.system)))
        outcome = room_for_results(n, states, self._instants.shape[1], len(wanted), 0)
        run = run_lanes if covered[0] else run_singles
        run(
            batch, outcome, self._room, filling_curves(strokes.flow), np.arange(n), tolerance,
            strokes.system, True,
        )  # fmt: skip
        if covered[0]:
            fill_still(outcome.out, strokes, columns, covered)
        same = outcome.results[:, : Result.arrival]  # status, events and steps
        alike = (same == same[0]).all(axis=1) & (covered == covered[0])
        return int(same[0, 0]), outcome.out, alike


@kernel
def to_quotients(samples, steps):
    """Turn samples [n + 1, k] of a stroke and its n neighbours into differences from the first row, by their steps."""
    for i in range(len(steps)):
        per_step = 1.0 / steps[i]
        for k in range(samples.shape[1]):
            samples[i + 1, k] = (samples[i + 1, k] - samples[0, k]) * per_step


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
        self._ready: dict[tuple[object, ...], _Ready] = {}
        self._followers: Followers | None = None

    @property
    def happened(self) -> Floats:
        """Events of the last call of `states` [events, EventRow.size], SI units."""
        return self._events[: int(self._control[Control.events])]

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
        """States at the instants, and their derivatives by what was moved; [n, columns] each, SI units.

        moved: setups next to `setup`, each with one quantity changed by its step, about a share `MOVE` of its size;
        columns: states wanted, all that move by default. None where a neighbour did not meet the same events. Raises
        IntegrationError if the motion of `setup` cannot be continued, ValueError for another number of steps.
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

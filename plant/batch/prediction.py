"""Many runs of one stroke with changing parameters: the kernel without ceremony.

The same equations and kernel as `plant.systems.stroke`; no quadratures, no event objects.  Used by fits,
which call it thousands of times.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from plant.batch.batch import BATCH_TOLERANCE, Strokes, initials, shared
from plant.batch.singles import MOST_EVENTS
from plant.batch.tangents import Followers
from plant.effects.setup import Setup
from plant.errors import IntegrationError
from plant.integrator.filling import filling_curves
from plant.integrator.hybrid import NO_GRID, NS, REASONS
from plant.integrator.integrate import advance
from plant.integrator.loop import DONE
from plant.integrator.workspace import Control, Run
from plant.kernel.layout import CHAMBERS, FIRST_PRESSURE, FIXED, EventRow, Parameters
from plant.kernel.packing import (
    FIRST_STEP_S,
    Floats,
    Ints,
    active_states,
    fresh_modes,
    initial_state,
    scales,
    state_record,
)
from plant.systems.stroke import gauged, valve_moves

FIT_TOLERANCE = 1e-7
EVENTS: int = Control.events


def _driven_alike(one: Setup, other: Setup) -> bool:
    """Return True if modes and valves of two strokes are the same."""
    if one.conditions is other.conditions and one.timing is other.timing:
        return one.creep_s == other.creep_s and one.has_line == other.has_line
    return _like(one) == _like(other)


def _like(setup: Setup) -> tuple:
    """Return what decides modes and valves of a stroke."""
    return setup.conditions, setup.timing, setup.creep_s, setup.has_line


class _Ready(NamedTuple):
    """What a stroke's conditions and its valves' timing decide."""

    system: int
    position: str | float
    charged: tuple[str, ...]
    names: tuple[str, ...]
    first: int
    states: int
    modes: Ints
    valves: Floats
    moves: Floats
    run: Floats
    control: Ints

    @classmethod
    def of(cls, setup: Setup, end_ns: int, tolerance: float) -> _Ready:
        conditions = setup.conditions
        system, names = conditions.system, conditions.chambers
        m = fresh_modes(system, conditions.loads())
        m.line = 1 if setup.has_line else 0
        valves = np.zeros(3)
        for index, name in enumerate(names):
            valves[index] = 1.0 if name in conditions.charged_before else 0.0
        moves = [(at / NS, *move) for at, *move in valve_moves(setup, end_ns)]
        run, control = Run.zeros(), Control.zeros(np.int64)
        run.u0 = valves
        run.scale[: state_record(system).size] = scales(system)
        run.tolerance, run.end, run.wanted = tolerance, end_ns / NS, FIRST_STEP_S
        control.modes = m.array
        control.states = active_states(system, m)
        control.starting = 1
        return cls(
            system,
            conditions.start_offset_m if system == FIXED else conditions.kind[0],
            conditions.charged_before,
            names,
            FIRST_PRESSURE[system],
            int(control.states),
            m.array,
            valves,
            np.array(moves, dtype=np.float64).reshape(-1, 4),
            run.array,
            control.array,
        )


class Predictor:
    """States of one stroke at fixed instants, for any variation of its setup.

    sample_ns: instants, ascending; the last one ends the simulation.
    """

    def __init__(self, sample_ns: NDArray[np.int64], tolerance: float = FIT_TOLERANCE) -> None:
        self.sample_ns = sample_ns
        self.tolerance = tolerance
        self._sample_s = sample_ns / NS
        self._run, self._control = np.zeros(Run.size), np.zeros(Control.size, dtype=np.int64)
        self._events = np.zeros((MOST_EVENTS, EventRow.size))
        self._happened = 0
        self._like: tuple | None = None
        self._ready: _Ready
        self._followers: Followers | None = None

    @property
    def happened(self) -> Floats:
        """Events of the last call of `states` [events, EventRow.size], SI units."""
        return self._events[: self._happened]

    def _prepared(self, setup: Setup) -> _Ready:
        like = _like(setup)
        if self._like != like:
            self._ready = _Ready.of(setup, int(self.sample_ns[-1]), self.tolerance)
            self._like = like
        return self._ready

    def states(self, setup: Setup) -> Floats:
        """States [n, states] at the instants; pressures behind the lines' lag if there is one.

        Raises IntegrationError if the motion cannot be continued.
        """
        ready = self._prepared(setup)
        p = setup.p
        y = initial_state(ready.system, p, position=ready.position, charged=ready.charged)
        for chamber, pressure in setup.residual_pa.items():
            y[ready.first + ready.names.index(chamber)] += pressure
        run, control = self._run, self._control
        run[:] = ready.run
        run[: len(y)] = y
        control[:] = ready.control
        out = np.empty((len(self._sample_s), ready.states))
        code = advance(
            run,
            control,
            setup.p.array,
            setup.c,
            ready.moves,
            self._sample_s,
            out,
            self._events,
            filling_curves(setup.c),
            NO_GRID,
        )
        self._happened = int(control[EVENTS])
        if code != DONE:
            raise IntegrationError(f"integration stopped: {REASONS[code]}")
        if not setup.exact_gauges:
            pressures = slice(ready.first, ready.first + len(ready.names))
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
        system = setup.conditions.system
        ready = self._prepared(setup)
        if all(_driven_alike(one, setup) for one in moved):
            packed = np.empty((len(setups), Parameters.size))
            for row, one in zip(packed, setups, strict=True):
                row[:] = one.p.array
            flow = shared([one.c for one in setups])
            initial = shared(initials(setups, packed))
            modes_, valves, switches = (
                ready.modes[None],
                ready.valves[None],
                ready.moves[None],
            )
            driven = (modes_, valves, switches, self._sample_s[-1:])
        else:
            strokes = Strokes.from_setups(setups, float(self._sample_s[-1]))
            packed, flow, initial = strokes.packed, strokes.flow, strokes.initial
            driven = (strokes.modes, strokes.valves, strokes.switches, strokes.duration_s)
        wanted = np.arange(ready.states) if columns is None else np.array(columns, dtype=np.int64)
        if self._followers is None:
            self._followers = Followers(self._sample_s)
        status, samples, alike = self._followers.run(
            system, packed, flow, initial, driven, wanted, tolerance
        )
        if status != DONE:
            raise IntegrationError(f"integration stopped: {REASONS[status]}")
        if not all(one.exact_gauges for one in setups):
            first = FIRST_PRESSURE[system]
            pressures = np.flatnonzero((wanted >= first) & (wanted < first + CHAMBERS[system]))
            for one, own in zip(setups, samples, strict=True):
                own[:, pressures] = gauged(one, self._sample_s, own[:, pressures])
        base = samples[0]
        rates = samples[1:]
        rates -= base
        rates *= (1.0 / np.array(steps)).reshape(-1, 1, 1)
        return base, [rate if same else None for rate, same in zip(rates, alike[1:], strict=True)]

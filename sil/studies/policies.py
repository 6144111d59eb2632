"""Simulate commands under many loads in one batch: how hard each arrives, and when.

The loads differ in one unknown, which the synchronizer's release reveals.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from plant.batch.batch import Strokes, simulate_batch
from plant.effects.setup import Setup
from plant.effects.stroke_conditions import FULL_DUTY, StrokeConditions
from plant.integrator.loop import DONE
from plant.kernel.layout import EventRow, Guard, LengthState
from plant.parameters import ParameterSet
from plant.systems.setup import make_setup
from sil.simulation.impacts import HOLD_S, counted, worst_speed_m_s

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]
Commands = Sequence[tuple[float, str, float]]  # (time s, valve, duty), as in a campaign


PUSH = StrokeConditions("N-B", 900000.0, ((0.0, "B", FULL_DUTY),))
"""The plain push from neutral to backward."""
GEARBOX = tuple(
    replace(PUSH, mounted=True, mesh_force_n=1300.0, sync_impulse_n_s=impulse_n_s)
    for impulse_n_s in (18.0, 40.0, 78.0, 140.0, 250.0)
)
"""Loads that differ in the impulse that the synchronizer needs, unknown until it lets go."""


@dataclass(frozen=True)
class Arrivals:
    """How strokes arrive, each [strokes]; speeds in m/s, times in s.

    impact_worst_m_s: hardest impact that counts. All but revealed_s are infinite for an arrival that is too
    late or does not last.
    """

    revealed_s: Floats
    impact_worst_m_s: Floats
    arrival_s: Floats


class LoadModel:
    """The strokes of some loads, to be simulated many times under changed switches of the valves."""

    def __init__(self, setups: Sequence[Setup]) -> None:
        self.strokes = Strokes.from_setups(setups, 1.0)
        self.stop_m = setups[0].p.stroke - 1e-4
        self._mass_kg = setups[0].p.m_s + setups[0].p.m_p
        guards = {guard.event: guard for guard in Guard}
        self._release, self._pick_up = guards["unblock"], guards["collar 1 contact"]

    def take(self, loads: Ints, switches: Floats, duration_s: Floats) -> Strokes:
        """Return strokes [n] of loads (numbers [n]) under switches [n, k, 4], of duration_s [n] in s."""
        rows = {
            name: array if len(array) == 1 else array[loads]
            for name in ("packed", "flow", "initial", "modes", "valves")
            for array in (getattr(self.strokes, name),)
        }
        if len(rows["packed"]) != len(loads):
            rows["packed"] = np.repeat(rows["packed"], len(loads), axis=0)
        return replace(self.strokes, switches=switches, duration_s=duration_s, **rows)

    def arrivals(self, strokes: Strokes) -> Arrivals:
        """Simulate strokes [n]; each figure [n]. A stroke has arrived if it is at its stop at the end."""
        max_events = 96
        result = simulate_batch(strokes, event_room=max_events)
        events = np.moveaxis(result.events, 2, 0)
        happened = np.arange(max_events) < result.event_count[:, None]
        time_s = np.where(happened, events[EventRow.time], np.inf)
        guard, x_m = events[EventRow.guard], events[EventRow.x]
        at_block = events[EventRow.at_block] == 1.0
        stop = happened & ~at_block & (events[EventRow.speed] > 0.0) & (x_m > 0.5 * self.stop_m)
        left = happened & (x_m < self.stop_m) & (time_s > _first(stop, time_s)[:, None])
        left_s = np.where(left, time_s, -1.0).max(axis=1)
        arrival_s = _first(stop & (time_s > left_s[:, None]), time_s)
        lost_j = np.where(happened, events[EventRow.lost], 0.0)
        counts = counted(guard, time_s, lost_j, at_block, (self._pick_up,))
        worst_j = np.where(counts, lost_j, 0.0).max(axis=1)
        stay_m_s = np.where(stop, events[EventRow.speed], 0.0).max(axis=1)
        worst_m_s = worst_speed_m_s(worst_j, stay_m_s, self._mass_kg)
        lasts = (result.status == DONE) & (result.event_count <= max_events)
        lasts &= (result.final[:, LengthState.x_s] > self.stop_m) & np.isfinite(arrival_s)
        return Arrivals(
            _first(happened & (guard == self._release), time_s),
            *(np.where(lasts, each, np.inf) for each in (worst_m_s, arrival_s)),
        )


def arrivals_of(parameters: ParameterSet, cases: Sequence[StrokeConditions]) -> Arrivals:
    """Simulate strokes; one that arrives after 0.5 s is too late."""
    model, latest_s = LoadModel([make_setup(parameters, case) for case in cases]), 0.5
    strokes = replace(model.strokes, duration_s=np.array([latest_s + HOLD_S]))
    arrivals = model.arrivals(strokes)
    in_time = arrivals.arrival_s <= latest_s
    figures = arrivals.impact_worst_m_s, arrivals.arrival_s
    return Arrivals(arrivals.revealed_s, *(np.where(in_time, each, np.inf) for each in figures))


def _first(which: NDArray[np.bool_], time_s: Floats) -> Floats:
    """Return the time [runs] in s of the first marked event of [runs, events], infinite without one."""
    times_s: Floats = np.where(which, time_s, np.inf).min(axis=1)
    return times_s

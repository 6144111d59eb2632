"""Simulate many command sequences under many loads in one batch: how hard each arrives, and when.

The loads of a family differ in one unknown, and an event reveals which it is: the synchronizer's
release on the gearbox, the first contact of piston and stay in the laboratory.
Checked by: tests/unit/sil/studies/test_policies.py
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from plant.batch.batch import Strokes, simulate_batch
from plant.devices.valve import ValveTiming, switch_schedule
from plant.effects.stroke_conditions import FULL_DUTY, StrokeConditions
from plant.integrator.loop import DONE
from plant.kernel.layout import EventRow, Guard, LengthState
from plant.parameters import ParameterSet
from plant.systems.setup import make_setup
from sil.coupling.clock import NS_PER_S
from sil.simulation.impacts import HOLD_S, counted, worst_speed_m_s

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Commands = Sequence[tuple[float, str, float]]
"""(time s, valve, duty), as in a campaign."""

GUARDS = {guard.event: guard for guard in Guard}
MAX_EVENTS = 96
AT_STOP_M = 1e-4
NOT_ARRIVED_M_S = 2.0
"""Least cost of an arrival that is too late or does not last; above every impact."""

PUSH = StrokeConditions("N-B", 900000.0, ((0.0, "B", FULL_DUTY),))
"""The plain push from neutral to backward."""


@dataclass(frozen=True)
class Family:
    """Loads of one stroke that differ in one unknown, and the event that reveals which it is."""

    name: str
    revealed_by: Literal["collar 1 contact", "unblock"]
    cases: tuple[StrokeConditions, ...]

    def under(self, **conditions: Any) -> Family:
        """Return the family with other conditions of all its loads."""
        return replace(self, cases=tuple(replace(case, **conditions) for case in self.cases))


GEARBOX = Family(
    "gearbox",
    "unblock",
    tuple(
        replace(PUSH, mounted=True, mesh_force_n=1300.0, sync_impulse_n_s=impulse_n_s)
        for impulse_n_s in (18.0, 40.0, 78.0, 140.0, 250.0)
    ),
)
"""Unknown: the impulse that the synchronizer needs."""


@dataclass(frozen=True)
class Arrivals:
    """How command sequences arrive, each [sequences, loads]; speeds in m/s, times in s.

    cost_m_s: the hardest impact, or above `NOT_ARRIVED_M_S` for an arrival that is too late or does
    not last. impact_stay_m_s: hardest stop of the stay. impact_worst_m_s: hardest of all impacts that
    count (`sil.simulation.impacts`). The last three are infinite for an arrival that does not last.
    """

    cost_m_s: Floats
    revealed_s: Floats
    impact_stay_m_s: Floats
    impact_worst_m_s: Floats
    arrival_s: Floats


class FamilyModel:
    """The strokes of a family's loads, to be simulated under many command sequences.

    extra_s: how much later than the plain push a load may arrive. tolerance: of `simulate_batch`.
    """

    def __init__(
        self, parameters: ParameterSet, family: Family, extra_s: float, tolerance: float = 1e-5
    ) -> None:
        setups = [make_setup(parameters, case) for case in family.cases]
        self.loads = len(setups)
        self._timing = ValveTiming.from_parameters(parameters)
        self._base = Strokes.from_setups(setups, 1.0)
        self._stroke_m = setups[0].p.stroke
        self._mass_kg = setups[0].p.m_s + setups[0].p.m_p
        self._revealing = GUARDS[family.revealed_by]
        self._tolerance = tolerance
        self.limit_s: Floats = np.full(self.loads, 0.5)
        self.plain = self.arrivals([PUSH.commands])
        self.limit_s = self.plain.arrival_s[0] + extra_s

    def arrivals(self, sequences: Sequence[Commands]) -> Arrivals:
        """Simulate each command sequence under every load, and judge its impacts."""
        load = np.tile(np.arange(self.loads), len(sequences))
        limit_s = self.limit_s[load]
        of_load: dict[str, Any] = {
            name: rows if len(rows) == 1 else rows[load]
            for name in ("flow", "initial", "modes", "valves")
            for rows in (getattr(self._base, name),)
        }
        result = simulate_batch(
            replace(
                self._base,
                packed=self._base.packed[load],
                switches=np.repeat(self._switches(sequences), self.loads, axis=0),
                duration_s=limit_s + HOLD_S,
                **of_load,
            ),
            event_room=MAX_EVENTS,
            lanes=False,
            tolerance=self._tolerance,
        )
        events = np.moveaxis(result.events, 2, 0)
        happened = np.arange(MAX_EVENTS) < result.event_count[:, None]
        time_s = np.where(happened, events[EventRow.time], np.inf)
        guard, x_m = events[EventRow.guard], events[EventRow.x]
        at_block = events[EventRow.at_block] == 1.0
        stop = happened & ~at_block & (events[EventRow.speed] > 0.0) & (x_m > 0.5 * self._stroke_m)
        below = happened & (x_m < self._stroke_m - AT_STOP_M)
        left_s = np.where(below & (time_s > first(stop, time_s)[:, None]), time_s, -1.0).max(axis=1)
        arrival_s = first(stop & (time_s > left_s[:, None]), time_s)
        lost_j = np.where(happened, events[EventRow.lost], 0.0)
        counts = counted(guard, time_s, lost_j, at_block, (GUARDS["collar 1 contact"],))
        worst_j = np.where(counts, lost_j, 0.0).max(axis=1)
        stay_m_s = np.where(stop, events[EventRow.speed], 0.0).max(axis=1)
        worst_m_s = worst_speed_m_s(worst_j, stay_m_s, self._mass_kg)
        final_m = result.final[:, LengthState.x_s]
        stays = (result.status == DONE) & (result.event_count <= MAX_EVENTS)
        stays &= final_m > self._stroke_m - AT_STOP_M
        lasts = stays & (arrival_s <= limit_s)
        lateness = np.where(
            np.isfinite(arrival_s),
            np.maximum(arrival_s - limit_s, 0.0) / HOLD_S,
            2.0 - np.clip(final_m / self._stroke_m, -1.0, 1.0),
        )
        columns = (
            np.where(lasts, worst_m_s, NOT_ARRIVED_M_S + lateness),
            first(happened & (guard == self._revealing), time_s),
            *(np.where(lasts, each, np.inf) for each in (stay_m_s, worst_m_s, arrival_s)),
        )
        return Arrivals(*(column.reshape(-1, self.loads) for column in columns))

    def _switches(self, sequences: Sequence[Commands]) -> Floats:
        """Return the switches [sequences, k, 4] of `Strokes` for the commands of each sequence."""
        schedules = [
            switch_schedule([(t, "BNF".index(v), duty) for t, v, duty in commands], self._timing, 3)
            for commands in sequences
        ]
        switches = np.zeros((len(schedules), max(map(len, schedules)), 4))
        switches[:, :, 0] = np.inf
        for rows, schedule in zip(switches, schedules, strict=True):
            rows[: len(schedule), :3] = [(at_ns / NS_PER_S, c, u) for at_ns, c, u in schedule]
        return switches


def first(which: Bools, time_s: Floats) -> Floats:
    """Return the time [runs] in s of the first marked event of [runs, events], infinite without one."""
    times_s: Floats = np.where(which, time_s, np.inf).min(axis=1)
    return times_s

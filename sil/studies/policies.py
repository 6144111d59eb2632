"""Simulate command policies under all loads of a family: how hard each arrives, and when.

The loads of a family differ in one unknown, and an event reveals which load it is: the
synchronizer's release on the gearbox, the first contact of piston and stay in the laboratory. Until
then the motion is the same for all loads. A policy is a stem, which all loads share, and a branch for
each load, which begins at that event plus the information delay: all that a controller with that
delay can do, however it computes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from plant.batch.batch import Strokes, simulate_batch
from plant.effects.stroke_conditions import FULL_DUTY, StrokeConditions
from plant.integrator.loop import DONE
from plant.kernel.layout import EventRow, Guard, LengthState
from plant.parameters import ParameterSet
from plant.systems.setup import make_setup
from sil.simulation.impacts import HOLD_S, counted, worst_speed_m_s
from sil.studies.pulses import changes, stem_spans, valve_switches

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

GUARDS = {guard.event: guard for guard in Guard}
IMPACTS = [guard for guard in Guard if guard.event.endswith(("contact", "stop"))]
MOST_EVENTS = 96
TOLERANCE = 1e-5
AT_STOP_M = 1e-4
ARMED = 0.999
"""Share of a valve's delay by which its coil may be switched before it is known whether it must be."""
AGAIN_S = 1e-7
"""How long a coil is switched back between two loads for which it is switched early."""
SAME_S = 1e-6
NOT_ARRIVED = 2.0
"""Least cost of an arrival that is too late or does not last, m/s; above every impact."""
THESIS_DELAYS_S = (("sensor", 0.030), ("velocity", 0.010), ("valve", 0.008))
"""Delays of information and of a valve as the thesis counts them (4.2.1)."""


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


LABORATORY = Family(
    "laboratory",
    "collar 1 contact",
    tuple(replace(PUSH, supply_pressure_pa=1e5 * bar) for bar in (6.0, 7.0, 8.0, 9.0)),
)
"""Unknown: the supply pressure."""
GEARBOX = Family(
    "gearbox",
    "unblock",
    tuple(
        replace(PUSH, mounted=True, mesh_force_n=1300.0, sync_impulse_n_s=impulse_n_s)
        for impulse_n_s in (18.0, 40.0, 78.0, 140.0, 250.0)
    ),
)
"""Unknown: the impulse that the synchronizer needs."""
FAMILIES = {family.name: family for family in (LABORATORY, GEARBOX)}


@dataclass(frozen=True)
class Layout:
    """Meaning of the vectors of a policy, in units of 10 ms: pulses of a start and a length.

    A pulse inverts the plain push: B off, N or F on; one of negative length is none. Where pulses
    overlap their union counts. A stem holds pulses for each valve. A branch, timed from where it
    begins, holds pulses for each valve, and a time from which on the stem's no longer count. A pulse
    of a branch may switch the coil up to one valve delay early: for the other loads the coil is
    switched back when the branch would begin, before the plunger has moved.
    """

    valves: str = "BNF"
    stem: int = 5
    branch: int = 1

    @property
    def branch_shape(self) -> tuple[int, int]:
        """Return the shape of the branch of one load: valves, variables."""
        return len(self.valves), 2 * self.branch + 1


@dataclass(frozen=True)
class Arrivals:
    """How policies arrive, each [stems, tries, loads]; speeds in m/s, times in s.

    cost_m_s: the hardest impact, or above `NOT_ARRIVED` for an arrival that is too late or does not
    last. impact_stay_m_s: hardest stop of the stay. impact_worst_m_s: hardest of all impacts that
    count (see `sil.simulation.impacts`).
    late_s: arrival after the limit (negative before it), infinite for none that lasts. parts_m_s
    [..., parts]: hardest impact of each body on each stop, smooth where the hardest of all is not.
    """

    cost_m_s: Floats
    impact_stay_m_s: Floats
    impact_worst_m_s: Floats
    arrival_s: Floats
    revealed_s: Floats
    late_s: Floats
    parts_m_s: Floats

    def reshaped(self, shape: tuple[int, ...], which: Bools | None = None) -> Arrivals:
        """Return the same in another shape; `which` of its elements these are, the others NaN."""
        if which is None:
            which = np.ones(shape, dtype=np.bool_)
        found = {}
        for name, each in vars(self).items():
            found[name] = np.full((*shape, *each.shape[1:]), np.nan)
            found[name][which] = each
        return Arrivals(**found)


class FamilyModel:
    """The strokes of a family's loads, to be simulated under many policies.

    delay_s: of the information, negative if the revealing event is known ahead. extra_s: how much
    later than the plain push a load may arrive. `runs` counts the simulations. lanes, tolerance: as of
    `simulate_batch`.
    """

    lanes = False
    tolerance = TOLERANCE

    def __init__(
        self, parameters: ParameterSet, family: Family, delay_s: float, extra_s: float
    ) -> None:
        setups = [make_setup(parameters, case) for case in family.cases]
        self.delay_s = delay_s
        self.loads = len(setups)
        self.runs = 0
        self._base = Strokes.from_setups(setups, 1.0)
        self._stroke_m = setups[0].p.stroke
        self._mass_kg = setups[0].p.m_s + setups[0].p.m_p
        self._revealing = GUARDS[family.revealed_by]
        self.valve_s = parameters.value("valve.D_rise"), parameters.value("valve.D_fall")
        self.limit_s, self.order = np.full(self.loads, 0.5), np.arange(self.loads)
        self.plain = self.fly(np.full((1, 1, 2), -1.0), None, Layout("N", 1, 0))
        self.limit_s = self.plain.arrival_s[0, 0] + extra_s
        self.order = np.argsort(self.plain.revealed_s[0, 0])

    def fly(self, stems: Floats, branches: Floats | None, layout: Layout) -> Arrivals:
        """Simulate stems [n, valves, variables] with several tries of branches under every load.

        branches: [n, tries, loads, valves, variables], or None for none.
        """
        given = self.changes(
            layout, *(np.repeat(each, self.loads, axis=0) for each in stem_spans(stems))
        )
        stem_only = self._simulate(given, np.tile(np.arange(self.loads), len(stems)))
        shape = len(stems), 1, self.loads
        if branches is None:
            return stem_only.reshaped(shape)
        return self.branched(stems, branches, layout, stem_only.revealed_s.reshape(-1, self.loads))

    def branched(
        self,
        stems: Floats,
        branches: Floats,
        layout: Layout,
        revealed_s: Floats,
        which: Bools | None = None,
    ) -> Arrivals:
        """Simulate as `fly` does, with the instants [n, loads] in s at which the stems reveal a load.

        which: [n, loads], the loads to simulate, NaN for the others; if not given, all.
        """
        shape = branches.shape[:3]
        revealed_s = np.repeat(revealed_s[:, None], shape[1], axis=1)
        load = np.broadcast_to(np.arange(self.loads), shape)
        some = np.ones(shape, dtype=np.bool_)
        if which is not None:
            some &= which[:, None]
        begin, end = self.spans(layout, stems, branches, self.begin_s(revealed_s))
        given = self.changes(layout, begin[some.ravel()], end[some.ravel()])
        found = self._simulate(given, load[some]).reshaped(shape, some)
        moved = (self.delay_s >= 0.0) & ~np.isclose(found.revealed_s, revealed_s, 0.0, SAME_S)
        moved &= some
        return replace(
            found,
            cost_m_s=np.where(moved, 2.0 * NOT_ARRIVED, found.cost_m_s),
            late_s=np.where(moved, np.inf, found.late_s),
            revealed_s=revealed_s,
        )

    def begin_s(self, revealed_s: Floats) -> Floats:
        """Return when branches begin, from the instants [..., loads] in s at which loads are revealed."""
        found: Floats = np.maximum(np.minimum(revealed_s, self.limit_s) + self.delay_s, 0.0)
        return found

    def reveals_s(self, stems: Floats, layout: Layout, load: int) -> Floats:
        """Return when stems [n, valves, variables] reveal a load [n], in s."""
        given = self.changes(layout, *stem_spans(stems))
        found: Floats = self._simulate(given, np.full(len(stems), load), hold_s=0.0).revealed_s
        return found

    def spans(
        self, layout: Layout, stems: Floats, branches: Floats, begin_s: Floats
    ) -> tuple[Floats, Floats]:
        """Return begins and ends [runs, valves, k] in s of all pulses of policies.

        stems and branches as of `fly`; begin_s [n, tries, loads]: when each branch begins.
        """
        branches = 0.01 * branches
        shape = *branches.shape[:4], -1
        from_s = begin_s[..., None, None]
        lead_s = [self.valve_s[1 if valve == "B" else 0] for valve in layout.valves]
        armed_s = np.array(lead_s)[:, None] * (ARMED if self.delay_s >= 0.0 else 0.0)
        start = np.maximum(branches[..., 0:-1:2], -armed_s)
        begin, end = from_s + start, from_s + branches[..., 0:-1:2] + branches[..., 1:-1:2]
        begin = self._rearmed(begin, end, from_s)
        cut_s = from_s + np.maximum(branches[..., -1:], 0.0)
        stem_begin, stem_end = (
            np.broadcast_to(each[:, None, None], (*shape[:4], each.shape[-1]))
            for each in stem_spans(stems)
        )
        # the coil that a branch switches on before it begins is switched on for all loads until then
        arms = (begin < from_s) & (end > from_s)
        others = ~np.eye(self.loads, dtype=np.bool_)[:, :, None, None]
        arm_begin = np.where(arms, begin, np.inf)[:, :, None]
        arm_end = np.minimum(np.where(arms, from_s, -np.inf)[:, :, None], from_s[:, :, :, None])
        arm_begin, arm_end = (
            np.moveaxis(np.where(others, each, -np.inf), 3, 4).reshape(shape)
            for each in np.broadcast_arrays(arm_begin, arm_end)
        )
        arm_begin = np.where(arm_end > 0.0, arm_begin, np.inf)
        begin = np.concatenate([stem_begin, arm_begin, begin], axis=-1)
        end = np.concatenate([np.minimum(stem_end, cut_s), arm_end, end], axis=-1)
        runs = begin_s.size, len(layout.valves), -1
        return begin.reshape(runs), end.reshape(runs)

    def _rearmed(self, begin: Floats, end: Floats, from_s: Floats) -> Floats:
        """Return begins of pulses [n, tries, loads, valves, k] in s that are possible together.

        A coil that is switched early for one load is switched back when that load is not revealed;
        only then can it be switched early for the next one.
        """
        for at, later in enumerate(self.order):
            for load in self.order[:at]:
                until_s = from_s[:, :, load]
                arms = (begin[:, :, load] < until_s) & (end[:, :, load] > until_s)
                busy = arms.any(axis=-1, keepdims=True) & (begin[:, :, later] <= until_s)
                begin[:, :, later] = np.where(busy, until_s + AGAIN_S, begin[:, :, later])
        return begin

    def changes(self, layout: Layout, begin: Floats, end: Floats) -> list[Floats]:
        """Return when the commands of B, N and F change, from pulses [runs, valves, k] in s."""
        none = np.full((len(begin), 1), np.inf)
        valves = layout.valves
        return [
            changes(begin[:, valves.index(valve)], end[:, valves.index(valve)])
            if valve in valves
            else none
            for valve in "BNF"
        ]

    def _simulate(self, given: list[Floats], load: Ints, hold_s: float = HOLD_S) -> Arrivals:
        """Simulate the changes of commands (B, N, F) [runs, k] under the load [runs] of each run."""
        limit_s = self.limit_s[load]
        own: dict[str, Any] = {
            name: rows if len(rows) == 1 else rows[load]
            for name in ("flow", "initial", "modes", "valves")
            for rows in (getattr(self._base, name),)
        }
        result = simulate_batch(
            replace(
                self._base,
                packed=self._base.packed[load],
                switches=valve_switches(given, limit_s, *self.valve_s),
                duration_s=limit_s + hold_s,
                **own,
            ),
            event_room=MOST_EVENTS,
            lanes=self.lanes,
            tolerance=self.tolerance,
        )
        self.runs += len(load)
        events = np.moveaxis(result.events, 2, 0)
        happened = np.arange(MOST_EVENTS) < result.event_count[:, None]
        time_s = np.where(happened, events[EventRow.time], np.inf)
        guard, x_m = events[EventRow.guard], events[EventRow.x]
        at_block = events[EventRow.at_block] == 1.0
        stop = happened & ~at_block & (events[EventRow.speed] > 0.0) & (x_m > 0.5 * self._stroke_m)
        below = happened & (x_m < self._stroke_m - AT_STOP_M)
        left_s = np.where(below & (time_s > first(stop, time_s)[:, None]), time_s, -1.0).max(axis=1)
        arrival_s = first(stop & (time_s > left_s[:, None]), time_s)
        lost_j = np.where(happened, events[EventRow.lost], 0.0)
        counts = counted(guard, time_s, lost_j, at_block, (GUARDS["collar 1 contact"],))
        lost_j = np.where(counts, lost_j, 0.0)
        worst_j = lost_j.max(axis=1)
        stay_m_s = np.where(stop, events[EventRow.speed], 0.0).max(axis=1)
        worst_m_s = worst_speed_m_s(worst_j, stay_m_s, self._mass_kg)
        hardest_j = [np.where(guard == kind, lost_j, 0.0).max(axis=1) for kind in IMPACTS]
        final_m = result.final[:, LengthState.x_s]
        stays = (result.status == DONE) & (result.event_count <= MOST_EVENTS)
        stays &= final_m > self._stroke_m - AT_STOP_M
        lasts = stays & (arrival_s <= limit_s)
        late = np.where(
            np.isfinite(arrival_s),
            np.maximum(arrival_s - limit_s, 0.0) / HOLD_S,
            2.0 - np.clip(final_m / self._stroke_m, -1.0, 1.0),
        )
        return Arrivals(
            np.where(lasts, worst_m_s, NOT_ARRIVED + late),
            np.where(lasts, stay_m_s, np.inf),
            np.where(lasts, worst_m_s, np.inf),
            np.where(lasts, arrival_s, np.inf),
            first(happened & (guard == self._revealing), time_s),
            np.where(stays, arrival_s - limit_s, np.inf),
            np.stack([stay_m_s, *np.sqrt(2.0 * np.array(hardest_j) / self._mass_kg)], axis=1),
        )


def first(which: Bools, time_s: Floats) -> Floats:
    """Return the time [runs] in s of the first marked event of [runs, events], infinite without one."""
    found: Floats = np.where(which, time_s, np.inf).min(axis=1)
    return found

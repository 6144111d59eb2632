"""Simulate many command sequences under one load: when each reveals the load, and how it arrives.

The loads of a family differ in one unknown. The motion of the stay is the same for all of them until
an event whose time depends on the unknown: the synchronizer's release on the gearbox, the first
contact of piston and stay in the laboratory (the stay cannot move before).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from plant.batch.batch import Strokes, simulate_batch
from plant.devices.valve import NS_PER_S, switch_schedule
from plant.effects.setup import Setup
from plant.effects.stroke_conditions import FULL_DUTY, StrokeConditions
from plant.integrator.hybrid import GUARD_NAMES
from plant.integrator.loop import DONE
from plant.kernel.layout import EventRow
from plant.parameters import ParameterSet
from plant.systems.setup import make_setup

Floats = NDArray[np.float64]
ROOM = 48
"""Most events recorded of each stroke."""


@dataclass(frozen=True)
class LoadCase:
    """The load of a shift from neutral to backward."""

    name: str
    supply_pressure_pa: float = 900000.0
    mounted: bool = False
    mesh_force_n: float = 0.0
    sync_impulse_n_s: float = 0.0
    damper: bool = False


@dataclass(frozen=True)
class Family:
    """Loads that differ in one unknown, and the event that reveals which it is."""

    name: str
    unknown: str
    revealed_by: Literal["collar 1 contact", "unblock"]
    cases: tuple[LoadCase, ...]


LABORATORY = Family(
    "laboratory",
    "supply pressure, 6 to 9 bar",
    "collar 1 contact",
    tuple(LoadCase(f"{bar:g} bar", supply_pressure_pa=1e5 * bar) for bar in (6.0, 7.0, 8.0, 9.0)),
)
GEARBOX = Family(
    "gearbox",
    "impulse of the synchronizer, 18 to 250 N s",
    "unblock",
    tuple(
        LoadCase(f"{impulse:g} N s", mounted=True, mesh_force_n=1300.0, sync_impulse_n_s=impulse)
        for impulse in (18.0, 40.0, 78.0, 140.0, 250.0)
    ),
)
FAMILIES = {family.name: family for family in (LABORATORY, GEARBOX)}


@dataclass(frozen=True)
class Commands:
    """Times at which the two commands change, s: the driving valve from on, neutral from off."""

    driving_s: tuple[float, ...] = ()
    braking_s: tuple[float, ...] = ()

    @property
    def switches(self) -> int:
        """Return the number of changes."""
        return len(self.driving_s) + len(self.braking_s)

    def until(self, time_s: float) -> Commands:
        """Return the changes up to a time."""
        return Commands(
            tuple(t for t in self.driving_s if t <= time_s),
            tuple(t for t in self.braking_s if t <= time_s),
        )

    def then(self, later: Commands) -> Commands:
        """Return these changes followed by later ones."""
        return Commands(self.driving_s + later.driving_s, self.braking_s + later.braking_s)


@dataclass(frozen=True)
class Arrivals:
    """Impact speed [n] in m/s and time [n] in s of sequences, and when each revealed the load [n] in s.

    Infinite where there is none.
    """

    speed_m_s: Floats
    time_s: Floats
    revealed_s: Floats


@dataclass
class Shooter:
    """Simulate command sequences under one load with the plant's equations.

    limit_s: an arrival later than this counts as none. `runs` counts the simulations.
    """

    parameters: ParameterSet
    case: LoadCase
    limit_s: float
    revealed_by: str = "unblock"
    runs: int = 0

    def __post_init__(self) -> None:
        case = self.case
        self._setup: Setup = make_setup(
            self.parameters,
            StrokeConditions(
                "N-B",
                case.supply_pressure_pa,
                ((0.0, "B", FULL_DUTY),),
                load="damper" if case.damper else "none",
                mounted=case.mounted,
                mesh_force_n=case.mesh_force_n,
                sync_impulse_n_s=case.sync_impulse_n_s,
            ),
        )
        self._base = Strokes.from_setups([self._setup], self.limit_s)
        self._half_m = 0.5 * self.parameters.value("length.stroke")
        self._guard = next(k for k, name in GUARD_NAMES.items() if name == self.revealed_by)

    def shoot(self, sequences: Sequence[Commands]) -> Arrivals:
        """Simulate sequences [n] up to the limit."""
        n = len(sequences)
        self.runs += n
        base = self._base
        rows = [self._switches(each) for each in sequences]
        longest = max(len(row) for row in rows)
        switches = np.zeros((n, longest, 4))
        switches[:, :, 0] = np.inf
        for k, row in enumerate(rows):
            switches[k, : len(row), :3] = np.array(row).reshape(-1, 3)
        result = simulate_batch(
            Strokes(
                base.system,
                np.repeat(base.packed, n, axis=0),
                base.flow,
                base.initial,
                base.modes,
                base.valves,
                switches,
                base.duration_s,
            ),
            event_room=ROOM,
            lanes=False,
        )
        speed = np.full(n, math.inf)
        time_s = np.full(n, math.inf)
        revealed_s = np.full(n, math.inf)
        for k in range(n):
            events = result.events[k, : min(int(result.event_count[k]), ROOM)]
            revealing = events[events[:, EventRow.guard] == self._guard]
            if len(revealing):
                revealed_s[k] = revealing[0, EventRow.time]
            at = result.arrival_s[k]
            hit = events[(events[:, EventRow.time] == at) & (events[:, EventRow.speed] > 0.0)]
            in_gear = len(hit) > 0 and hit[0, EventRow.x] > self._half_m
            if result.status[k] == DONE and in_gear and at <= self.limit_s:
                speed[k] = result.impact_speed_m_s[k]
                time_s[k] = at
        return Arrivals(speed, time_s, revealed_s)

    def _switches(self, commands: Commands) -> list[tuple[float, int, float]]:
        names = self._setup.conditions.chambers
        b, n = names.index("B"), names.index("N")
        given = [(0.0, b, FULL_DUTY)]
        given += [(t, b, FULL_DUTY if k % 2 else 0.0) for k, t in enumerate(commands.driving_s)]
        given += [(t, n, 0.0 if k % 2 else FULL_DUTY) for k, t in enumerate(commands.braking_s)]
        moves = switch_schedule(given, self._setup.timing, len(names))
        return [
            (at_ns / NS_PER_S, chamber, u) for at_ns, chamber, u in moves
            if at_ns < self.limit_s * NS_PER_S
        ]  # fmt: skip


def plain_push(parameters: ParameterSet, case: LoadCase, event: str) -> tuple[float, float]:
    """Return impact speed [m/s] and arrival [s] of the push without any further command."""
    found = Shooter(parameters, case, 1.0, event).shoot([Commands()])
    return float(found.speed_m_s[0]), float(found.time_s[0])

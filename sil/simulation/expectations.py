"""The [expect] table of a scenario, and the checks that decide whether a run passed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated, Any, Literal

import msgspec

from can_dbc.messages import (
    ControllerStatus,
    Fault,
    Gear,
    PlantMotion,
    ShiftRequest,
    ValveCommand,
)
from sil.files.quantity import unit_of
from sil.recording.run_record import CHAMBERS, RunRecord
from sil.simulation.metrics import Shift, gear_at
from sil.simulation.results import Check

GearName = Literal["neutral", "backward", "forward"]
ChamberName = Literal["B", "N", "F"]
StateName = Literal["INIT", "IDLE", "PUSH", "CONFIRM", "BLOW", "HOLD", "VENT", "FAULT"]
FaultName = Literal[
    "POSITION_LOST",
    "POSITION_IMPLAUSIBLE",
    "REQUEST_LOST",
    "SPEEDS_LOST",
    "SHIFT_TIMEOUT",
    "SENSOR_STUCK",
    "REQUEST_INVALID",
    "INTERNAL",
]
Instant = Literal[
    "requested", "commanded", "valve_open", "first_motion", "arrived", "confirmed", "blow_end"
]
MetricName = Literal[
    "shift_time_s",
    "impact_speed_m_s",
    "impact_energy_j",
    "position_lag_10_s",
    "position_lag_90_s",
    "bus_lag_10_s",
    "bus_lag_90_s",
    "air_used_kg",
    "valve_switchings",
    "frames",
]

_NEVER_NONE = (ShiftRequest, ValveCommand, ControllerStatus, PlantMotion)
"""Messages that every run must have on the bus, or nothing was tested."""


class Limits(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A closed range; a missing side is open."""

    min: float | None = None
    """Smallest value allowed."""
    max: float | None = None
    """Largest value allowed."""

    def holds(self, value: float | None) -> bool:
        """Return whether a value exists and is within the limits."""
        if value is None:
            return False
        return (self.min is None or value >= self.min) and (self.max is None or value <= self.max)

    def check(self, name: str, value: float | None, unit: str) -> Check:
        """Return the check of a named value against these limits."""
        given = {k: v for k, v in (("min", self.min), ("max", self.max)) if v is not None}
        return Check(name=name, passed=self.holds(value), value=value, limit=given, unit=unit)


class Timing(msgspec.Struct, frozen=True, forbid_unknown_fields=True, rename={"start": "from"}):
    """Limits of the time from one instant of a shift to another."""

    to: Instant
    """Instant at which the time ends."""
    start: Instant = "requested"
    """Instant at which the time begins."""
    shift: Annotated[int, msgspec.Meta(ge=1)] = 1
    """Number of the shift, from 1."""
    min_s: float | None = None
    """Shortest time allowed."""
    max_s: float | None = None
    """Longest time allowed."""


class Expectations(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The [expect] table of a scenario; what is left out is not checked."""

    final_gear: GearName | Literal["unknown"] | None = None
    """Gear whose stop the stay is at when the run ends, in the plant."""
    confirmed_gear: GearName | Literal["unknown"] | None = None
    """Gear that the controller reports at the end."""
    states: list[StateName] = []
    """States that the controller must have reported."""
    never_states: list[StateName] = []
    """States that the controller must not have reported."""
    valves_opened: list[ChamberName] | None = None
    """Valves that must have opened; no others may."""
    faults: list[FaultName] | None = None
    """Faults that the controller must have reported at some time; no others may."""
    valves_off_at_end: bool | None = None
    """Whether all valves are off at the end."""
    metrics: dict[MetricName, Limits] = {}
    """Limits of metrics by name, e.g. shift_time_s = { max = 0.1 }."""
    timing: list[Timing] = []
    """Limits of the time between two instants of a shift."""
    min_frames: Annotated[int, msgspec.Meta(ge=1)] = 1
    """Least number of frames of each kind that show that the run did anything."""


class Observed:
    """What the expectations need of a run, collected piece by piece in order of time."""

    def __init__(self) -> None:
        self.stroke_m = math.nan
        self.counts: dict[type, int] = dict.fromkeys(_NEVER_NONE, 0)
        self.opened: set[str] = set()
        self.valves_off = True
        self.position_m = 0.0
        self.confirmed: Gear | None = None
        self.faults = Fault.NONE
        self.visited: list[str] = []

    def add(self, record: RunRecord) -> None:
        """Add the next piece of the run."""
        self.stroke_m = record.stroke_m
        for kind in self.counts:
            self.counts[kind] += sum(1 for _ in record.each(kind))
        if len(record.truth["time_s"]):
            valves = [record.truth[f"valve_{c}"] for c in CHAMBERS]
            self.opened |= {c for c, u in zip(CHAMBERS, valves, strict=True) if (u > 0.5).any()}
            self.valves_off = all(u[-1] < 0.5 for u in valves)
            self.position_m = float(record.truth["position_m"][-1])
        for _, message in record.of(ControllerStatus):
            self.confirmed = message.confirmed
            self.faults |= message.faults
            if message.state.name not in self.visited:
                self.visited.append(message.state.name)


def evaluate(
    wanted: Expectations, record: RunRecord, found: Sequence[Shift], metrics: dict[str, Any]
) -> list[Check]:
    """Return one Check per expectation, after those that the run did anything at all."""
    observed = Observed()
    observed.add(record)
    return evaluate_observed(wanted, observed, found, metrics)


def evaluate_observed(
    wanted: Expectations, observed: Observed, found: Sequence[Shift], metrics: dict[str, Any]
) -> list[Check]:
    """Return what `evaluate` does, of a run that was observed piece by piece."""
    checks = _not_vacuous(wanted, observed, found)
    checks += _ends(wanted, observed)
    checks += _states(wanted, observed)
    if wanted.valves_opened is not None:
        opened = [c for c in CHAMBERS if c in observed.opened]
        checks.append(_equal("valves opened", opened, sorted(wanted.valves_opened, key=_order)))
    for name, limits in wanted.metrics.items():
        value = metrics[name]
        checks.append(limits.check(name, value, unit_of(name)))
    checks += [_timing(t, found) for t in wanted.timing]
    return checks


def _order(chamber: str) -> int:
    return CHAMBERS.index(chamber)


def _equal(name: str, value: Any, limit: Any) -> Check:
    return Check(name=name, passed=value == limit, value=value, limit=limit)


def _not_vacuous(wanted: Expectations, observed: Observed, found: Sequence[Shift]) -> list[Check]:
    checks = []
    for kind, count in observed.counts.items():
        name = f"{kind.__name__} frames on the bus"
        least = wanted.min_frames
        checks.append(Check(name=name, passed=count >= least, value=count, limit={"min": least}))
    if wanted.valves_opened is None and found:
        opened = len(observed.opened)
        checks.append(
            Check(name="a valve opened", passed=opened > 0, value=opened, limit={"min": 1})
        )
    return checks


def _ends(wanted: Expectations, observed: Observed) -> list[Check]:
    checks = []
    if wanted.final_gear is not None:
        gear = gear_at(observed.position_m, observed.stroke_m).name.lower()
        checks.append(_equal("final gear", gear, wanted.final_gear))
    if wanted.confirmed_gear is not None:
        confirmed = None if observed.confirmed is None else observed.confirmed.name.lower()
        checks.append(_equal("confirmed gear", confirmed, wanted.confirmed_gear))
    if wanted.faults is not None:
        names = sorted(f.name or "" for f in Fault if f and f in observed.faults)
        checks.append(_equal("faults reported", names, sorted(wanted.faults)))
    if wanted.valves_off_at_end is not None:
        checks.append(
            _equal("valves off at the end", observed.valves_off, wanted.valves_off_at_end)
        )
    return checks


def _states(wanted: Expectations, observed: Observed) -> list[Check]:
    visited = observed.visited
    checks = []
    if wanted.states:
        missing = [s for s in wanted.states if s not in visited]
        checks.append(
            Check(
                name="states visited", passed=not missing, value=visited, limit=list(wanted.states)
            )
        )
    if wanted.never_states:
        entered = [s for s in wanted.never_states if s in visited]
        checks.append(
            Check(
                name="states never entered",
                passed=not entered,
                value=visited,
                limit=list(wanted.never_states),
            )
        )
    return checks


def _timing(wanted: Timing, found: Sequence[Shift]) -> Check:
    name = f"shift {wanted.shift}: {wanted.start} to {wanted.to}"
    limits = Limits(wanted.min_s, wanted.max_s)
    value = None
    if wanted.shift <= len(found):
        shift = found[wanted.shift - 1]
        start, end = getattr(shift, f"{wanted.start}_s"), getattr(shift, f"{wanted.to}_s")
        if start is not None and end is not None:
            value = end - start
    return limits.check(name, value, "s")

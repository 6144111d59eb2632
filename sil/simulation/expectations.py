"""The [expect] table of a scenario, and the checks that decide whether a run passed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, Any, Literal

import msgspec
from msgspec.structs import asdict

from can_dbc.messages import (
    ControllerStatus,
    Fault,
    Gear,
    PlantMotion,
    ShiftRequest,
    ShiftState,
    ValveCommand,
)
from plant.devices.conditions import ChamberName
from sil.files.quantity import unit_of
from sil.recording.run_record import CHAMBERS, RunRecord
from sil.rules.rule import Circumstances, Rule, Violation, violations
from sil.rules.shipped import RULES
from sil.simulation.metrics import METRICS, Shift, gear_at
from sil.simulation.results import Check

GearName = Literal["neutral", "backward", "forward"]
StateName = Literal["INIT", "IDLE", "PUSH", "CONFIRM", "BLOW", "HOLD", "VENT", "FAULT"]
if TYPE_CHECKING:
    FaultName = str
    MetricName = str
    RuleName = str
else:
    FaultName = Literal[tuple(fault.name for fault in Fault if fault)]
    MetricName = Literal[tuple(METRICS)]
    RuleName = Literal[tuple(rule.name for rule in RULES)]
Instant = Literal[
    "requested", "commanded", "valve_open", "first_motion", "arrived", "confirmed", "blow_end"
]


RULES_BROKEN = "rules broken"
UNFINISHED = "neither confirmed nor refused at the end"


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
        limit = {key: end for key, end in asdict(self).items() if end is not None}
        return Check(name=name, passed=self.holds(value), value=value, limit=limit, unit=unit)


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
    lockstep: bool = False
    """Judge it in lockstep only: nodes with clocks of their own read them at slightly other instants."""


class Expectations(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The [expect] table of a scenario; what is left out is not checked."""

    final_gear: GearName | Literal["unknown"] | None = None
    """Gear whose stop the stay is at when the run ends, in the plant."""
    confirmed_gear: GearName | Literal["unknown"] | None = None
    """Gear that the controller reports at the end."""
    unfinished: bool = False
    """Allow the last request to be neither confirmed nor refused (in FAULT) at the end. If false, and
    confirmed_gear left out, it must be one of them."""
    confirmed_after_arrival: bool = False
    """Whether gears must be confirmed, and no sooner than the stay has arrived to remain."""
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
    violated: list[RuleName] = []
    """Rules that the run breaks, as a fault may make it; all others must be kept."""
    metrics: dict[MetricName, Limits] = {}
    """Limits of metrics by name, e.g. shift_time_s = { max = 0.1 }."""
    lockstep: dict[MetricName, Limits] = {}
    """Limits of metrics that hold in lockstep only: nodes with clocks of their own sample at another phase."""
    timing: list[Timing] = []
    """Limits of the time between two instants of a shift."""
    min_frames: Annotated[int, msgspec.Meta(ge=1)] = 1
    """Least number of frames of each kind that show that the run did anything."""


class Observed:
    """What the expectations need of a run, collected piece by piece in order of time."""

    def __init__(
        self, circumstances: Circumstances, *records: RunRecord, rules: Sequence[Rule] = RULES
    ) -> None:
        self._circumstances = circumstances
        self._rules = rules
        self.violations: dict[str, Violation] = {}
        self.stroke_m = math.nan
        kinds = (ShiftRequest, ValveCommand, ControllerStatus, PlantMotion)
        self.counts: dict[type, int] = dict.fromkeys(kinds, 0)
        self.opened: set[str] = set()
        self.valves_off = True
        self.position_m = 0.0
        self.confirmed: Gear | None = None
        self.refuses = False
        self.faults = Fault.NONE
        self.visited: list[str] = []
        for record in records:
            self.add(record)

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
            self.refuses = message.state is ShiftState.FAULT
            self.faults |= message.faults
            if message.state.name not in self.visited:
                self.visited.append(message.state.name)
        for violation in violations(record, self._circumstances, self._rules):
            self.violations.setdefault(violation.rule, violation)


def evaluate(
    wanted: Expectations,
    observed: Observed,
    shifts: Sequence[Shift],
    metrics: dict[str, Any],
    last_request: GearName | None = None,
) -> list[Check]:
    """Return one Check per expectation, after those that the run did anything; last_request: the last gear."""
    least, visited = wanted.min_frames, observed.visited
    checks = [
        _check(f"{kind.__name__} frames on the bus", count, {"min": least}, count >= least)
        for kind, count in observed.counts.items()
    ]
    if wanted.valves_opened is None and last_request is not None:
        count = len(observed.opened)
        checks.append(_check("a valve opened", count, {"min": 1}, count > 0))
    if last_request and wanted.confirmed_gear is None and not wanted.unfinished:
        done = observed.confirmed == Gear[last_request.upper()]
        state = "confirmed" if done else "refused" if observed.refuses else UNFINISHED
        limit = "confirmed or refused"
        checks.append(_check(f"request for {last_request}", state, limit, state != UNFINISHED))
    if wanted.final_gear is not None:
        gear = gear_at(observed.position_m, observed.stroke_m).name.lower()
        checks.append(_check("final gear", gear, wanted.final_gear))
    if wanted.confirmed_gear is not None:
        confirmed = None if observed.confirmed is None else observed.confirmed.name.lower()
        checks.append(_check("confirmed gear", confirmed, wanted.confirmed_gear))
    if wanted.confirmed_after_arrival:
        early_s = metrics["confirmed_early_s"]
        checks.append(Limits(max=0.0).check("confirmed before arrival", early_s, "s"))
    if wanted.faults is not None:
        names = sorted(f.name or "" for f in Fault if f and f in observed.faults)
        checks.append(_check("faults reported", names, sorted(wanted.faults)))
    if (off := wanted.valves_off_at_end) is not None:
        checks.append(_check("valves off at the end", observed.valves_off, off))
    if states := wanted.states:
        checks.append(_check("states visited", visited, states, {*states} <= {*visited}))
    if states := wanted.never_states:
        avoided = not {*states} & {*visited}
        checks.append(_check("states never entered", visited, states, avoided))
    if wanted.valves_opened is not None:
        expected = sorted(wanted.valves_opened, key=CHAMBERS.index)
        opened = sorted(observed.opened, key=CHAMBERS.index)
        checks.append(_check("valves opened", opened, expected))
    broken = [f"{v.rule} at {v.time_s:.3f} s: {v.text}" for v in observed.violations.values()]
    as_stated = set(observed.violations) == set(wanted.violated)
    checks.append(_check(RULES_BROKEN, broken, wanted.violated, as_stated))
    for name, limits in (*wanted.metrics.items(), *wanted.lockstep.items()):
        checks.append(limits.check(name, metrics.get(name), unit_of(name)))
    return checks + [_timing(t, shifts) for t in wanted.timing]


def _check(name: str, value: Any, limit: Any, passed: bool | None = None) -> Check:
    """Return a check of a value; without `passed`, it must be equal to the limit."""
    passed = value == limit if passed is None else passed
    return Check(name=name, passed=passed, value=value, limit=limit)


def _timing(wanted: Timing, shifts: Sequence[Shift]) -> Check:
    name = f"shift {wanted.shift}: {wanted.start} to {wanted.to}"
    shift = shifts[wanted.shift - 1] if wanted.shift <= len(shifts) else None
    start, end = (getattr(shift, f"{instant}_s", None) for instant in (wanted.start, wanted.to))
    value = None if start is None or end is None else end - start
    return Limits(wanted.min_s, wanted.max_s).check(name, value, "s")

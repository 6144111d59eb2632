"""The [expect] table of a scenario; `judgement.py` holds a run to it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Literal

import msgspec
from msgspec.structs import asdict

from can_dbc.messages import Fault
from plant.devices.conditions import ChamberName
from sil.rules.shipped import RULES
from sil.simulation.metrics import METRICS
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

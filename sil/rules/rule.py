"""A rule, what it is judged by, and where it was broken first."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import msgspec

from controller.config import FirmwareConfig
from sil.recording.run_record import RunRecord

Broken = tuple[float, str] | None


@dataclass(frozen=True)
class Circumstances:
    """What a rule may know of a run besides its record.

    control: the firmware's settings. driver_timeout_s: of the valve driver. late_s: longest time that
    stated faults or loads hold a frame back. sight_s: longest time until a motion of the stay shows in the
    reports; infinite if a sensor may be wrong without looking so. true_samples: False if faults may
    change or repeat position samples. repeated_s: age of repeated reports.
    down_s: intervals in which the controller is dead or cut off; deaf_s: in which it understands no frame. disturbed: True if faults or loads of
    the bus may change, lose or hold back frames. forced: True if valves may move the stay by themselves. slow_clock: seconds per second of the
    controller's clock.
    """

    control: FirmwareConfig
    driver_timeout_s: float
    late_s: float = 0.0
    sight_s: float = math.inf
    true_samples: bool = True
    repeated_s: float = 0.0
    down_s: tuple[tuple[float, float], ...] = ()
    deaf_s: tuple[tuple[float, float], ...] = ()
    disturbed: bool = False
    forced: bool = False
    slow_clock: float = 1.0


class Violation(msgspec.Struct, frozen=True):
    """The first time that a run broke a rule."""

    rule: str
    time_s: float
    text: str


@dataclass(frozen=True)
class Rule:
    """Something that every run keeps.

    first: returns the instant in s at which a record breaks the rule first, with what happened; None
    if it keeps it. source: where the rule comes from.
    """

    name: str
    sentence: str
    source: str
    first: Callable[[RunRecord, Circumstances], Broken]


def violations(
    record: RunRecord, circumstances: Circumstances, rules: Iterable[Rule]
) -> list[Violation]:
    """Return where a record breaks rules, one violation of each at most, in their order."""
    broken = ((rule.name, rule.first(record, circumstances)) for rule in rules)
    return [Violation(name, *first) for name, first in broken if first is not None]

"""Simulated time: whole nanoseconds since the start of the run, never the wall clock."""

from __future__ import annotations

import math

from can_dbc.errors import InputError
from can_dbc.instants import NS_PER_S

NEVER_NS = (1 << 48) - 1  # the largest instant of the lockstep, 78 h


def to_ns(seconds: float, name: str = "time") -> int:
    """Return the whole nanosecond nearest to `seconds`, which `name` names in the message.

    Raises InputError for a value that is not finite, negative, or beyond the lockstep's range (78 h).
    """
    if not math.isfinite(seconds) or seconds < 0.0:
        raise InputError(f"{name}: {seconds!r} s; expected a finite time, zero or more")
    if seconds >= NEVER_NS // NS_PER_S:
        raise InputError(f"{name}: {seconds!r} s; expected less than {NEVER_NS // NS_PER_S} s")
    return round(seconds * NS_PER_S)


def to_seconds(nanoseconds: int) -> float:
    """Return the float64 nearest to `nanoseconds` in seconds."""
    return nanoseconds / NS_PER_S


def next_tick(after_ns: int, period_ns: int, phase_ns: int = 0) -> int:
    """Return the first instant of the schedule phase + k * period (k = 0, 1, ...) after `after_ns`."""
    if after_ns < phase_ns:
        return phase_ns
    return phase_ns + ((after_ns - phase_ns) // period_ns + 1) * period_ns

"""Real-time pacing: simulated instants tied to the wall clock, and their lateness."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

from can_dbc.errors import InputError
from sil.coupling.clock import to_seconds

_LAST_SLEEP_NS = 2_000_000
"""The last stretch is slept, not polled: poll wakes up on whole milliseconds only."""


@dataclass(frozen=True)
class Lateness:
    """How late the simulated instants were, in seconds of the wall clock.

    `instants`: number awaited; `overruns`: number already late when their turn came.  The quantiles
    are over all instants, rounded up to two significant digits.
    """

    factor: float
    instants: int
    p50_s: float
    p99_s: float
    max_s: float
    overruns: int


class Histogram:
    """Counts of nanosecond values, rounded up to two significant digits: memory stays flat."""

    def __init__(self) -> None:
        self._counts: dict[int, int] = {}
        self.total = 0
        self.maximum = 0

    def add(self, value: int) -> None:
        """Count one value; negative ones count as 0."""
        value = max(0, value)
        self.total += 1
        self.maximum = max(self.maximum, value)
        step = 1
        while value > 99 * step:
            step *= 10
        rounded = -(-value // step) * step
        self._counts[rounded] = self._counts.get(rounded, 0) + 1

    def quantile(self, share: float) -> int:
        """Return the value that `share` (0 to 1) of those counted do not exceed; 0 if none."""
        passed = 0
        for value in sorted(self._counts):
            passed += self._counts[value]
            if passed >= share * self.total:
                return min(value, self.maximum)
        return 0


class Pacer:
    """Delays simulated instants until the wall clock has reached them.

    The schedule is absolute: wall = origin + (simulated - simulated origin) / factor, so that one
    late instant does not shift those after it.
    """

    def __init__(
        self,
        factor: float = 1.0,
        clock: Callable[[], int] = time.monotonic_ns,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        """Set `factor`, simulated seconds per wall second.  Raises InputError unless it is positive."""
        if not 1e-6 <= factor <= 1e6:
            raise InputError(f"real-time factor {factor!r}: expected 1e-6 to 1e6")
        self.factor = factor
        self._clock = clock
        self._sleep = sleep
        self._origin_wall = 0
        self._origin_simulated: int | None = None
        self._late = Histogram()
        self._overruns = 0

    def wait(self, simulated_ns: int, idle: Callable[[float], None]) -> None:
        """Return when the wall clock has reached the instant; `idle(seconds)` passes long waits.

        The first call ties its instant to the present wall time.
        """
        if self._origin_simulated is None:
            self._origin_wall = self._clock()
            self._origin_simulated = simulated_ns
            return
        due = self._origin_wall + round((simulated_ns - self._origin_simulated) / self.factor)
        left = due - self._clock()
        if left < 0:
            self._overruns += 1
        elif left > _LAST_SLEEP_NS:
            idle(to_seconds(left - _LAST_SLEEP_NS))
        left = due - self._clock()
        if left > 0:
            self._sleep(to_seconds(left))
        self._late.add(self._clock() - due)

    def lateness(self) -> Lateness:
        """Return what was measured so far."""
        return Lateness(
            factor=self.factor,
            instants=self._late.total,
            p50_s=to_seconds(self._late.quantile(0.5)),
            p99_s=to_seconds(self._late.quantile(0.99)),
            max_s=to_seconds(self._late.maximum),
            overruns=self._overruns,
        )

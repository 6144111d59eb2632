"""Real-time pacing: simulated instants tied to the wall clock, and their lateness."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from can_dbc.errors import InputError
from sil.coupling.clock import to_seconds


@dataclass(frozen=True)
class Lateness:
    """How late the simulated instants were, in seconds of the wall clock.

    `instants`: number awaited; `overruns`: late when their turn came. Quantiles are rounded up to two digits.
    """

    factor: float
    instants: int
    p50_s: float
    p99_s: float
    max_s: float
    overruns: int


def rounded_up(value: int) -> int:
    """Return a value of 0 or more, rounded up to two significant digits."""
    step = 1
    while value > 99 * step:
        step *= 10
    return -(-value // step) * step


def quantile(counts: Mapping[int, int], share: float) -> int:
    """Return the value that `share` (0 to 1) of those counted do not exceed; 0 if none."""
    passed, total = 0, sum(counts.values())
    for value in sorted(counts):
        passed += counts[value]
        if passed >= share * total:
            return value
    return 0


class Pacer:
    """Delays instants to the wall clock: wall = origin + (simulated - simulated origin) / factor, absolute."""

    def __init__(
        self,
        factor: float = 1.0,
        clock: Callable[[], int] = time.monotonic_ns,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        """Set `factor`, simulated seconds per wall second.  Raises InputError unless it is positive."""
        if not 1e-6 <= factor <= 1e6:
            raise InputError(f"speed: {factor!r}; expected 1e-6 to 1e6 times real time")
        self.factor = factor
        self._clock = clock
        self._sleep = sleep
        self._origin_wall = 0
        self._origin_simulated: int | None = None
        self._late_ns: Counter[int] = Counter()  # rounded, so that memory stays flat
        self._latest_ns = 0
        self._overruns = 0

    def wait(self, simulated_ns: int, idle: Callable[[float], None]) -> None:
        """Return when the wall clock is there, at once the first time; `idle(s)` passes long waits."""
        if self._origin_simulated is None:
            self._origin_wall = self._clock()
            self._origin_simulated = simulated_ns
            return
        due = self._origin_wall + round((simulated_ns - self._origin_simulated) / self.factor)
        last_sleep_ns = 2_000_000  # not polled: poll wakes up on whole milliseconds only
        left = due - self._clock()
        if left < 0:
            self._overruns += 1
        elif left > last_sleep_ns:
            idle(to_seconds(left - last_sleep_ns))
        left = due - self._clock()
        if left > 0:
            self._sleep(to_seconds(left))
        late_ns = max(0, self._clock() - due)
        self._late_ns[rounded_up(late_ns)] += 1
        self._latest_ns = max(self._latest_ns, late_ns)

    def now_ns(self) -> int:
        """Return the simulated instant that the wall clock has reached; the first one before any."""
        if self._origin_simulated is None:
            return 0
        elapsed = (self._clock() - self._origin_wall) * self.factor
        return self._origin_simulated + round(elapsed)

    def lateness(self) -> Lateness:
        """Return what was measured so far."""
        rounded_ns = (quantile(self._late_ns, share) for share in (0.5, 0.99, 1.0))
        p50_s, p99_s, max_s = (to_seconds(min(ns, self._latest_ns)) for ns in rounded_ns)
        instants = self._late_ns.total()
        return Lateness(self.factor, instants, p50_s, p99_s, max_s, self._overruns)

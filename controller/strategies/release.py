"""When the stay is released and when it arrives in a push, found from late reports."""

from __future__ import annotations

from collections.abc import Sequence

from controller.position import Sample
from controller.speeds import cycle_ns

REPORT_RAD_S = 0.28
"""Scatter of a reported difference of the speeds; one below four times this is none."""
ARRIVED = 0.9
"""Share of the stroke at which the stay has passed the teeth."""


class Release:
    """Take the reports of one push; times are in s since its start.

    released_s: when the synchronizer let go, None until it is found. arrived_s: when the stay passed
    the teeth, as late as the sensor reports it. fastest_m_s: greatest speed between two samples since
    the speeds began to fall.
    """

    def __init__(self, sample_period_s: float, stroke_m: float) -> None:
        self.released_s: float | None = None
        self.arrived_s: float | None = None
        self.fastest_m_s = 0.0
        self._period_s = sample_period_s
        self._arrived_m = ARRIVED * stroke_m
        self._cycle_s = 1e-9 * cycle_ns()
        self._before_m: float | None = None
        self._falling: tuple[tuple[float, float], ...] = ()

    @property
    def is_open(self) -> bool:
        """Whether the speeds have begun to fall, but not yet agreed."""
        return bool(self._falling) and self.released_s is None

    def position(self, samples: Sequence[Sample], now_ns: int, start_ns: int) -> None:
        """Take the samples of a step: how fast the stay is, and whether it has passed the teeth.

        now_ns, start_ns: of this step, and of the push.
        """
        for sample in samples:
            if self._before_m is not None and self._falling:
                way_m = abs(sample.raw_m - self._before_m)
                self.fastest_m_s = max(self.fastest_m_s, way_m / self._period_s)
                over_m = abs(sample.raw_m) - self._arrived_m
                if over_m > 0.0 and self.arrived_s is None and way_m > 0.0:
                    back_s = min(over_m / way_m, 1.0) * self._period_s
                    self.arrived_s = 1e-9 * (now_ns - start_ns) - back_s
            self._before_m = sample.raw_m

    def speeds(self, apart_s: float, apart_rad_s: float, before_rad_s: float) -> bool:
        """Take a difference of the speeds at a time; before_rad_s: that before the push.

        The release is between the last report of a difference and the first of none. From the last
        one on the difference falls as before, faster by the trend of the falls. Return False if
        there is none already in the first report: then the release cannot be found.
        """
        if apart_rad_s > 4.0 * REPORT_RAD_S:
            self._falling = (*self._falling, (apart_s, apart_rad_s))[-3:]
            return True
        if not self._falling:
            return False
        last_s, rest_rad_s = self._falling[-1]
        differences = [before_rad_s, *(rad_s for _, rad_s in self._falling)]
        times_s = [at_s for at_s, _ in self._falling]
        fall = differences[-2] - rest_rad_s
        if len(times_s) > 1:
            fall /= self._cycles(times_s[-2], last_s)
        if len(times_s) == 3:
            before = (differences[-3] - differences[-2]) / self._cycles(times_s[0], times_s[1])
            fall += 0.7 * (fall - before)
        cycles = self._cycles(last_s, apart_s)
        share = rest_rad_s / fall if fall * cycles > rest_rad_s else cycles
        self.released_s = last_s + share * (apart_s - last_s) / cycles
        return True

    def _cycles(self, from_s: float, to_s: float) -> int:
        """Return by how many cycles of the reports one follows another, between which some are missing."""
        return max(round((to_s - from_s) / self._cycle_s), 1)

"""When the stay is released in a push, found from late reports of the speeds."""

from __future__ import annotations

from controller.speeds import cycle_ns

REPORT_RAD_S = 0.28
"""Scatter of a reported difference of the speeds; one below four times this is none."""


class Release:
    """Take the reports of one push; times are in s since its start.

    released_s: when the synchronizer let go, None until it is found.
    """

    def __init__(self) -> None:
        self.released_s: float | None = None
        self._cycle_s = 1e-9 * cycle_ns()
        self._falling: tuple[tuple[float, float], ...] = ()

    @property
    def is_falling(self) -> bool:
        """Whether the speeds have begun to fall."""
        return bool(self._falling)

    @property
    def is_open(self) -> bool:
        """Whether the speeds have begun to fall, but not yet agreed."""
        return bool(self._falling) and self.released_s is None

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

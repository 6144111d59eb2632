"""When the shaft speeds were reported, and whether they can be those of shafts."""

from __future__ import annotations

from can_dbc.contract import contract
from can_dbc.messages import DrivelineSpeeds, Gear

FASTEST_RAD_S2 = 500.0
"""Change of the speed difference that no engine exceeds while the stay is in neutral (inferred: three
times the ramp of an engine that synchronises)."""
SCATTER_RAD_S = 1.6
"""Four standard deviations of the change between two reports of four speeds, each 0.2 rad/s off."""


def cycle_ns() -> int:
    """Return how often the speeds are reported."""
    return contract()[DrivelineSpeeds.__name__].cycle_ns


class SpeedsWatch:
    """Doubt speeds that jump in neutral until they have agreed in a gear.

    steady: whether they are beyond doubt, which they are at power-on. A sensor that has jumped stays
    wrong, and its speeds look steady again; that they are right shows only where the shafts are
    known to turn alike. agreed: whether they did in the last gear since power-on; False before it. On
    the way between gears nothing is judged: the difference jumps there as it is referred to another
    ratio.
    """

    def __init__(self, tolerance_rad_s: float) -> None:
        """tolerance_rad_s: difference up to which the speeds agree."""
        self.steady = True
        self.agreed = False
        self._tolerance_rad_s = tolerance_rad_s
        self._last: tuple[int, float, Gear] | None = None

    def update(self, now_ns: int, speeds: DrivelineSpeeds | None, gear: Gear) -> None:
        """Take a new report, None for none, in a gear; UNKNOWN: in none that is certain."""
        before = self._last
        if speeds is None:
            return
        apart_rad_s = speeds.input_rad_s - speeds.output_rad_s
        self._last = (now_ns, apart_rad_s, speeds.referred) if gear is Gear.NEUTRAL else None
        if gear in (Gear.BACKWARD, Gear.FORWARD):
            self.steady = self.agreed = abs(apart_rad_s) <= self._tolerance_rad_s
        elif self._last and before and before[2] is speeds.referred:
            most_rad_s = 1e-9 * FASTEST_RAD_S2 * (now_ns - before[0]) + SCATTER_RAD_S
            self.steady &= abs(apart_rad_s - before[1]) <= most_rad_s


class ReportTimes:
    """The steps at which reports of the speeds should arrive.

    A report whose sender and the firmware's step meet arrives by chance just before a step or just
    after it, where the next step sees it first: as if it were a cycle older. By its number among those
    sent it was due so many cycles after the one before it. Of such reports all count as those that come
    later. A report that is more than a cycle early, and those of a faster sender, count from the step that
    sees them.
    """

    def __init__(self) -> None:
        self._last: tuple[int, int] | None = None  # time, number
        self._sent = 0  # since the one before that

    def at_ns(self, now_ns: int, number: int | None) -> int:
        """Return the time of a new report that a step sees first; number: None for the step's own."""
        last, before = self._last, self._sent
        at_ns, self._sent = now_ns, 0
        if last is not None and number is not None:
            self._sent = number - last[1]
            due_ns = last[0] + cycle_ns() * self._sent
            if now_ns < due_ns <= now_ns + cycle_ns() and min(before, self._sent) == 1:
                at_ns = due_ns
        self._last = None if number is None else (at_ns, number)
        return at_ns

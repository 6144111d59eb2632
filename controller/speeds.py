"""Whether the reported shaft speeds can be those of shafts."""

from __future__ import annotations

from can_dbc.messages import DrivelineSpeeds, Gear

FASTEST_RAD_S2 = 500.0
"""Change of the speed difference that no engine exceeds while the stay is in neutral (inferred: three
times the ramp of an engine that synchronises)."""
SCATTER_RAD_S = 1.6
"""Four standard deviations of the change between two reports of four speeds, each 0.2 rad/s off."""


class SpeedsWatch:
    """Doubt speeds that jump in neutral until they have agreed in a gear.

    steady: whether they are beyond doubt, which they are at power-on. A sensor that has jumped stays
    wrong, and its speeds look steady again; that they are right shows only where the shafts are
    known to turn alike. On the way between gears nothing is judged: the difference jumps there as
    it is referred to another ratio.
    """

    def __init__(self, tolerance_rad_s: float) -> None:
        """tolerance_rad_s: difference up to which the speeds agree."""
        self.steady = True
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
            self.steady = abs(apart_rad_s) <= self._tolerance_rad_s
        elif self._last and before and before[2] is speeds.referred:
            most_rad_s = 1e-9 * FASTEST_RAD_S2 * (now_ns - before[0]) + SCATTER_RAD_S
            self.steady &= abs(apart_rad_s - before[1]) <= most_rad_s

"""Engine torque and speed around the shifts of a log, out of EEC1 (SAE J1939-71, PGN 61444)."""

from __future__ import annotations

from array import array
from bisect import bisect_left, bisect_right
from dataclasses import dataclass
from operator import le
from statistics import median
from typing import Final

from sil.shifts.reported import word_at

PGN_EEC1: Final = 61444


@dataclass(frozen=True, slots=True)
class EngineFigures:
    """The engine around a shift, torque in % of the reference torque (SPN 513).

    before and after: medians over the half second; least: the smallest during the shift.
    torque_cut_s: how long, from half a second before to half a second after the shift, the torque was
    below half of that before; None where there was less than 10 % to cut.
    """

    torque_before_percent: float
    torque_least_percent: float
    torque_after_percent: float | None
    torque_cut_s: float | None
    speed_before_rpm: float
    speed_after_rpm: float | None

    def __str__(self) -> str:
        text = f"engine torque {self.torque_before_percent:.0f} %"
        text += f", down to {self.torque_least_percent:.0f} %"
        if self.torque_cut_s is not None:
            text += f" (cut for {self.torque_cut_s:.2f} s)"
        if self.torque_after_percent is not None:
            text += f", then {self.torque_after_percent:.0f} %"
        text += f", {self.speed_before_rpm:.0f}"
        if self.speed_after_rpm is not None:
            text += f" to {self.speed_after_rpm:.0f}"
        return f"{text} rpm"


class EngineTrace:
    """Samples of one engine: time_ns, torque_percent (SPN 513), speed_rpm (SPN 190), [n] each, by time after `sort`."""

    def __init__(self) -> None:
        self.time_ns = array("q")
        self.torque_percent = array("h")
        self.speed_rpm = array("d")

    def take(self, time_ns: int, data: bytes) -> None:
        """Take one EEC1."""
        speed = word_at(data, 3)
        if speed is not None and data[2] <= 250:
            self.time_ns.append(time_ns)
            self.torque_percent.append(data[2] - 125)
            self.speed_rpm.append(speed / 8)

    def sort(self) -> None:
        """Put the samples in order after the end of the log, whose clock may step backwards."""
        if all(map(le, self.time_ns, self.time_ns[1:])):
            return
        order = sorted(range(len(self.time_ns)), key=self.time_ns.__getitem__)
        for name in ("time_ns", "torque_percent", "speed_rpm"):
            column = getattr(self, name)
            setattr(self, name, array(column.typecode, map(column.__getitem__, order)))

    def figures(self, start_ns: int, end_ns: int) -> EngineFigures | None:
        """Return the figures of a shift, None if the log has no samples before and during it."""
        begin = bisect_left(self.time_ns, start_ns - 500_000_000)
        first, last = bisect_left(self.time_ns, start_ns), bisect_right(self.time_ns, end_ns)
        end = bisect_right(self.time_ns, end_ns + 500_000_000)
        if begin == first or first >= last:
            return None
        torques, speeds = self.torque_percent, self.speed_rpm
        torque = median(torques[begin:first])
        each = range(begin, end - 1)  # a sample counts up to the next
        low_ns = (self.time_ns[n + 1] - self.time_ns[n] for n in each if torques[n] < torque / 2)
        return EngineFigures(
            torque,
            min(torques[first:last]),
            median(torques[last:end]) if last < end else None,
            sum(low_ns) / 1e9 if torque >= 10 else None,
            median(speeds[begin:first]),
            median(speeds[last:end]) if last < end else None,
        )

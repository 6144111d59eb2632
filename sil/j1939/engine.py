"""Engine torque and speed around the shifts of a log, out of EEC1 (SAE J1939-71, PGN 61444)."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from statistics import median
from typing import Final, NamedTuple

from sil.j1939.shift_flag import word_at

PGN_EEC1: Final = 61444
_TORQUE_OFFSET: Final = 125
_LAST_TORQUE_BYTE: Final = 250
_BEFORE_NS: Final = 500_000_000
_KEPT_AFTER_NS: Final = 2_000_000_000
_HELD: Final = 512
_MOST_KEPT: Final = 1_000_000


class EngineSample(NamedTuple):
    """Actual torque in % of the reference torque (SPN 513), and speed in rpm (SPN 190)."""

    time_ns: int
    torque_percent: int
    speed_rpm: float


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
        parts = [f"torque {self.torque_before_percent:.0f} %"]
        parts.append(f"down to {self.torque_least_percent:.0f} %")
        if self.torque_cut_s is not None:
            parts[-1] += f" (cut for {self.torque_cut_s:.2f} s)"
        if self.torque_after_percent is not None:
            parts.append(f"then {self.torque_after_percent:.0f} %")
        speeds = f"{self.speed_before_rpm:.0f}"
        if self.speed_after_rpm is not None:
            speeds += f" to {self.speed_after_rpm:.0f}"
        return f"engine {', '.join(parts)}, {speeds} rpm"


@dataclass(slots=True)
class EngineTrace:
    """Samples of one engine, of which those around shifts are kept."""

    kept: list[EngineSample] = field(default_factory=list)
    _held: deque[EngineSample] = field(default_factory=lambda: deque(maxlen=_HELD))
    _until_ns: int = -(2**63)

    def take(self, time_ns: int, data: bytes) -> None:
        """Take one EEC1 of eight bytes."""
        speed = word_at(data, 3)
        if speed is None or data[2] > _LAST_TORQUE_BYTE:
            return
        sample = EngineSample(time_ns, data[2] - _TORQUE_OFFSET, speed / 8)
        if time_ns <= self._until_ns and len(self.kept) < _MOST_KEPT:
            self.kept.append(sample)
        else:
            self._held.append(sample)

    def keep(self, time_ns: int) -> None:
        """Keep the samples shortly before and after a time: there may be a shift."""
        self.kept += self._held
        self._held.clear()
        self._until_ns = time_ns + _KEPT_AFTER_NS

    def figures(self, start_ns: int, end_ns: int) -> EngineFigures | None:
        """Return the figures of a shift, None if the log has no samples before and during it."""
        near = [s for s in self.kept if start_ns - _BEFORE_NS <= s.time_ns <= end_ns + _BEFORE_NS]
        before = [s for s in near if s.time_ns < start_ns]
        during = [s for s in near if start_ns <= s.time_ns <= end_ns]
        after = [s for s in near if s.time_ns > end_ns]
        if not before or not during:
            return None
        torque = median(s.torque_percent for s in before)
        return EngineFigures(
            torque,
            min(s.torque_percent for s in during),
            median(s.torque_percent for s in after) if after else None,
            _time_below(near, torque / 2) if torque >= 10 else None,
            median(s.speed_rpm for s in before),
            median(s.speed_rpm for s in after) if after else None,
        )


def _time_below(samples: Sequence[EngineSample], limit_percent: float) -> float:
    """Return how long the torque was below a limit, in s; each sample counts up to the next."""
    low = (b.time_ns - a.time_ns for a, b in pairwise(samples) if a.torque_percent < limit_percent)
    return sum(low) / 1e9

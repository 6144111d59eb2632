"""A truck's log from known instants, packed bit by bit as SAE J1939-71 states, without mapping or DBC."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from sil.logs import LogFrame
from tests.support.golden_logs import write

MS = 1_000_000
START_NS = 1_700_000_000_000_000_000
RATIOS = {-1: 12.0, 1: 11.3, 2: 8.8, 3: 6.9, 4: 5.4, 5: 4.2, 6: 3.3, 7: 2.6, 8: 2.0}
OUTPUT_RPM = 210.0


@dataclass(frozen=True)
class MadeShift:
    """Instants of a shift in ms after its start at `at_ms`, and what happens in it."""

    at_ms: int
    before: int
    after: int
    cut_ms: int = 120
    out_ms: int = 250
    fall_from_ms: int = 300
    fall_to_ms: int = 700
    in_ms: int = 760
    back_ms: int = 1000

    @property
    def end_ms(self) -> int:
        return self.at_ms + self.back_ms


DRIVE = (
    MadeShift(3_000, 3, 4),
    MadeShift(8_000, 4, 5, fall_to_ms=900, in_ms=960, back_ms=1300),
    MadeShift(14_000, 5, 4, fall_to_ms=500, in_ms=560, back_ms=800),
)


@dataclass(frozen=True)
class Truck:
    """What is on the bus: periods in ms, addresses, priority."""

    drive: Sequence[MadeShift] = DRIVE
    end_ms: int = 18_000
    source: int = 3
    channel: str = "can0"
    etc1_ms: int = 10
    etc2_ms: int = 100
    eec1_ms: int = 20
    priority: int = 3
    output_rpm: float = OUTPUT_RPM
    supply_kpa: float | None = 840.0

    def frames(self) -> list[LogFrame]:
        """All frames in order of time."""
        found: list[LogFrame] = []
        for time_ms in range(self.end_ms):
            if time_ms % self.etc1_ms == 0:
                found.append(self._frame(time_ms, 61442, self.source, self._etc1(time_ms)))
            if time_ms % self.etc2_ms == 7 % self.etc2_ms:
                found.append(self._frame(time_ms, 61445, self.source, self._etc2(time_ms)))
            if time_ms % self.eec1_ms == 3:
                found.append(self._frame(time_ms, 61444, 0, self._eec1(time_ms)))
            if time_ms % 1000 == 11 and self.supply_kpa is not None:
                data = bytes((round(self.supply_kpa / 8), *[255] * 7))
                found.append(self._frame(time_ms, 65198, 0x30, data))
        return found

    def _frame(self, time_ms: int, pgn: int, source: int, data: bytes) -> LogFrame:
        can_id = self.priority << 26 | pgn << 8 | source
        return LogFrame(START_NS + time_ms * MS, can_id, data, channel=self.channel)

    def _now(self, time_ms: int) -> tuple[MadeShift | None, int]:
        """The shift under way, and the gear without one."""
        gear = self.drive[0].before
        for shift in self.drive:
            if shift.at_ms <= time_ms < shift.end_ms:
                return shift, gear
            if time_ms >= shift.end_ms:
                gear = shift.after
        return None, gear

    def ratio(self, time_ms: int) -> float:
        """Input by output speed."""
        shift, gear = self._now(time_ms)
        if shift is None:
            return RATIOS.get(gear, 0.0)
        since = time_ms - shift.at_ms
        old, new = RATIOS.get(shift.before, 0.0), RATIOS.get(shift.after, 0.0)
        share = (since - shift.fall_from_ms) / (shift.fall_to_ms - shift.fall_from_ms)
        return old + (new - old) * min(max(share, 0.0), 1.0)

    def _etc1(self, time_ms: int) -> bytes:
        shift, _ = self._now(time_ms)
        output = round(self.output_rpm / 0.125)
        entry = round(self.output_rpm * self.ratio(time_ms) / 0.125)
        flags = 0b11_00_11_01 | (shift is not None) << 4
        words = (*output.to_bytes(2, "little"), 0xFF, 0xFF, *entry.to_bytes(2, "little"))
        return bytes((flags, *words, 0xFF))

    def _etc2(self, time_ms: int) -> bytes:
        shift, gear = self._now(time_ms)
        current = selected = gear
        if shift is not None:
            since = time_ms - shift.at_ms
            selected = shift.after
            current = shift.before if since < shift.out_ms else 0
            if since >= shift.in_ms:
                current = shift.after
        return bytes((selected + 125, 255, 255, current + 125, 255, 255, 255, 255))

    def torque(self, time_ms: int) -> float:
        """Engine torque in percent of the reference torque."""
        shift, _ = self._now(time_ms)
        if shift is None:
            return 60.0
        since = time_ms - shift.at_ms
        if since < shift.cut_ms:
            return 60.0 - 56.0 * since / shift.cut_ms
        if since < shift.in_ms:
            return 4.0
        return 4.0 + 56.0 * (since - shift.in_ms) / (shift.back_ms - shift.in_ms)

    def _eec1(self, time_ms: int) -> bytes:
        speed = round(self.output_rpm * self.ratio(time_ms) / 0.125).to_bytes(2, "little")
        return bytes((0xF0, 185, round(self.torque(time_ms)) + 125, *speed, 0, 0xFF, 0xFF))


def without(
    frames: Iterable[LogFrame], begin_ms: int, end_ms: int, pgn: int | None = None
) -> list[LogFrame]:
    """The frames without those of a time, of one parameter group or all."""
    return [
        frame
        for frame in frames
        if not (
            begin_ms * MS <= frame.time_ns - START_NS < end_ms * MS
            and pgn in (None, frame.can_id >> 8 & 0x3FFFF)
        )
    ]


def changed(
    frames: Iterable[LogFrame], pgn: int, change: Callable[[bytearray], None]
) -> list[LogFrame]:
    """The frames with the content of one parameter group changed in place."""
    found = []
    for frame in frames:
        if frame.can_id >> 8 & 0x3FFFF == pgn:
            data = bytearray(frame.data)
            change(data)
            frame = frame._replace(data=bytes(data))
        found.append(frame)
    return found


def write_log(path: Path, frames: Iterable[LogFrame]) -> Path:
    """Write a log in the format of the path's suffix."""
    return write(path, sorted(frames, key=lambda frame: frame.time_ns))


__all__ = ["DRIVE", "MadeShift", "Truck", "changed", "replace", "without", "write_log"]

"""The gears that one ETC2 sender reports, as runs of equal samples, and shifts out of them.

Layout: SAE J1939-71, PGN 61445.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final, NamedTuple

PGN_ETC2: Final = 61445
_GEAR_OFFSET: Final = 125
_FIRST_GEAR_BYTE: Final = 1
"""Byte 0 would be reverse gear 125: it is sent by units that have nothing to report yet."""

_PARK_BYTE: Final = 0xFB
SETTLE_NS: Final = 1_000_000_000
"""After a shift the reported gear may lag so long behind (ETC2 comes every 100 ms)."""

NEUTRAL_PASS_NS: Final = 2_000_000_000
"""Neutral for less than this between two gears is part of one shift."""

MOST_RUNS: Final = 1_000_000
SILENCE_NS: Final = 1_000_000_000
"""A sender that is not recorded for longer was silent, or the recorder was."""

_MOST_SILENT: Final = 10
"""If more than one sample in so many follows a silence, the log is sampled slowly, and none counts."""


@dataclass(slots=True)
class Silences:
    """The times in which a sender was not recorded: `add` each, and count its samples."""

    samples: int = 0
    _found: list[tuple[int, int]] = field(default_factory=list)

    def add(self, last_ns: int, time_ns: int) -> None:
        """Take the times of two samples in a row that are farther apart than `SILENCE_NS`."""
        self._found.append((last_ns, time_ns))

    def within(self, begin_ns: int, end_ns: int) -> int:
        """Return for how many ns in all the sender was silent at some time in between or until `begin_ns`."""
        if _MOST_SILENT * len(self._found) > self.samples:
            return 0
        return sum(b - a for a, b in self._found if a < end_ns and b >= begin_ns)


def gear_at(data: bytes, byte: int) -> int | None:
    """Return a gear, -124..125, 126 for park, None if not available (SPN 523, 524)."""
    value = data[byte]
    return value - _GEAR_OFFSET if _FIRST_GEAR_BYTE <= value <= _PARK_BYTE else None


@dataclass(slots=True)
class Run:
    """Samples in a row with the same gears: current (SPN 523) and selected (SPN 524)."""

    current: int | None
    selected: int | None
    first_ns: int
    last_ns: int
    samples: int = 1


class GearChange(NamedTuple):
    """A change of the reported current gear: last sample of the old, first of the new one."""

    start_ns: int
    end_ns: int
    from_gear: int | None
    to_gear: int | None


@dataclass(slots=True)
class GearHistory:
    """Runs of one sender; memory grows with the changes, not with the log."""

    chatter: int = 0
    runs: list[Run] = field(default_factory=list)
    silences: Silences = field(default_factory=Silences)
    _last_ns: int = 0

    def take(self, time_ns: int, data: bytes) -> bool:
        """Take one ETC2; return whether its gears differ from those before."""
        self.silences.samples += 1
        if self.silences.samples > 1 and time_ns - self._last_ns > SILENCE_NS:
            self.silences.add(self._last_ns, time_ns)
        self._last_ns = time_ns
        current, selected = gear_at(data, 3), gear_at(data, 0)
        last = self.runs[-1] if self.runs else None
        same = last is not None and (last.current, last.selected) == (current, selected)
        if last is not None and same and time_ns >= last.last_ns:
            last.last_ns = time_ns
            last.samples += 1
        elif len(self.runs) < MOST_RUNS:
            self.runs.append(Run(current, selected, time_ns, time_ns))
        return last is not None and not same

    def gear_before(self, time_ns: int) -> int | None:
        """Return the last valid current gear reported before a time."""
        found = None
        for run in self.runs:
            if run.first_ns > time_ns:
                break
            if run.current is not None:
                found = run.current
        return found

    def gear_after(self, time_ns: int, until_ns: int) -> int | None:
        """Return the current gear that a shift ended in.

        The first one reported after `time_ns` that is also the selected one; without such a
        one, the last one reported before `until_ns` or the settling time is over.
        """
        limit_ns = min(time_ns + SETTLE_NS, until_ns)
        found = None
        for run in self.runs:
            if run.last_ns < time_ns:
                continue
            if run.first_ns > limit_ns:
                break
            if run.current is None:
                continue
            found = run.current
            if run.selected is None or run.selected == run.current:
                break
        return found

    def changes(self) -> list[GearChange]:
        """Shifts by the current gear alone; neutral in passing is taken as part of a shift.

        A single sample of another gear between samples of the same gear is chatter. A gear that is
        another after a step of the clock backwards is no shift: its time is not known.
        """
        stays = self._stays()
        found: list[GearChange] = []
        index = 0
        while index + 1 < len(stays):
            here, there = stays[index], stays[index + 1]
            step = 1
            if there.current == 0 and index + 2 < len(stays):
                beyond = stays[index + 2]
                if beyond.first_ns - there.first_ns < NEUTRAL_PASS_NS:
                    there, step = beyond, 2
            if here.current != there.current and here.last_ns <= there.first_ns:
                found.append(GearChange(here.last_ns, there.first_ns, here.current, there.current))
            index += step
        return found

    def _stays(self) -> list[Run]:
        """Return the runs by the current gear alone, without invalid ones and without chatter."""
        self.chatter = 0
        joined: list[Run] = []
        for run in self.runs:
            if run.current is None:
                continue
            if joined and joined[-1].current == run.current and run.first_ns >= joined[-1].last_ns:
                joined[-1].last_ns = run.last_ns
                joined[-1].samples += run.samples
                continue
            joined.append(Run(run.current, None, run.first_ns, run.last_ns, run.samples))
            if len(joined) < 3:
                continue
            before, odd, after = joined[-3:]
            if odd.samples == 1 and odd.current != 0 and before.current == after.current:
                self.chatter += 1
                del joined[-2:]
                before.last_ns = after.last_ns
                before.samples += after.samples
        return joined

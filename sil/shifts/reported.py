"""What one sender reports of its shifts: the flag of ETC1, and the gears of ETC2.

Values out of range are None and nothing is refused: the codec of `can_dbc` is strict and has the
project's own source address only. Layouts: SAE J1939-71, PGN 61442 and 61445.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field, replace
from itertools import takewhile
from statistics import median
from typing import Final

PGN_ETC1: Final = 61442
PGN_ETC2: Final = 61445
SETTLE_NS: Final = 1_000_000_000
"""After a shift the reported gear may lag so long behind (ETC2 comes every 100 ms)."""

MIN_SILENCE_NS: Final = 1_500_000_000
"""A sender that is not recorded for longer was silent, or the recorder was: a shift has no known time in it."""

RATIO_WINDOW_NS: Final = 500_000_000
"""Shaft speeds are compared over this time before and after a shift."""

RATIO_SETTLE_NS: Final = 100_000_000


def shift_in_process(data: bytes) -> bool | None:
    """Return SPN 574 of an ETC1, None for error and not available."""
    return (False, True, None, None)[data[0] >> 4 & 3]


def word_at(data: bytes, byte: int) -> int | None:
    """Return a two-byte number, None above the valid range."""
    value = data[byte] | data[byte + 1] << 8
    return value if value <= 0xFAFF else None


def gear_at(data: bytes, byte: int) -> int | None:
    """Return a gear, -124..125, 126 for park, None if not available (SPN 523, 524).

    0, reverse gear 125, is sent by units that have nothing to report yet.
    """
    value = data[byte]
    return value - 125 if 1 <= value <= 0xFB else None


@dataclass(slots=True)
class FlaggedShift:
    """A time in which the flag was up, and the speed ratios (input by output) around it."""

    start_ns: int
    end_ns: int
    from_ratio: float | None
    to_ratio: float | None = None


@dataclass(slots=True)
class FlagTracker:
    """Follows the flag of one sender.

    A change counts from its first sample, once a second sample or 50 ms confirms it. After a silence, and after
    a step of the clock backwards, it begins anew.
    flagged: whether there was a valid flag; chatter: samples taken out as chatter;
    unfinished: shifts of which the log has no beginning or no end.
    """

    flagged: bool = False
    chatter: int = 0
    unfinished: int = 0
    clock_steps: int = 0
    shifts: list[FlaggedShift] = field(default_factory=list)
    _state: bool | None = None
    _begun_ns: int | None = None
    _doubt_ns: int | None = None
    _from_ratio: float | None = None
    _last_ns: int = -(2**63)
    _samples: deque[tuple[int, bytes]] = field(default_factory=lambda: deque(maxlen=1024))
    _settled_ns: int = 2**63
    _settling: FlaggedShift | None = None

    def take(self, time_ns: int, data: bytes) -> None:
        """Take one ETC1; one that is there twice at an instant counts once."""
        last_ns = self._last_ns
        if self._samples and not last_ns < time_ns <= last_ns + MIN_SILENCE_NS:
            if time_ns != last_ns:
                self.clock_steps += time_ns < last_ns
                self._restart()
            elif data == self._samples[-1][1]:
                return
        self._last_ns = time_ns
        self._samples.append((time_ns, data))
        if time_ns > self._settled_ns:
            self._settle()
        flag = shift_in_process(data)
        if flag is not None and (flag is not self._state or self._doubt_ns is not None):
            self.flagged = True
            self._flag(time_ns, flag)

    def _restart(self) -> None:
        """Begin anew: what is under way has no end that is known."""
        self._settle()
        if self._state:
            self.unfinished += 1
        self._state = self._begun_ns = self._doubt_ns = None
        self._samples.clear()

    def _flag(self, time_ns: int, flag: bool) -> None:
        doubt_ns = self._doubt_ns
        if self._state is None:
            self._state = flag
        elif flag is not self._state:
            if doubt_ns is None:
                self._doubt_ns = time_ns
            else:
                self._change(doubt_ns)
        elif doubt_ns is not None:  # one sample differed, then the old state came again
            self._doubt_ns = None
            if time_ns - doubt_ns < 50_000_000:
                self.chatter += 1
            else:
                self._change(doubt_ns)
                self._change(time_ns)

    def _change(self, time_ns: int) -> None:
        """Record a change of the flag at this time."""
        self._doubt_ns = None
        if not self._state:
            self._settle()
            self._state, self._begun_ns = True, time_ns
            self._from_ratio = self._ratio(time_ns - RATIO_WINDOW_NS, time_ns)
            return
        self._state = False
        if self._begun_ns is None:
            self.unfinished += 1
            return
        shift = FlaggedShift(self._begun_ns, time_ns, self._from_ratio)
        self.shifts.append(shift)
        self._settling = shift
        self._settled_ns = time_ns + RATIO_SETTLE_NS + RATIO_WINDOW_NS
        self._begun_ns = None

    def _settle(self) -> None:
        """Take the ratio after the last shift, from the samples that there are by now."""
        shift, self._settling, self._settled_ns = self._settling, None, 2**63
        if shift is not None:
            begin_ns = shift.end_ns + RATIO_SETTLE_NS
            shift.to_ratio = self._ratio(begin_ns, begin_ns + RATIO_WINDOW_NS)

    def _ratio(self, begin_ns: int, end_ns: int) -> float | None:
        """Return the median ratio of the shafts, of samples with an output above 20 rpm."""
        speeds = (
            (word_at(data, 1), word_at(data, 5))
            for time_ns, data in self._samples
            if begin_ns <= time_ns < end_ns
        )
        ratios = [b / a for a, b in speeds if a is not None and b is not None and a >= 160]
        return median(ratios) if ratios else None

    def finish(self) -> None:
        """Close what is open at the end of the log."""
        if self._doubt_ns is not None and self._state:
            self._change(self._doubt_ns)
        self._settle()
        if self._state:
            self.unfinished += 1
            self._state = None


@dataclass(slots=True)
class GearRun:
    """Samples in a row with the same gears: current (SPN 523) and selected (SPN 524)."""

    current: int | None
    selected: int | None
    first_ns: int
    last_ns: int
    samples: int = 1

    def extend(self, last_ns: int, samples: int = 1) -> None:
        """Add samples up to a time."""
        self.last_ns = last_ns
        self.samples += samples


@dataclass(slots=True)
class GearHistory:
    """The gears that one sender reports, as runs; memory grows with the changes, not with the log."""

    chatter: int = 0
    runs: list[GearRun] = field(default_factory=list)

    def take(self, time_ns: int, data: bytes) -> None:
        """Take one ETC2."""
        current, selected = gear_at(data, 3), gear_at(data, 0)
        last = self.runs[-1] if self.runs else None
        same = last is not None and (last.current, last.selected) == (current, selected)
        if last is not None and same and time_ns >= last.last_ns:
            last.extend(time_ns)
        elif len(self.runs) < 1_000_000:
            self.runs.append(GearRun(current, selected, time_ns, time_ns))

    def gear_before(self, time_ns: int) -> int | None:
        """Return the last valid current gear reported before a time."""
        earlier = takewhile(lambda run: run.first_ns <= time_ns, self.runs)
        gears = [run.current for run in earlier if run.current is not None]
        return gears[-1] if gears else None

    def gear_after(self, time_ns: int, until_ns: int) -> int | None:
        """Return the current gear that a shift ended in.

        The first one reported after `time_ns` that is also the selected one; without such a
        one, the last one reported before `until_ns` or the settling time is over.
        """
        limit_ns = min(time_ns + SETTLE_NS, until_ns)
        gear = None
        later = (run for run in self.runs if run.last_ns >= time_ns)
        for run in takewhile(lambda run: run.first_ns <= limit_ns, later):
            if run.current is not None:
                gear = run.current
                if run.selected in (None, gear):
                    break
        return gear

    def changes(self) -> list[tuple[int, int, int | None, int | None]]:
        """Return shifts by the current gear alone: last sample of the old, first of the new one, both gears.

        Neutral for less than 2 s is part of a shift. A single sample of another gear between samples of the
        same gear is chatter. A gear that is another after a silence, or a step of the clock backwards, is no shift: its
        time is not known.
        """
        stays = self._stays()
        changes = []
        index = 0
        while index + 1 < len(stays):
            here, there = stays[index], stays[index + 1]
            step, longest_ns = 1, MIN_SILENCE_NS
            if there.current == 0 and index + 2 < len(stays):
                beyond = stays[index + 2]
                if beyond.first_ns - there.first_ns < 2_000_000_000:
                    there, step, longest_ns = beyond, 2, MIN_SILENCE_NS + 2_000_000_000
            lasts_ns = there.first_ns - here.last_ns
            if here.current != there.current and 0 <= lasts_ns <= longest_ns:
                changes.append((here.last_ns, there.first_ns, here.current, there.current))
            index += step
        return changes

    def _stays(self) -> list[GearRun]:
        """Return the runs by the current gear alone, without invalid ones and without chatter."""
        self.chatter = 0
        stays: list[GearRun] = []
        for run in self.runs:
            if run.current is None:
                continue
            if stays and stays[-1].current == run.current and run.first_ns >= stays[-1].last_ns:
                stays[-1].extend(run.last_ns, run.samples)
                continue
            stays.append(replace(run, selected=None))
            if len(stays) < 3:
                continue
            before, odd, after = stays[-3:]
            if odd.samples == 1 and odd.current != 0 and before.current == after.current:
                self.chatter += 1
                del stays[-2:]
                before.extend(after.last_ns, after.samples)
        return stays

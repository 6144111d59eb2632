"""Shifts out of the shift-in-process flag of one ETC1 sender, one-sample chatter taken out.

Values out of range are None and nothing is refused: the codec of `can_dbc` is strict and knows the
project's own source address only. Layout: SAE J1939-71, PGN 61442.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from statistics import median
from typing import Final

from sil.j1939.gear_history import SILENCE_NS, Silences

PGN_ETC1: Final = 61442
_LAST_VALID_WORD: Final = 0xFAFF
CHATTER_NS: Final = 50_000_000
"""A single sample that differs from those around it for less than this is chatter."""

RATIO_WINDOW_NS: Final = 500_000_000
"""Shaft speeds are compared over this time before and after a shift."""

RATIO_SETTLE_NS: Final = 100_000_000
_LEAST_OUTPUT: Final = 160
"""Output shaft speed (0.125 rpm) below which the ratio of two speeds is not used: 20 rpm."""

_MOST_SAMPLES: Final = 1024
_FLAGS: Final = (False, True, None, None)
"""By the two bits of a state: off, on, error, not available."""


def shift_in_process(data: bytes) -> bool | None:
    """Return SPN 574 of an ETC1, None for error and not available."""
    return _FLAGS[data[0] >> 4 & 3]


def word_at(data: bytes, byte: int) -> int | None:
    """Return a two-byte number, None above the valid range."""
    value = data[byte] | data[byte + 1] << 8
    return value if value <= _LAST_VALID_WORD else None


@dataclass(slots=True)
class FlaggedShift:
    """A time in which the flag was up, and the speed ratios (input by output) around it.

    silent_ns: how long the sender was not recorded meanwhile.
    """

    start_ns: int
    end_ns: int
    chatter: int
    from_ratio: float | None
    to_ratio: float | None = None
    silent_ns: int = 0


@dataclass(slots=True)
class FlagTracker:
    """Follows the flag of one sender.

    A change counts from its first sample, once a second sample or `CHATTER_NS` confirms it.
    flagged: whether there was a valid flag; chatter: samples taken out as chatter;
    unfinished: shifts of which the log has no beginning or no end.
    """

    flagged: bool = False
    chatter: int = 0
    unfinished: int = 0
    clock_steps: int = 0
    shifts: list[FlaggedShift] = field(default_factory=list)
    silences: Silences = field(default_factory=Silences)
    _state: bool | None = None
    _begun_ns: int | None = None
    _doubt_ns: int | None = None
    _shift_chatter: int = 0
    _from_ratio: float | None = None
    _last_ns: int = -(2**63)
    _samples: deque[tuple[int, bytes]] = field(default_factory=lambda: deque(maxlen=_MOST_SAMPLES))
    _settled_ns: int = 2**63
    _settling: FlaggedShift | None = None

    def take(self, time_ns: int, data: bytes) -> bool | None:
        """Take one ETC1 and return its flag; one that is there twice at an instant counts once."""
        last_ns = self._last_ns
        if not last_ns < time_ns <= last_ns + SILENCE_NS and self._samples:
            if time_ns > last_ns:
                self.silences.add(last_ns, time_ns)
            elif time_ns < last_ns:
                self._restart()
            elif data == self._samples[-1][1]:
                return None
        self._last_ns = time_ns
        self.silences.samples += 1
        self._samples.append((time_ns, data))
        if time_ns > self._settled_ns:
            self._settle()
        flag = shift_in_process(data)
        if flag is not None and (flag is not self._state or self._doubt_ns is not None):
            self.flagged = True
            self._flag(time_ns, flag)
        return flag

    def _restart(self) -> None:
        """Begin anew after a step of the clock backwards."""
        self.clock_steps += 1
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
            if time_ns - doubt_ns < CHATTER_NS:
                self.chatter += 1
                self._shift_chatter += 1
            else:
                self._change(doubt_ns)
                self._change(time_ns)

    def _change(self, time_ns: int) -> None:
        """Record a change of the flag at this time."""
        self._doubt_ns = None
        if not self._state:
            self._settle()
            self._state, self._begun_ns = True, time_ns
            self._shift_chatter = 0
            self._from_ratio = self._median(time_ns - RATIO_WINDOW_NS, time_ns)
            return
        self._state = False
        if self._begun_ns is None:
            self.unfinished += 1
            return
        shift = FlaggedShift(self._begun_ns, time_ns, self._shift_chatter, self._from_ratio)
        self.shifts.append(shift)
        self._settling = shift
        self._settled_ns = time_ns + RATIO_SETTLE_NS + RATIO_WINDOW_NS
        self._begun_ns = None

    def _settle(self) -> None:
        """Take the ratio after the last shift, from the samples that there are by now."""
        shift, self._settling, self._settled_ns = self._settling, None, 2**63
        if shift is not None:
            begin_ns = shift.end_ns + RATIO_SETTLE_NS
            shift.to_ratio = self._median(begin_ns, begin_ns + RATIO_WINDOW_NS)

    def _median(self, begin_ns: int, end_ns: int) -> float | None:
        found = []
        for data in (data for time_ns, data in self._samples if begin_ns <= time_ns < end_ns):
            output, shaft_in = word_at(data, 1), word_at(data, 5)
            if output is not None and shaft_in is not None and output >= _LEAST_OUTPUT:
                found.append(shaft_in / output)
        return median(found) if found else None

    def finish(self) -> None:
        """Close what is open at the end of the log."""
        if self._doubt_ns is not None and self._state:
            self._change(self._doubt_ns)
        self._settle()
        if self._state:
            self.unfinished += 1
            self._state = None
        for shift in self.shifts:
            shift.silent_ns = self.silences.within(shift.start_ns, shift.end_ns)

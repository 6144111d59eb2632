"""The one record type that every log format is read into and written from."""

from __future__ import annotations

import re
from bisect import bisect_left
from collections.abc import Sequence, Set
from itertools import compress
from operator import not_
from typing import Final, NamedTuple

from can_dbc.frame import MAX_ID

DLC_LENGTHS: Final = (0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64)
"""Bytes of data by CAN FD data length code (ISO 11898-1)."""

MAX_STANDARD_ID: Final = 0x7FF
MAX_TIME_NS: Final = 2**63 - 1

_CHANNEL = re.compile(r"[!-~]{0,64}\Z")
_DIRECTIONS: Final = frozenset(("", "Rx", "Tx"))


class LogFrame(NamedTuple):
    """One CAN frame as a log recorded it.

    time_ns: absolute (since 1970, UTC) or relative, as the log has it.
    data: empty for a remote frame.
    raw_dlc: the length code if it does not follow from `data`: 0..15 of a remote frame, 9..15 of a
    classic frame of eight bytes; else 0.
    error: an error frame; `can_id` is then the recorder's error class, `data` its details, if any.
    channel: the recorder's name or number of the bus, "" where it has none.
    direction: "Rx", "Tx" or "" where it is not recorded.
    """

    time_ns: int
    can_id: int
    data: bytes = b""
    extended: bool = True
    remote: bool = False
    error: bool = False
    fd: bool = False
    brs: bool = False
    esi: bool = False
    channel: str = ""
    direction: str = ""
    raw_dlc: int = 0

    @property
    def dlc(self) -> int:
        """Data length code 0..15 as on the wire."""
        return (
            self.raw_dlc
            if self.remote
            else self.raw_dlc or bisect_left(DLC_LENGTHS, len(self.data))
        )


def ordinary_frame(
    time_ns: int, can_id: int, data: bytes, extended: bool, channel: str, direction: str
) -> LogFrame:
    """Return a classic data frame, faster than by `LogFrame(...)`."""
    fields = time_ns, can_id, data, extended, False, False, False, False, False
    return tuple.__new__(LogFrame, (*fields, channel, direction, 0))


def all_ordinary(frames: Sequence[LogFrame], channels: Set[str]) -> bool:
    """Return whether all are surely possible classic data frames of known channels; a quick look."""
    times_ns, ids, data, extended, remote, error, fd, *_, names, ways, raw = zip(
        *frames, strict=True
    )
    if any(remote) or any(error) or any(fd) or any(raw):
        return False
    if min(ids) < 0 or max(ids) > MAX_ID or max(map(len, data)) > 8:
        return False
    if not all(extended) and max(compress(ids, map(not_, extended))) > MAX_STANDARD_ID:
        return False
    return (
        min(times_ns) >= 0
        and max(times_ns) <= MAX_TIME_NS
        and channels >= set(names)
        and set(ways) <= _DIRECTIONS
    )


def frame_problem(frame: LogFrame) -> str | None:
    """Return what makes a frame impossible on any CAN bus, or None when nothing does."""
    length = len(frame.data)
    problem: str | None = None
    if not 0 <= frame.can_id <= MAX_ID:
        problem = f"identifier {frame.can_id:#x} has more than 29 bits"
    elif not (frame.extended or frame.error) and frame.can_id > MAX_STANDARD_ID:
        problem = f"standard identifier {frame.can_id:#x} has more than 11 bits"
    elif abs(frame.time_ns) > MAX_TIME_NS:
        problem = f"time {frame.time_ns} ns is out of range"
    elif frame.remote and length:
        problem = "a remote frame carries no data"
    elif length > (64 if frame.fd else 8):
        problem = f"{length} bytes of data in a {'CAN FD' if frame.fd else 'classic'} frame"
    elif length not in DLC_LENGTHS:
        problem = f"no CAN FD frame has {length} bytes"
    elif not 0 <= frame.raw_dlc <= 15:
        problem = f"data length code {frame.raw_dlc}"
    elif frame.direction not in _DIRECTIONS:
        problem = f"direction {frame.direction!r}"
    elif not _CHANNEL.match(frame.channel):
        problem = f"channel name {frame.channel[:70]!r} is not 0 to 64 visible ASCII characters"
    elif frame.raw_dlc and not frame.remote and (frame.fd or length != 8 or frame.raw_dlc < 9):
        problem = f"raw length code {frame.raw_dlc} with {length} bytes"
    return problem

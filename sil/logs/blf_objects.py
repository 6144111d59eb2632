"""The objects inside a BLF log: headers, and how each kind becomes a frame.

There is no public specification; the layouts are those that the open readers of the format agree
on (Technica and Lorenz's Vector BLF, python-can).
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import Final, NamedTuple

from sil.logs.frame import (
    MAX_EXTENDED_ID,
    MAX_STANDARD_ID,
    MAX_TIME_NS,
    LogFrame,
    frame_problem,
    ordinary_frame,
)
from sil.logs.times import NS_PER_MS, utc_calendar, utc_ns

FILE_HEADER: Final = struct.Struct("<4sLBBBBBBBBQQLL8H8H")
FILE_HEADER_SIZE: Final = 144
OBJECT: Final = struct.Struct("<4sHHLL")
"""Signature, header size, header version, object size, object type."""

TIMES_V1: Final = struct.Struct("<LHHQ")
TIMES_V2: Final = struct.Struct("<LBxHQ8x")
CONTAINER: Final = struct.Struct("<H6xL4x")
"""Compression method, unpacked size."""

CAN: Final = struct.Struct("<HBBL8s")
CAN_ERROR_OLD: Final = struct.Struct("<HH")
CAN_ERROR_EXT: Final = struct.Struct("<HHLBBBxLLH2x8s")
CAN_FD: Final = struct.Struct("<HBBLLBBB5x64s")
CAN_FD_64: Final = struct.Struct("<BBBBLLLLLLLHBBL")
CAN_FD_ERROR_64: Final = struct.Struct("<BBBBHHBxHLLLLLHHL")

TYPE_CAN: Final = 1
TYPE_CAN_ERROR: Final = 2
TYPE_CONTAINER: Final = 10
TYPE_CAN_ERROR_EXT: Final = 73
TYPE_CAN_2: Final = 86
TYPE_CAN_FD: Final = 100
TYPE_CAN_FD_64: Final = 101
TYPE_CAN_FD_ERROR_64: Final = 104

PLAIN: Final = struct.Struct("<4sHHLLL4xQHBBL8s")
"""A classic frame as a whole: header, time flag, ticks, and `CAN`."""

_PLAIN_HEADERS: Final = frozenset(
    (b"LOBJ", OBJECT.size + TIMES_V1.size, 1, PLAIN.size, kind) for kind in (TYPE_CAN, TYPE_CAN_2)
)
EXTENDED: Final = 0x80000000
REMOTE: Final = 0x80
TICK_NS: Final = {1: 10_000, 2: 1}
"""Nanoseconds of one tick, by an object's time flag."""

OTHER_TYPES: Final = {
    3: "overload frame",
    4: "bus statistics",
    5: "trigger",
    31: "status line",
    65: "text",
    71: "Ethernet frame",
    92: "global marker",
    96: "global marker",
    115: "unused bytes",
    120: "Ethernet frame",
}
_LIN_TYPES: Final = frozenset((*range(11, 21), *range(54, 64), 75))
_LARGEST: Final = 1 << 22
_LARGEST_FRAME: Final = 1 << 12
_FRAME_TYPES: Final = {
    TYPE_CAN: CAN,
    TYPE_CAN_2: CAN,
    TYPE_CAN_ERROR: CAN_ERROR_OLD,
    TYPE_CAN_ERROR_EXT: CAN_ERROR_EXT,
    TYPE_CAN_FD: CAN_FD,
    TYPE_CAN_FD_64: CAN_FD_64,
    TYPE_CAN_FD_ERROR_64: CAN_FD_ERROR_64,
}
SystemTime = tuple[int, int, int, int, int, int, int, int]


class Broken(NamedTuple):
    """Bytes that are no object: why, and how many were passed over."""

    reason: str
    passed: int


class Other(NamedTuple):
    """An object that is no CAN frame."""

    name: str


class Unfinished(NamedTuple):
    """The data ends inside an object that begins here."""

    start: int


def read_systemtime(fields: SystemTime) -> int:
    """Nanoseconds since 1970 of a Windows SYSTEMTIME (taken as UTC); 0 for none."""
    year, month, _weekday, day, hour, minute, second, milliseconds = fields
    try:
        return utc_ns(year, month, day, hour, minute, second, milliseconds * NS_PER_MS)
    except (ValueError, OverflowError):
        return 0


def write_systemtime(time_ns: int) -> SystemTime:
    """The SYSTEMTIME of a time, all zero for 0; whole milliseconds."""
    if time_ns == 0:
        return (0,) * 8
    moment = utc_calendar(time_ns)
    return (
        moment.year,
        moment.month,
        moment.isoweekday() % 7,
        moment.day,
        moment.hour,
        moment.minute,
        moment.second,
        time_ns // NS_PER_MS % 1000,
    )


def plausible_header(data: bytes | memoryview, pos: int) -> str | None:
    """What is wrong with the object header at `pos`, or None."""
    signature, header_size, version, size, kind = OBJECT.unpack_from(data, pos)
    if signature != b"LOBJ":
        return "no object begins here"
    least = OBJECT.size if kind == TYPE_CONTAINER else OBJECT.size + TIMES_V1.size
    if version not in (1, 2) or header_size < least or size < header_size:
        return f"object header of version {version} with sizes {header_size} and {size}"
    layout = _FRAME_TYPES.get(kind)
    if layout is not None and not header_size + layout.size <= size <= _LARGEST_FRAME:
        return f"object of type {kind} with {size} bytes"
    if size > _LARGEST and kind != TYPE_CONTAINER:
        return f"object of {size} bytes"
    return None


def objects(data: bytes, start_ns: int) -> Iterator[LogFrame | Other | Broken | Unfinished]:
    """What is in unpacked data, in order; at most one `Unfinished`, as the last.

    Checked by: tests/unit/sil/logs/test_blf.py.
    """
    pos, end = 0, len(data)
    while True:
        for frame in _run_of_plain(data, pos, start_ns):
            yield frame
            pos += PLAIN.size
        found = data.find(b"LOBJ", pos, pos + 8)
        if found < 0:
            if end - pos < 8:
                if data[pos:].strip(b"\x00"):
                    yield Unfinished(pos)
                return
            found = _next_object(data, pos)
            if found < 0:
                yield Broken("no object begins here", end - pos)
                return
            yield Broken("no object begins here", found - pos)
        pos = found
        if end - pos < OBJECT.size:
            yield Unfinished(pos)
            return
        problem = plausible_header(data, pos)
        if problem is not None:
            found = _next_object(data, pos + 4)
            yield Broken(problem, (end if found < 0 else found) - pos)
            if found < 0:
                return
            pos = found
            continue
        _, header_size, version, size, kind = OBJECT.unpack_from(data, pos)
        if pos + size > end:
            yield Unfinished(pos)
            return
        if kind not in _FRAME_TYPES:
            yield _other(kind)
        else:
            times = TIMES_V1 if version == 1 else TIMES_V2
            flags, _, _, ticks = times.unpack_from(data, pos + OBJECT.size)
            tick_ns = TICK_NS.get(flags & 3)
            if tick_ns is None:
                yield Broken(f"time flag {flags}", size)
            else:
                body = data[pos + header_size : pos + size]
                yield _frame(kind, body, start_ns + ticks * tick_ns, header_size)
        pos += size


def _run_of_plain(data: bytes, pos: int, start_ns: int) -> Iterator[LogFrame]:
    """Classic data frames, one after the other, as long as there is nothing else."""
    end = pos + (len(data) - pos) // PLAIN.size * PLAIN.size
    for fields in PLAIN.iter_unpack(memoryview(data)[pos:end]):
        if fields[:5] not in _PLAIN_HEADERS or fields[5] != 2:
            return
        ticks, channel, flags, dlc, word, payload = fields[6:]
        extended = word > MAX_EXTENDED_ID
        if flags > 1 or dlc > 8 or (not extended and word > MAX_STANDARD_ID):
            return
        if extended and word >> 29 != 4:
            return
        time_ns = start_ns + ticks
        if time_ns > MAX_TIME_NS:
            return
        yield ordinary_frame(
            time_ns,
            word & MAX_EXTENDED_ID,
            payload[:dlc],
            extended,
            str(channel),
            "Tx" if flags else "Rx",
        )


def _next_object(data: bytes, pos: int) -> int:
    """Where the next believable object header begins, or -1."""
    while True:
        pos = data.find(b"LOBJ", pos)
        if pos < 0 or len(data) - pos < OBJECT.size:
            return pos
        if plausible_header(data, pos) is None:
            return pos
        pos += 4


def _other(kind: int) -> Other:
    if kind in _LIN_TYPES:
        return Other("LIN event")
    return Other(OTHER_TYPES.get(kind, f"BLF object of type {kind}"))


def _frame(kind: int, body: bytes, time_ns: int, header_size: int) -> LogFrame | Broken:
    """One frame object."""
    if kind in (TYPE_CAN, TYPE_CAN_2):
        frame = _classic(body, time_ns)
    elif kind == TYPE_CAN_FD:
        frame = _fd(body, time_ns)
    elif kind == TYPE_CAN_FD_64:
        frame = _fd_64(body, time_ns, header_size)
    elif kind == TYPE_CAN_ERROR_EXT:
        fields = CAN_ERROR_EXT.unpack_from(body)
        frame = LogFrame(
            time_ns,
            fields[7] & 0x1FFFFFFF,
            fields[9][: min(fields[5], 8)],
            _extended(fields[7]),
            error=True,
            channel=str(fields[0]),
        )
    elif kind == TYPE_CAN_ERROR:
        channel = CAN_ERROR_OLD.unpack_from(body)[0]
        frame = LogFrame(time_ns, 0, b"", False, error=True, channel=str(channel))
    else:
        channel = CAN_FD_ERROR_64.unpack_from(body)[0]
        frame = LogFrame(time_ns, 0, b"", False, error=True, fd=True, channel=str(channel))
    problem = frame_problem(frame)
    return frame if problem is None else Broken(problem, len(body))


def _way(code: int) -> str:
    """Rx or Tx; "" for other codes (2 is a request to send, 3 and more are converters' noise)."""
    return ("Rx", "Tx")[code] if code < 2 else ""


def _extended(word: int) -> bool:
    """The flag, or an identifier that fits no standard frame (some writers leave the flag out)."""
    return bool(word & EXTENDED) or word & 0x1FFFFFFF > MAX_STANDARD_ID


def _raw_dlc(dlc: int, remote: bool, fd: bool) -> int:
    """What `LogFrame.raw_dlc` keeps; the field has four bits on the bus."""
    if remote:
        return dlc & 0x0F
    return dlc if not fd and 8 < dlc < 16 else 0


def _classic(body: bytes, time_ns: int) -> LogFrame:
    channel, flags, dlc, word, data = CAN.unpack_from(body)
    direction = _way(flags & 0x0F)
    remote = bool(flags & REMOTE)
    return LogFrame(
        time_ns,
        word & 0x1FFFFFFF,
        b"" if remote else data[:dlc],
        _extended(word),
        remote,
        False,
        False,
        False,
        False,
        str(channel),
        direction,
        _raw_dlc(dlc, remote, False),
    )


def _fd(body: bytes, time_ns: int) -> LogFrame:
    channel, flags, dlc, word, _, _, fd_flags, length, data = CAN_FD.unpack_from(body)
    direction = _way(flags & 0x0F)
    fd, remote = bool(fd_flags & 1), bool(flags & REMOTE)
    return LogFrame(
        time_ns,
        word & 0x1FFFFFFF,
        b"" if remote else data[:length],
        _extended(word),
        remote,
        False,
        fd,
        fd and bool(fd_flags & 2),
        fd and bool(fd_flags & 4),
        str(channel),
        direction,
        _raw_dlc(dlc, remote, fd),
    )


def _fd_64(body: bytes, time_ns: int, header_size: int) -> LogFrame:
    fields = CAN_FD_64.unpack_from(body)
    channel, dlc, length, _, word, _, flags = fields[:7]
    direction = _way(fields[12])
    fd, remote = bool(flags & 0x1000), bool(flags & 0x10)
    extra = fields[13]
    stored = (extra - header_size if extra > header_size else len(body)) - CAN_FD_64.size
    # Vector's own writer leaves out trailing zero bytes that `length` still counts.
    data = body[CAN_FD_64.size :][: max(min(stored, length), 0)].ljust(length, b"\x00")
    return LogFrame(
        time_ns,
        word & 0x1FFFFFFF,
        b"" if remote else data,
        _extended(word),
        remote,
        False,
        fd,
        fd and bool(flags & 0x2000),
        fd and bool(flags & 0x4000),
        str(channel),
        direction,
        _raw_dlc(dlc, remote, fd),
    )

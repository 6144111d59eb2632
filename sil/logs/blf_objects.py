"""The objects of a BLF log: their layout, and the frames in them.

There is no public specification; the layouts are those that the open readers of the format agree
on (Technica and Lorenz's Vector BLF, python-can).
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from enum import IntEnum
from typing import Final

from can_dbc.frame import MAX_ID
from sil.logs.frame import (
    MAX_STANDARD_ID,
    MAX_TIME_NS,
    LogFrame,
    frame_problem,
    ordinary_frame,
)
from sil.logs.times import NS_PER_MS, utc_calendar, utc_ns

LARGEST_CONTAINER: Final = 1 << 26
FILE_HEADER: Final = struct.Struct("<4sLBBBBBBBBQQLL8H8H")
FILE_HEADER_SIZE: Final = 144
OBJECT: Final = struct.Struct("<4sHHLL")
"""Signature, header size, header version, object size, object type."""

TIMES_V1: Final = struct.Struct("<LHHQ")
TIMES_V2: Final = struct.Struct("<LBxHQ8x")
CONTAINER: Final = struct.Struct("<H6xL4x")  # compression method, unpacked size


class ObjectType(IntEnum):
    """Types of objects that are read."""

    CAN = 1
    CAN_ERROR = 2
    CONTAINER = 10
    CAN_ERROR_EXT = 73
    CAN_2 = 86
    CAN_FD = 100
    CAN_FD_64 = 101
    CAN_FD_ERROR_64 = 104


PLAIN: Final = struct.Struct("<4sHHLLL4xQHBBL8s")
"""A classic frame as a whole: header, time flag, ticks, and its fields."""

_PLAIN_HEADERS: Final = frozenset(
    (b"LOBJ", OBJECT.size + TIMES_V1.size, 1, PLAIN.size, kind)
    for kind in (ObjectType.CAN, ObjectType.CAN_2)
)
EXTENDED: Final = 0x80000000
REMOTE: Final = 0x80

OTHER_TYPES: Final = {
    **dict.fromkeys((*range(11, 21), *range(54, 64), 75), "LIN event"),
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
FRAME_LAYOUTS: Final[dict[int, struct.Struct]] = {
    kind: struct.Struct(layout)
    for kind, layout in (
        (ObjectType.CAN, "<HBBL8s"),
        (ObjectType.CAN_2, "<HBBL8s"),
        (ObjectType.CAN_ERROR, "<HH"),
        (ObjectType.CAN_ERROR_EXT, "<HHLBBBxLLH2x8s"),
        (ObjectType.CAN_FD, "<HBBLLBBB5x64s"),
        (ObjectType.CAN_FD_64, "<BBBBLLLLLLLHBBL"),
        (ObjectType.CAN_FD_ERROR_64, "<BBBBHHBxHLLLLLHHL"),
    )
}


def read_systemtime(fields: Sequence[int]) -> int:
    """Nanoseconds since 1970 of a Windows SYSTEMTIME (taken as UTC); 0 for none."""
    year, month, _weekday, day, hour, minute, second, milliseconds = fields
    try:
        return utc_ns(year, month, day, hour, minute, second, milliseconds * NS_PER_MS)
    except (ValueError, OverflowError):
        return 0


def write_systemtime(time_ns: int) -> tuple[int, ...]:
    """Return the SYSTEMTIME of a time, all zero for 0; whole milliseconds."""
    if time_ns == 0:
        return (0,) * 8
    year, month, day, *clock = utc_calendar(time_ns).timetuple()[:6]
    weekday = utc_calendar(time_ns).isoweekday() % 7
    return (year, month, weekday, day, *clock, time_ns // NS_PER_MS % 1000)


def plausible_header(data: bytes | memoryview, pos: int) -> str | None:
    """Return what is wrong with the object header at `pos`, or None."""
    signature, header_size, version, size, kind = OBJECT.unpack_from(data, pos)
    if signature != b"LOBJ":
        return "no object begins here"
    if kind == ObjectType.CONTAINER and not 32 <= size <= LARGEST_CONTAINER:
        return f"container of {size} bytes"
    least = OBJECT.size if kind == ObjectType.CONTAINER else OBJECT.size + TIMES_V1.size
    if version not in (1, 2) or header_size < least or size < header_size:
        return f"object header of version {version} with sizes {header_size} and {size}"
    layout = FRAME_LAYOUTS.get(kind)
    if layout is not None and not header_size + layout.size <= size <= 1 << 12:
        return f"object of type {kind} with {size} bytes"
    if size > 1 << 22 and kind != ObjectType.CONTAINER:
        return f"object of {size} bytes"
    return None


def run_of_plain(data: bytes, pos: int, start_ns: int) -> Iterator[LogFrame]:
    """Yield classic data frames, one after the other, as long as there is nothing else."""
    end = pos + (len(data) - pos) // PLAIN.size * PLAIN.size
    for fields in PLAIN.iter_unpack(memoryview(data)[pos:end]):
        if fields[:5] not in _PLAIN_HEADERS or fields[5] != 2:
            return
        ticks, channel, flags, dlc, word, payload = fields[6:]
        extended = word > MAX_ID
        if flags > 1 or dlc > 8 or (not extended and word > MAX_STANDARD_ID):
            return
        if (extended and word >> 29 != 4) or start_ns + ticks > MAX_TIME_NS:
            return
        way, can_id = "Tx" if flags else "Rx", word & MAX_ID
        yield ordinary_frame(start_ns + ticks, can_id, payload[:dlc], extended, str(channel), way)


def next_object(data: bytes, pos: int) -> int:
    """Return where the next plausible object header begins, or may begin in the last bytes."""
    while (pos := data.find(b"LOBJ", pos)) >= 0:
        if len(data) - pos < OBJECT.size or plausible_header(data, pos) is None:
            return pos
        pos += 4
    return len(data) - next((n for n in (3, 2, 1) if data.endswith(b"LOBJ"[:n])), 0)


def frame_of(kind: int, body: bytes, time_ns: int, header_size: int) -> LogFrame:
    """Return the frame of an object. Raises ValueError for one that no bus can carry."""
    fields = FRAME_LAYOUTS[kind].unpack_from(body)
    if kind in (ObjectType.CAN, ObjectType.CAN_2):
        channel, flags, dlc, word, data = fields
        frame = _built(time_ns, word, data[:dlc], channel, flags & 0x0F, dlc, bool(flags & REMOTE))
    elif kind == ObjectType.CAN_FD:
        channel, flags, dlc, word, _, _, fd, length, data = fields
        remote = bool(flags & REMOTE)
        frame = _built(time_ns, word, data[:length], channel, flags & 0x0F, dlc, remote, fd)
    elif kind == ObjectType.CAN_FD_64:
        channel, dlc, length, _, word, _, flags = fields[:7]
        extra = fields[13]
        begin = FRAME_LAYOUTS[ObjectType.CAN_FD_64].size
        stored = (extra - header_size if extra > header_size else len(body)) - begin
        # Vector's own writer leaves out trailing zero bytes that `length` still counts.
        data = body[begin:][: max(min(stored, length), 0)].ljust(length, b"\x00")
        remote = bool(flags & 0x10)
        frame = _built(time_ns, word, data, channel, fields[12], dlc, remote, flags >> 12)
    elif kind == ObjectType.CAN_ERROR_EXT:
        data = fields[9][: min(fields[5], 8)]
        frame = _built(time_ns, fields[7], data, fields[0], 2, 0, False)._replace(error=True)
    else:
        fd = kind == ObjectType.CAN_FD_ERROR_64
        frame = LogFrame(time_ns, 0, b"", False, error=True, fd=fd, channel=str(fields[0]))
    if problem := frame_problem(frame):
        raise ValueError(f"{problem}, {len(body)} bytes left out")
    return frame


def _built(
    time_ns: int,
    word: int,
    data: bytes,
    channel: int,
    way: int,
    dlc: int,
    remote: bool,
    fd_flags: int = 0,
) -> LogFrame:
    """Return a frame; fd_flags: 1 CAN FD, 2 bit rate switch, 4 error state."""
    fd, can_id = bool(fd_flags & 1), word & MAX_ID
    return LogFrame(
        time_ns,
        can_id,
        b"" if remote else data,
        bool(word & EXTENDED) or can_id > MAX_STANDARD_ID,  # some writers leave the flag out
        remote,
        False,
        fd,
        fd and bool(fd_flags & 2),
        fd and bool(fd_flags & 4),
        str(channel),
        # 2 is a request to send, 3 and more are converters' noise.
        ("Rx", "Tx")[way] if way < 2 else "",
        # The field has four bits on the bus.
        dlc & 0x0F if remote else dlc if not fd and 8 < dlc < 16 else 0,
    )

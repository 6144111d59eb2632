"""BLF, the binary log of CANalyzer and CANoe.

There is no public specification; the layouts are those that the open readers of the format agree
on (Technica and Lorenz's Vector BLF, python-can). A damaged container is skipped as a whole (its
checksum shows the damage), and reading goes on at the next one.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from typing import Final, NamedTuple

from can_dbc.errors import InputError
from sil.logs.format import Batch, Format, time_base
from sil.logs.frame import (
    MAX_EXTENDED_ID,
    MAX_STANDARD_ID,
    MAX_TIME_NS,
    LogFrame,
    frame_problem,
    ordinary_frame,
)
from sil.logs.report import Location, LogReport
from sil.logs.source import ByteSource
from sil.logs.times import NS_PER_MS, RELATIVE_BELOW_NS, format_ns, utc_calendar, utc_ns
from sil.logs.writer import LogWriter

_LARGEST_CONTAINER: Final = 1 << 26
_WRITTEN_CONTAINER: Final = 1 << 17
_BLOCK: Final = 1 << 18
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
    """Return the SYSTEMTIME of a time, all zero for 0; whole milliseconds."""
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
    """Return what is wrong with the object header at `pos`, or None."""
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
    """Yield what is in unpacked data, in order; at most one `Unfinished`, as the last."""
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
    """Return the flag, or whether the identifier fits no standard frame (some writers leave the flag out)."""
    return bool(word & EXTENDED) or word & 0x1FFFFFFF > MAX_STANDARD_ID


def _raw_dlc(dlc: int, remote: bool, fd: bool) -> int:
    """Return what `LogFrame.raw_dlc` holds; the field has four bits on the bus."""
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


class _Feed:
    """The file as a sliding window; `pos` is the index in it, `offset` that in the file."""

    def __init__(self, source: ByteSource) -> None:
        self._source = source
        self.window = b""
        self.pos = 0
        self.offset = 0

    def left(self) -> int:
        """Return the number of bytes of the window from `pos` on."""
        return len(self.window) - self.pos

    def fill(self, size: int) -> bool:
        """Have `size` bytes in the window if the file has them."""
        while self.left() < size:
            block = self._source.read(max(_BLOCK, size - self.left()))
            if not block:
                return False
            self.window = self.window[self.pos :] + block
            self.pos = 0
        return True

    def find(self, mark: bytes, within: int | None = None) -> int:
        """How far on a mark is in the window (in the next `within` bytes), -1 for nowhere."""
        end = len(self.window) if within is None else self.pos + within
        found = self.window.find(mark, self.pos, end)
        return found - self.pos if found >= 0 else -1

    def only_zeros(self) -> bool:
        """Return whether nothing but zero bytes is left in the window."""
        return not self.window[self.pos :].strip(b"\x00")

    def drop(self, size: int) -> None:
        """Go on by `size` bytes."""
        self.pos += size
        self.offset += size

    def take(self, size: int) -> bytes:
        """Return the next bytes, as many as there are up to `size`."""
        taken = self.window[self.pos : self.pos + size]
        self.drop(len(taken))
        return taken


class BlfReader:
    """State of one reading."""

    def __init__(self, report: LogReport) -> None:
        self._report = report
        self._tail = b""
        self._start_ns = 0

    def read(self, source: ByteSource) -> Iterator[Batch]:
        """Frames container by container."""
        feed = _Feed(source)
        stated_size = self._header(feed)
        while True:
            if not feed.fill(OBJECT.size + 8) and feed.only_zeros():
                break
            yield from self._object(feed)
        if self._tail.strip(b"\x00"):
            self._report.cut(Location("the log ends inside an object", byte=feed.offset))
        if stated_size > feed.offset + feed.left():
            self._report.cut(
                Location(
                    f"the header states {stated_size} bytes, more than there are", byte=feed.offset
                )
            )

    def _header(self, feed: _Feed) -> int:
        path = self._report.path
        if not feed.fill(FILE_HEADER.size) or feed.window[:4] != b"LOGG":
            raise InputError(f"{path}: byte 0: no BLF header; expected a BLF log")
        fields = FILE_HEADER.unpack_from(feed.window)
        size, stated_size = fields[1], fields[10]
        if not FILE_HEADER.size <= size <= 4096:
            self._report.skip(Location(f"a file header of {size} bytes", byte=4))
            size = FILE_HEADER_SIZE
        start_ns = read_systemtime(fields[14:22])
        self._start_ns = start_ns
        self._report.start_ns = start_ns or None
        self._report.time_base = time_base(start_ns)
        feed.fill(size)
        feed.drop(size)
        return int(stated_size)

    def _object(self, feed: _Feed) -> Iterator[Batch]:
        """Take the object (or the rubbish) at the window's start."""
        report = self._report
        skip = feed.find(b"LOBJ", 8)
        if feed.left() < max(skip, 0) + OBJECT.size:
            report.cut(Location("the log ends inside an object", byte=feed.offset))
            feed.drop(feed.left())
            return
        problem: str | None = "no object begins here"
        if skip >= 0:
            problem = plausible_header(feed.window, feed.pos + skip)
        if problem is None:
            feed.drop(skip)
            _, header_size, _, size, kind = OBJECT.unpack_from(feed.window, feed.pos)
            if kind == TYPE_CONTAINER and not 32 <= size <= _LARGEST_CONTAINER:
                problem = f"container of {size} bytes"
        if problem is not None:
            report.skip(Location(problem, byte=feed.offset))
            self._drop_tail()
            self._to_next_object(feed)
            return
        whole = feed.fill(size)
        offset = feed.offset
        body = feed.take(size)
        if kind != TYPE_CONTAINER:
            yield self._batch(body, offset)
            return
        unpacked = self._unpack(body, header_size, offset, whole)
        if unpacked is None:
            self._drop_tail()
        else:
            yield self._batch(unpacked, offset)

    def _to_next_object(self, feed: _Feed) -> None:
        """Go on to where the next object may begin."""
        feed.drop(1)
        while True:
            found = feed.find(b"LOBJ")
            if found >= 0:
                feed.drop(found)
                return
            feed.drop(max(feed.left() - 3, 0))
            if not feed.fill(feed.left() + 1):
                feed.drop(feed.left())
                return

    def _drop_tail(self) -> None:
        if self._tail.strip(b"\x00"):
            self._report.note("an object that went on in a damaged container is lost")
        self._tail = b""

    def _unpack(self, body: bytes, header_size: int, offset: int, whole: bool) -> bytes | None:
        """Return the content of a container, of a cut-off one as much as there is; None if damaged."""
        report = self._report
        if len(body) < header_size + CONTAINER.size:
            report.cut(Location("the log ends inside a container", byte=offset))
            return None
        method, size = CONTAINER.unpack_from(body, header_size)
        packed = body[header_size + CONTAINER.size :]
        if method == 0:
            content = packed
        elif method == 2:
            if size > _LARGEST_CONTAINER:
                report.skip(Location(f"container of {size} unpacked bytes", byte=offset))
                return None
            inflate = zlib.decompressobj()
            try:
                content = inflate.decompress(packed, size + 1)
            except zlib.error as error:
                report.skip(Location(f"damaged container ({error})", byte=offset))
                return None
            if whole and (not inflate.eof or len(content) != size):
                report.skip(Location("damaged container (its size is another)", byte=offset))
                return None
        else:
            report.skip(Location(f"container packed by method {method}", byte=offset))
            return None
        if not whole:
            report.cut(Location("the log ends inside a container", byte=offset))
        return content

    def _batch(self, data: bytes, offset: int) -> Batch:
        """Return the frames of unpacked data, which may go on an object of an earlier container."""
        report = self._report
        data = self._tail + data
        self._tail = b""
        frames: list[LogFrame] = []
        for item in objects(data, self._start_ns):
            if isinstance(item, LogFrame):
                frames.append(item)
            elif isinstance(item, Other):
                report.other[item.name] += 1
            elif isinstance(item, Broken):
                report.skip(Location(f"{item.reason}, {item.passed} bytes left out", byte=offset))
            else:
                self._tail = data[item.start :]
        return Batch(frames, [offset] * len(frames))


class BlfWriter(LogWriter):
    """Writes CAN, CAN FD and error objects with nanosecond times in zlib containers."""

    format = "blf"
    patched = True

    def __init__(self, path: str) -> None:
        super().__init__(path)
        self._start_ns: int | None = None
        self._stop_ns = 0
        self._buffer = bytearray()
        self._unpacked_size = FILE_HEADER_SIZE
        self._out.write(bytes(FILE_HEADER_SIZE))

    def _write_batch(self, frames: list[LogFrame]) -> None:
        if self._start_ns is None:
            first_ns = min(frame.time_ns for frame in frames)
            absolute = first_ns >= RELATIVE_BELOW_NS
            self._start_ns = first_ns // NS_PER_MS * NS_PER_MS if absolute else 0
        for frame in frames:
            self._add(frame, self._start_ns)

    def _add(self, frame: LogFrame, start_ns: int) -> None:
        time_ns = frame.time_ns - start_ns
        if time_ns < 0:
            raise InputError(
                f"{self.path}: a frame at {format_ns(frame.time_ns)} s is before the start of "
                f"the log at {format_ns(start_ns)} s; expected candump, csv or mf4 for it"
            )
        self._stop_ns = max(self._stop_ns, frame.time_ns)
        channel = self.channel_number(frame.channel)
        word = frame.can_id | (EXTENDED if frame.extended else 0)
        flags = (REMOTE if frame.remote else 0) | (frame.direction == "Tx")
        if not frame.direction and not frame.error:
            self.losses["direction not recorded, written as Rx"] += 1
        if frame.error:
            if frame.direction or frame.fd or frame.remote:
                self.losses["flags of an error frame"] += 1
            if len(frame.data) > 8:
                self.losses["bytes of an error frame after the eighth"] += 1
            kind = TYPE_CAN_ERROR_EXT
            length = min(len(frame.data), 8)
            body = CAN_ERROR_EXT.pack(channel, 0, 0, 0, 0, length, 0, word, 0, frame.data[:8])
        elif frame.fd:
            kind = TYPE_CAN_FD
            fd_flags = 1 | frame.brs << 1 | frame.esi << 2
            body = CAN_FD.pack(
                channel, flags, frame.dlc, word, 0, 0, fd_flags, len(frame.data), frame.data
            )
        else:
            kind = TYPE_CAN
            body = CAN.pack(channel, flags, frame.dlc, word, frame.data)
        header_size = OBJECT.size + TIMES_V1.size
        size = header_size + len(body)
        self._buffer += OBJECT.pack(b"LOBJ", header_size, 1, size, kind)
        self._buffer += TIMES_V1.pack(2, 0, 0, time_ns)
        self._buffer += body
        self._buffer += bytes(size % 4)
        if len(self._buffer) >= _WRITTEN_CONTAINER:
            self._container(self._buffer[:_WRITTEN_CONTAINER])
            del self._buffer[:_WRITTEN_CONTAINER]

    def _container(self, content: bytearray) -> None:
        packed = zlib.compress(content, 6)
        size = OBJECT.size + CONTAINER.size + len(packed)
        self._out.write(OBJECT.pack(b"LOBJ", OBJECT.size, 1, size, TYPE_CONTAINER))
        self._out.write(CONTAINER.pack(2, len(content)))
        self._out.write(packed)
        self._out.write(bytes(size % 4))
        self._unpacked_size += OBJECT.size + CONTAINER.size + len(content)

    def _finish(self) -> None:
        if self._buffer:
            self._container(self._buffer)
        start_ns = self._start_ns or 0
        size = self._out.tell()
        header = FILE_HEADER.pack(
            b"LOGG",
            FILE_HEADER_SIZE,
            *(0, 0, 0, 0, 2, 6, 8, 1),
            size,
            self._unpacked_size,
            self.frames,
            0,
            *write_systemtime(start_ns),
            *write_systemtime(self._stop_ns if start_ns else 0),
        )
        self._out.seek(0)
        self._out.write(header)


def _recognise(head: bytes) -> bool:
    return head.startswith(b"LOGG")


def _read(source: ByteSource, report: LogReport, times: str) -> Iterator[Batch]:
    return BlfReader(report).read(source)


FORMAT: Final = Format("blf", (".blf",), _recognise, _read, BlfWriter, "byte")

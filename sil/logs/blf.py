"""BLF, the binary log of CANalyzer and CANoe.

A damaged container is skipped as a whole (its checksum shows the damage), and reading goes on at the
next one. There is no public specification; the layouts are those that the open readers of the format
agree on (Technica and Lorenz's Vector BLF, python-can).
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Generator, Iterator, Sequence
from enum import IntEnum
from typing import Final

from can_dbc.errors import InputError
from can_dbc.frame import MAX_ID, SOCKETCAN_EXTENDED
from sil.files.quantity import counted
from sil.logs.format import ZONE_NOTE, Batch, time_base
from sil.logs.frame import MAX_STANDARD_ID, MAX_TIME_NS, LogFrame, frame_problem, ordinary_frame
from sil.logs.report import Location, LogReport
from sil.logs.source import ByteSource
from sil.logs.times import NS_PER_MS, utc_calendar, utc_ns
from sil.logs.writer import LogWriter

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
    is_container = kind == ObjectType.CONTAINER
    if is_container and not 32 <= size <= LARGEST_CONTAINER:
        return f"container of {size} bytes"
    least = OBJECT.size if is_container else OBJECT.size + TIMES_V1.size
    if version not in (1, 2) or header_size < least or size < header_size:
        return f"object header of version {version} with sizes {header_size} and {size}"
    layout = FRAME_LAYOUTS.get(kind)
    if layout is not None and not header_size + layout.size <= size <= 1 << 12:
        return f"object of type {kind} with {size} bytes"
    return f"object of {size} bytes" if size > 1 << 22 and not is_container else None


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
        bool(word & SOCKETCAN_EXTENDED)
        or can_id > MAX_STANDARD_ID,  # some writers leave the flag out
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


class BlfReader:
    """State of one reading; `tail`: an object that begins in a container and goes on in the next."""

    def __init__(self, source: ByteSource, report: LogReport, times: str) -> None:
        self._source = source
        self._report = report
        self._tail = b""
        self._start_ns = self._stated_end = 0

    def __iter__(self) -> Iterator[Batch]:
        report = self._report
        offset = self._header()
        data = b""
        while block := self._source.read(max(1 << 18, len(data))):
            data += block
            rest = yield from self._objects(data, offset)
            data, offset = data[rest:], offset + rest
        if len(data) >= OBJECT.size and OBJECT.unpack_from(data)[::4] == (
            b"LOBJ",
            ObjectType.CONTAINER,
        ):
            yield from self._inside(data, offset, whole=False)
        elif data:
            report.cut(Location("the log ends inside an object", byte=offset))
        offset += len(data)
        if self._tail.strip(b"\x00"):
            report.cut(Location("the log ends inside an object", byte=offset))
        if self._stated_end > offset:
            reason = f"the header states {self._stated_end} bytes, more than there are"
            report.cut(Location(reason, byte=offset))

    def _objects(self, data: bytes, offset: int, container: int = 0) -> Generator[Batch, None, int]:
        """Yield the frames in data; return where the last object begins if it is not whole.

        offset: of the data in the file; container: of the container that they are from, 0 for none.
        """
        frames: list[LogFrame] = []
        locations: list[int] = []
        pos, end = 0, len(data)
        while True:
            for frame in run_of_plain(data, pos, self._start_ns):
                frames.append(frame)
                locations.append(container or offset + pos)
                pos += PLAIN.size
            if not container and (mark := data.find(b"LOGG", pos, pos + 8)) >= 0:
                self._report.refuse_second(Location("", byte=offset + mark))
            begin, mark = pos, data.find(b"LOBJ", pos, pos + 8)
            if mark < 0 and end - pos < 8:
                pos = pos if data[pos:].strip(b"\x00") else end
                break
            pos = max(pos, mark)
            if mark >= 0 and end - pos < OBJECT.size:
                break
            problem = plausible_header(data, pos) if mark >= 0 else "no object begins here"
            location = container or offset + (pos if problem is None else begin)
            if problem is not None:
                pos = next_object(data, pos + (4 if mark >= 0 else 0))
                self._skip(
                    f"{problem}, {counted(pos - begin, 'byte')} left out", location, container
                )
                continue
            header_size, version, size, kind = OBJECT.unpack_from(data, pos)[1:]
            if pos + size > end:
                break
            body = data[pos : pos + size]
            pos += size
            if kind == ObjectType.CONTAINER and not container:
                yield Batch(frames, locations)
                frames, locations = [], []
                yield from self._inside(body, location)
            elif kind not in FRAME_LAYOUTS:
                self._report.other[OTHER_TYPES.get(kind, f"BLF object of type {kind}")] += 1
            else:
                try:
                    frames.append(self._read(kind, version, header_size, body))
                    locations.append(location)
                except ValueError as broken:
                    self._skip(str(broken), location, container)
        yield Batch(frames, locations)
        return pos

    def _read(self, kind: int, version: int, header_size: int, body: bytes) -> LogFrame:
        """Return the frame of a whole object. Raises ValueError for a broken one."""
        times = TIMES_V1 if version == 1 else TIMES_V2
        flags, _, _, ticks = times.unpack_from(body, OBJECT.size)
        tick_ns = {1: 10_000, 2: 1}.get(flags & 3)
        if tick_ns is None:
            raise ValueError(f"time flag {flags}, {len(body)} bytes left out")
        return frame_of(kind, body[header_size:], self._start_ns + ticks * tick_ns, header_size)

    def _skip(self, reason: str, location: int, container: int) -> None:
        self._report.skip(Location(reason, byte=location))
        if not container:
            self._drop_tail()

    def _header(self) -> int:
        """Read the file header; return its size. Raises InputError for a file of another format."""
        header = self._exactly(FILE_HEADER.size)
        if len(header) < FILE_HEADER.size or header[:4] != b"LOGG":
            raise InputError(f"{self._report.path}: byte 0: no BLF header; expected a BLF log")
        fields = FILE_HEADER.unpack_from(header)
        size: int = fields[1]
        self._stated_end, self._start_ns = fields[10], read_systemtime(fields[14:22])
        if not FILE_HEADER.size <= size <= 4096:
            self._report.skip(Location(f"a file header of {size} bytes", byte=4))
            size = FILE_HEADER_SIZE
        self._exactly(size - FILE_HEADER.size)
        self._report.start_ns = self._start_ns or None
        self._report.time_base = time_base(self._start_ns)
        if self._start_ns:
            self._report.note(ZONE_NOTE)
        return size

    def _exactly(self, size: int) -> bytes:
        """Return the next bytes, fewer at the end of the file."""
        content = b""
        while len(content) < size and (block := self._source.read(size - len(content))):
            content += block
        return content

    def _drop_tail(self) -> None:
        if self._tail.strip(b"\x00"):
            self._report.note("an object that went on in a damaged container is lost")
        self._tail = b""

    def _inside(self, container: bytes, offset: int, whole: bool = True) -> Iterator[Batch]:
        """Yield the frames of a container, which may go on an object of an earlier one."""
        content = self._unpack(container, offset, whole)
        if content is None:
            self._drop_tail()
            return
        data, self._tail = self._tail + content, b""
        rest = yield from self._objects(data, 0, container=offset)
        self._tail = data[rest:]

    def _unpack(self, container: bytes, offset: int, whole: bool) -> bytes | None:
        """Return the content of a container, of a cut-off one as much as there is; None if damaged."""
        report, header_size = self._report, OBJECT.unpack_from(container)[1]
        begin = header_size + CONTAINER.size
        if len(container) < begin:
            report.cut(Location("the log ends inside a container", byte=offset))
            return None
        method, size = CONTAINER.unpack_from(container, header_size)
        content, damage = container[begin:], ""
        if method == 2 and size <= LARGEST_CONTAINER:
            inflate = zlib.decompressobj()
            try:
                content = inflate.decompress(content, size + 1)
            except zlib.error as error:
                damage = f"damaged container ({error})"
            else:
                if whole and (not inflate.eof or len(content) != size):
                    damage = "damaged container (its size is another)"
        elif method == 2:
            damage = f"container of {size} unpacked bytes"
        elif method != 0:
            damage = f"container packed by method {method}"
        if damage:
            report.skip(Location(damage, byte=offset))
            return None
        if not whole:
            report.cut(Location("the log ends inside a container", byte=offset))
        return content


class BlfWriter(LogWriter):
    """Writes CAN, CAN FD and error objects with nanosecond times in zlib containers."""

    format = "blf"
    patched = True

    def __init__(self, path: str) -> None:
        super().__init__(path)
        self._stop_ns = 0
        self._buffer = bytearray()
        self._unpacked_size = FILE_HEADER_SIZE

    def _begin(self, frames: list[LogFrame]) -> None:
        self._out.write(bytes(FILE_HEADER_SIZE))

    def _write_batch(self, frames: list[LogFrame]) -> None:
        for frame in frames:
            self._add(frame)

    def _add(self, frame: LogFrame) -> None:
        time_ns = self._since_start(frame)
        self._stop_ns = max(self._stop_ns, frame.time_ns)
        channel = self.channel_number(frame.channel)
        word = frame.can_id | (SOCKETCAN_EXTENDED if frame.extended else 0)
        flags = REMOTE if frame.remote else 0
        if not frame.error:
            flags |= self.direction(frame) == "Tx"
        if frame.error:
            self.lose(frame.direction or frame.fd or frame.remote, "flags of an error frame")
            kind = ObjectType.CAN_ERROR_EXT
            data = self.error_data(frame)
            body = FRAME_LAYOUTS[kind].pack(channel, 0, 0, 0, 0, len(data), 0, word, 0, data)
        elif frame.fd:
            kind = ObjectType.CAN_FD
            fd_flags = 1 | frame.brs << 1 | frame.esi << 2
            body = FRAME_LAYOUTS[kind].pack(
                channel, flags, frame.dlc, word, 0, 0, fd_flags, len(frame.data), frame.data
            )
        else:
            kind = ObjectType.CAN
            body = FRAME_LAYOUTS[kind].pack(channel, flags, frame.dlc, word, frame.data)
        header_size = OBJECT.size + TIMES_V1.size
        size = header_size + len(body)
        self._buffer += OBJECT.pack(b"LOBJ", header_size, 1, size, kind)
        self._buffer += TIMES_V1.pack(2, 0, 0, time_ns)
        self._buffer += body
        self._buffer += bytes(size % 4)
        if len(self._buffer) >= (container_bytes := 1 << 17):
            self._container(self._buffer[:container_bytes])
            del self._buffer[:container_bytes]

    def _container(self, content: bytearray) -> None:
        packed = zlib.compress(content, 6)
        size = OBJECT.size + CONTAINER.size + len(packed)
        self._out.write(OBJECT.pack(b"LOBJ", OBJECT.size, 1, size, ObjectType.CONTAINER))
        self._out.write(CONTAINER.pack(2, len(content)))
        self._out.write(packed)
        self._out.write(bytes(size % 4))
        self._unpacked_size += OBJECT.size + CONTAINER.size + len(content)

    def _finish(self) -> None:
        if self._buffer:
            self._container(self._buffer)
        size, start_ns = self._out.tell(), self.start_ns
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


def recognise(head: bytes) -> bool:
    """Return whether a file begins as a BLF file."""
    return head.startswith(b"LOGG")

"""BLF, the binary log of CANalyzer and CANoe.

A damaged container is skipped as a whole (its checksum shows the damage), and reading goes on at
the next one.
"""

from __future__ import annotations

import zlib
from collections.abc import Generator, Iterator
from typing import Final

from can_dbc.errors import InputError
from sil.files.quantity import counted
from sil.logs import blf_objects as layout
from sil.logs.format import ZONE_NOTE, Batch, Format, time_base
from sil.logs.frame import LogFrame
from sil.logs.report import Location, LogReport
from sil.logs.source import ByteSource
from sil.logs.writer import LogWriter


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
        if len(data) >= layout.OBJECT.size and layout.OBJECT.unpack_from(data)[::4] == (
            b"LOBJ",
            layout.ObjectType.CONTAINER,
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
            for frame in layout.run_of_plain(data, pos, self._start_ns):
                frames.append(frame)
                locations.append(container or offset + pos)
                pos += layout.PLAIN.size
            if not container and (mark := data.find(b"LOGG", pos, pos + 8)) >= 0:
                if end - mark < layout.FILE_HEADER_SIZE:
                    break
                pos = mark + self._further(data, mark, offset)
                continue
            begin, mark = pos, data.find(b"LOBJ", pos, pos + 8)
            if mark < 0 and end - pos < 8:
                pos = pos if data[pos:].strip(b"\x00") else end
                break
            pos = max(pos, mark)
            if mark >= 0 and end - pos < layout.OBJECT.size:
                break
            problem = layout.plausible_header(data, pos) if mark >= 0 else "no object begins here"
            location = container or offset + (pos if problem is None else begin)
            if problem is not None:
                pos = layout.next_object(data, pos + (4 if mark >= 0 else 0))
                self._skip(
                    f"{problem}, {counted(pos - begin, 'byte')} left out", location, container
                )
                continue
            header_size, version, size, kind = layout.OBJECT.unpack_from(data, pos)[1:]
            if pos + size > end:
                break
            body = data[pos : pos + size]
            pos += size
            if kind == layout.ObjectType.CONTAINER and not container:
                yield Batch(frames, locations)
                frames, locations = [], []
                yield from self._inside(body, location)
            elif kind not in layout.FRAME_LAYOUTS:
                self._report.other[layout.OTHER_TYPES.get(kind, f"BLF object of type {kind}")] += 1
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
        times = layout.TIMES_V1 if version == 1 else layout.TIMES_V2
        flags, _, _, ticks = times.unpack_from(body, layout.OBJECT.size)
        tick_ns = {1: 10_000, 2: 1}.get(flags & 3)
        if tick_ns is None:
            raise ValueError(f"time flag {flags}, {len(body)} bytes left out")
        return layout.frame_of(
            kind, body[header_size:], self._start_ns + ticks * tick_ns, header_size
        )

    def _skip(self, reason: str, location: int, container: int) -> None:
        self._report.skip(Location(reason, byte=location))
        if not container:
            self._drop_tail()

    def _header(self) -> int:
        """Read the file header; return its size. Raises InputError for a file of another format."""
        header = self._exactly(layout.FILE_HEADER.size)
        if len(header) < layout.FILE_HEADER.size or header[:4] != b"LOGG":
            raise InputError(f"{self._report.path}: byte 0: no BLF header; expected a BLF log")
        size, self._stated_end, self._start_ns = self._stated(header, 0)
        self._exactly(size - layout.FILE_HEADER.size)
        self._report.start_ns = self._start_ns or None
        self._report.time_base = time_base(self._start_ns)
        if self._start_ns:
            self._report.note(ZONE_NOTE)
        return size

    def _stated(self, header: bytes, offset: int) -> tuple[int, int, int]:
        """Return the size of a header at an offset, the file's end and its start in ns, as stated."""
        fields = layout.FILE_HEADER.unpack_from(header)
        size, end = fields[1], offset + fields[10]
        if not layout.FILE_HEADER.size <= size <= 4096:
            self._report.skip(Location(f"a file header of {size} bytes", byte=offset + 4))
            size = layout.FILE_HEADER_SIZE
        return size, end, layout.read_systemtime(fields[14:22])

    def _further(self, data: bytes, pos: int, offset: int) -> int:
        """Begin a second measurement, as joined files have it; return the size of its header."""
        self._drop_tail()
        size, self._stated_end, self._start_ns = self._stated(data[pos:], offset + pos)
        self._report.further(self._start_ns or None, Location("", byte=offset + pos))
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
        report, header_size = self._report, layout.OBJECT.unpack_from(container)[1]
        begin = header_size + layout.CONTAINER.size
        if len(container) < begin:
            report.cut(Location("the log ends inside a container", byte=offset))
            return None
        method, size = layout.CONTAINER.unpack_from(container, header_size)
        content, damage = container[begin:], ""
        if method == 2 and size <= layout.LARGEST_CONTAINER:
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
        self._unpacked_size = layout.FILE_HEADER_SIZE

    def _begin(self, frames: list[LogFrame]) -> None:
        self._out.write(bytes(layout.FILE_HEADER_SIZE))

    def _write_batch(self, frames: list[LogFrame]) -> None:
        for frame in frames:
            self._add(frame)

    def _add(self, frame: LogFrame) -> None:
        time_ns = self._since_start(frame)
        self._stop_ns = max(self._stop_ns, frame.time_ns)
        channel = self.channel_number(frame.channel)
        word = frame.can_id | (layout.EXTENDED if frame.extended else 0)
        flags = layout.REMOTE if frame.remote else 0
        if not frame.error:
            flags |= self.direction(frame) == "Tx"
        if frame.error:
            self.lose(frame.direction or frame.fd or frame.remote, "flags of an error frame")
            kind = layout.ObjectType.CAN_ERROR_EXT
            data = self.error_data(frame)
            body = layout.FRAME_LAYOUTS[kind].pack(channel, 0, 0, 0, 0, len(data), 0, word, 0, data)
        elif frame.fd:
            kind = layout.ObjectType.CAN_FD
            fd_flags = 1 | frame.brs << 1 | frame.esi << 2
            body = layout.FRAME_LAYOUTS[kind].pack(
                channel, flags, frame.dlc, word, 0, 0, fd_flags, len(frame.data), frame.data
            )
        else:
            kind = layout.ObjectType.CAN
            body = layout.FRAME_LAYOUTS[kind].pack(channel, flags, frame.dlc, word, frame.data)
        header_size = layout.OBJECT.size + layout.TIMES_V1.size
        size = header_size + len(body)
        self._buffer += layout.OBJECT.pack(b"LOBJ", header_size, 1, size, kind)
        self._buffer += layout.TIMES_V1.pack(2, 0, 0, time_ns)
        self._buffer += body
        self._buffer += bytes(size % 4)
        if len(self._buffer) >= (container_bytes := 1 << 17):
            self._container(self._buffer[:container_bytes])
            del self._buffer[:container_bytes]

    def _container(self, content: bytearray) -> None:
        packed = zlib.compress(content, 6)
        size = layout.OBJECT.size + layout.CONTAINER.size + len(packed)
        self._out.write(
            layout.OBJECT.pack(b"LOBJ", layout.OBJECT.size, 1, size, layout.ObjectType.CONTAINER)
        )
        self._out.write(layout.CONTAINER.pack(2, len(content)))
        self._out.write(packed)
        self._out.write(bytes(size % 4))
        self._unpacked_size += layout.OBJECT.size + layout.CONTAINER.size + len(content)

    def _finish(self) -> None:
        if self._buffer:
            self._container(self._buffer)
        size, start_ns = self._out.tell(), self.start_ns
        header = layout.FILE_HEADER.pack(
            b"LOGG",
            layout.FILE_HEADER_SIZE,
            *(0, 0, 0, 0, 2, 6, 8, 1),
            size,
            self._unpacked_size,
            self.frames,
            0,
            *layout.write_systemtime(start_ns),
            *layout.write_systemtime(self._stop_ns if start_ns else 0),
        )
        self._out.seek(0)
        self._out.write(header)


def _recognise(head: bytes) -> bool:
    return head.startswith(b"LOGG")


FORMAT: Final = Format("blf", (".blf",), _recognise, BlfReader, BlfWriter, "byte")

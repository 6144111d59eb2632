"""BLF, the binary log of CANalyzer and CANoe.

python-can's reader and writer carry times as floats (0.2 µs off today), stop at the first damaged
container and lose what follows without a word; so ours stand in front. A damaged container is
skipped whole (its checksum tells), and reading goes on at the next one.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from typing import Final

from can_dbc.errors import InputError
from sil.logs import blf_objects as blf
from sil.logs.backend import Batch, LogWriter, ReadOptions
from sil.logs.byte_source import ByteSource
from sil.logs.frame import LogFrame
from sil.logs.report import LogReport, Place
from sil.logs.times import NS_PER_MS, RELATIVE_BELOW_NS, format_ns

_LARGEST_CONTAINER: Final = 1 << 26
_WRITTEN_CONTAINER: Final = 1 << 17
_BLOCK: Final = 1 << 18


class _Feed:
    """The file as a window that slides on; `pos` is the place in it, `offset` that in the file."""

    def __init__(self, source: ByteSource) -> None:
        self._source = source
        self.window = b""
        self.pos = 0
        self.offset = 0

    def left(self) -> int:
        """Bytes of the window from the place on."""
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
        """Whether nothing but zero bytes is left in the window."""
        return not self.window[self.pos :].strip(b"\x00")

    def drop(self, size: int) -> None:
        """Go on by `size` bytes."""
        self.pos += size
        self.offset += size

    def take(self, size: int) -> bytes:
        """The next bytes, as many as there are up to `size`."""
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
        told_size = self._header(feed)
        while True:
            if not feed.fill(blf.OBJECT.size + 8) and feed.only_zeros():
                break
            yield from self._object(feed)
        if self._tail.strip(b"\x00"):
            self._report.cut(Place("the log ends inside an object", byte=feed.offset))
        if told_size > feed.offset + feed.left():
            self._report.cut(
                Place(f"the header tells {told_size} bytes, more than there are", byte=feed.offset)
            )

    def _header(self, feed: _Feed) -> int:
        path = self._report.path
        if not feed.fill(blf.FILE_HEADER.size) or feed.window[:4] != b"LOGG":
            raise InputError(f"{path}: byte 0: no BLF header; expected a BLF log")
        fields = blf.FILE_HEADER.unpack_from(feed.window)
        size, told_size = fields[1], fields[10]
        if not blf.FILE_HEADER.size <= size <= 4096:
            self._report.skip(Place(f"a file header of {size} bytes", byte=4))
            size = blf.FILE_HEADER_SIZE
        start_ns = blf.read_systemtime(fields[14:22])
        self._start_ns = start_ns
        self._report.start_ns = start_ns or None
        self._report.time_base = "absolute" if start_ns else "relative"
        feed.fill(size)
        feed.drop(size)
        return int(told_size)

    def _object(self, feed: _Feed) -> Iterator[Batch]:
        """Take the object (or the rubbish) at the window's start."""
        report = self._report
        skip = feed.find(b"LOBJ", 8)
        if feed.left() < max(skip, 0) + blf.OBJECT.size:
            report.cut(Place("the log ends inside an object", byte=feed.offset))
            feed.drop(feed.left())
            return
        problem: str | None = "no object begins here"
        if skip >= 0:
            problem = blf.plausible_header(feed.window, feed.pos + skip)
        if problem is None:
            feed.drop(skip)
            _, header_size, _, size, kind = blf.OBJECT.unpack_from(feed.window, feed.pos)
            if kind == blf.TYPE_CONTAINER and not 32 <= size <= _LARGEST_CONTAINER:
                problem = f"container of {size} bytes"
        if problem is not None:
            report.skip(Place(problem, byte=feed.offset))
            self._drop_tail()
            self._to_next_object(feed)
            return
        whole = feed.fill(size)
        offset = feed.offset
        body = feed.take(size)
        if kind != blf.TYPE_CONTAINER:
            yield self._batch(body, offset)
            return
        unpacked = self._unpack(body, header_size, offset, whole)
        if unpacked is None:
            self._drop_tail()
        else:
            yield self._batch(unpacked, offset)

    def _to_next_object(self, feed: _Feed) -> None:
        """Slide on to the next place where an object may begin."""
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
        """The content of a container, of a cut-off one as much as there is; None if damaged."""
        report = self._report
        if len(body) < header_size + blf.CONTAINER.size:
            report.cut(Place("the log ends inside a container", byte=offset))
            return None
        method, size = blf.CONTAINER.unpack_from(body, header_size)
        packed = body[header_size + blf.CONTAINER.size :]
        if method == 0:
            content = packed
        elif method == 2:
            if size > _LARGEST_CONTAINER:
                report.skip(Place(f"container of {size} unpacked bytes", byte=offset))
                return None
            inflate = zlib.decompressobj()
            try:
                content = inflate.decompress(packed, size + 1)
            except zlib.error as error:
                report.skip(Place(f"damaged container ({error})", byte=offset))
                return None
            if whole and (not inflate.eof or len(content) != size):
                report.skip(Place("damaged container (its size is another)", byte=offset))
                return None
        else:
            report.skip(Place(f"container packed by method {method}", byte=offset))
            return None
        if not whole:
            report.cut(Place("the log ends inside a container", byte=offset))
        return content

    def _batch(self, data: bytes, offset: int) -> Batch:
        """The frames of unpacked data, after what an earlier container left unfinished."""
        report = self._report
        data = self._tail + data
        self._tail = b""
        frames: list[LogFrame] = []
        for item in blf.objects(data, self._start_ns):
            if isinstance(item, LogFrame):
                frames.append(item)
            elif isinstance(item, blf.Other):
                report.other[item.name] += 1
            elif isinstance(item, blf.Broken):
                report.skip(Place(f"{item.reason}, {item.passed} bytes left out", byte=offset))
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
        self._unpacked_size = blf.FILE_HEADER_SIZE
        self._out.write(bytes(blf.FILE_HEADER_SIZE))

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
                f"{self.path}: a frame at {format_ns(frame.time_ns)} s lies before the start of "
                f"the log at {format_ns(start_ns)} s; expected candump, csv or mf4 for it"
            )
        self._stop_ns = max(self._stop_ns, frame.time_ns)
        channel = self.channel_number(frame.channel)
        word = frame.can_id | (blf.EXTENDED if frame.extended else 0)
        flags = (blf.REMOTE if frame.remote else 0) | (frame.direction == "Tx")
        if not frame.direction and not frame.error:
            self.losses["direction not recorded, written as Rx"] += 1
        if frame.error:
            if frame.direction or frame.fd or frame.remote:
                self.losses["flags of an error frame"] += 1
            if len(frame.data) > 8:
                self.losses["bytes of an error frame after the eighth"] += 1
            kind = blf.TYPE_CAN_ERROR_EXT
            length = min(len(frame.data), 8)
            body = blf.CAN_ERROR_EXT.pack(channel, 0, 0, 0, 0, length, 0, word, 0, frame.data[:8])
        elif frame.fd:
            kind = blf.TYPE_CAN_FD
            fd_flags = 1 | frame.brs << 1 | frame.esi << 2
            body = blf.CAN_FD.pack(
                channel, flags, frame.dlc, word, 0, 0, fd_flags, len(frame.data), frame.data
            )
        else:
            kind = blf.TYPE_CAN
            body = blf.CAN.pack(channel, flags, frame.dlc, word, frame.data)
        header_size = blf.OBJECT.size + blf.TIMES_V1.size
        size = header_size + len(body)
        self._buffer += blf.OBJECT.pack(b"LOBJ", header_size, 1, size, kind)
        self._buffer += blf.TIMES_V1.pack(2, 0, 0, time_ns)
        self._buffer += body
        self._buffer += bytes(size % 4)
        if len(self._buffer) >= _WRITTEN_CONTAINER:
            self._container(self._buffer[:_WRITTEN_CONTAINER])
            del self._buffer[:_WRITTEN_CONTAINER]

    def _container(self, content: bytearray) -> None:
        packed = zlib.compress(content, 6)
        size = blf.OBJECT.size + blf.CONTAINER.size + len(packed)
        self._out.write(blf.OBJECT.pack(b"LOBJ", blf.OBJECT.size, 1, size, blf.TYPE_CONTAINER))
        self._out.write(blf.CONTAINER.pack(2, len(content)))
        self._out.write(packed)
        self._out.write(bytes(size % 4))
        self._unpacked_size += blf.OBJECT.size + blf.CONTAINER.size + len(content)

    def _finish(self) -> None:
        if self._buffer:
            self._container(self._buffer)
        start_ns = self._start_ns or 0
        size = self._out.tell()
        header = blf.FILE_HEADER.pack(
            b"LOGG",
            blf.FILE_HEADER_SIZE,
            *(0, 0, 0, 0, 2, 6, 8, 1),
            size,
            self._unpacked_size,
            self.frames,
            0,
            *blf.write_systemtime(start_ns),
            *blf.write_systemtime(self._stop_ns if start_ns else 0),
        )
        self._out.seek(0)
        self._out.write(header)


class Blf:
    """The BLF format."""

    name = "blf"
    suffixes: tuple[str, ...] = (".blf",)
    place_word = "byte"

    def sniff(self, head: bytes) -> bool:
        """Whether the file has the BLF signature."""
        return head.startswith(b"LOGG")

    def batches(
        self, source: ByteSource, report: LogReport, options: ReadOptions
    ) -> Iterator[Batch]:
        """The frames of a BLF log."""
        return BlfReader(report).read(source)

    def writer(self, path: str) -> LogWriter:
        """A writer of a new BLF log."""
        return BlfWriter(path)

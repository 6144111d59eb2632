"""MF4 (ASAM MDF 4) through asammdf: logs of CAN frames, and tables of signals.

asammdf is optional (the extra `mdf`) and slow to import: it is imported when an MF4 is read or
written. It trusts the links and sizes in a file, so that a damaged one can make it loop or crash;
the block structure is therefore checked first.
"""

from __future__ import annotations

import contextlib
import heapq
import io
import logging
import os
import shutil
import struct
import tempfile
from collections.abc import Iterator, Sequence
from operator import itemgetter
from typing import TYPE_CHECKING, Any, BinaryIO, Final, NamedTuple

from can_dbc.errors import InputError
from sil.files.extras import import_extra
from sil.logs.format import Batch, Format, time_base
from sil.logs.frame import (
    DLC_LENGTHS,
    MAX_EXTENDED_ID,
    MAX_STANDARD_ID,
    MAX_TIME_NS,
    LogFrame,
    frame_problem,
)
from sil.logs.report import Location, LogReport, printable
from sil.logs.source import ByteSource
from sil.logs.times import NS_PER_MS, NS_PER_S, RELATIVE_BELOW_NS
from sil.logs.writer import LogWriter

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

_FRAME_KINDS: Final = ("CAN_DataFrame", "CAN_ErrorFrame", "CAN_RemoteFrame")
_OTHER_BUSES: Final = ("LIN", "FLEXRAY", "ETH", "MOST", "K-LINE", "CAN")
_TEXT_FLAGS: Final = {"rx": 0, "tx": 1, "false": 0, "true": 1, "no": 0, "yes": 1}
_ROWS: Final = 2048
"""Rows that become frames at once."""

_FRAGMENT_BYTES: Final = 1 << 18
"""Bytes of records that asammdf takes from the file at once."""

_EXACT_SPAN_NS: Final = 4_000_000 * 10**9
"""Times are stored as seconds in a double; up to here (46 days) these are exact to the ns."""

_NO_VALUE: Final = "its data is missing"
_VARIABLE_LENGTH: Final = 1
_LARGEST_RECORD: Final = 1 << 16
_LARGEST_BLOCK: Final = 1 << 26
_MOST_BLOCKS: Final = 200_000
_MOST_LINKS: Final = 1 << 16
_LINK_COUNTS: Final = {"HD": (6,), "DG": (4,), "CG": (6, 7), "CN": range(8, 1000)}
_HEADER: Final = struct.Struct("<4sIQQ")
_DATA_KINDS: Final = ("DT", "DV", "SD", "DZ", "DL", "HL")
_FLAGS_AT, _LEFT_TO_ASAMMDF = 60, 0b1100001
"""Flags of what is unfinished in a file; of these, asammdf is left to count the records."""

_SOURCE_BUS, _BUS_CAN = 2, 2
_COMPRESSION_DEFLATE: Final = 1
_TOOL: Final = "opc4-sil"


def import_asammdf(path: str) -> Any:
    """Return the module asammdf. Raises InputError that names the extra if it is missing."""
    asammdf = import_extra("asammdf", "mdf", f"{path}: MF4")
    logging.getLogger("asammdf").setLevel(logging.CRITICAL)
    asammdf.set_global_option("raise_on_incomplete_blocks", False)
    asammdf.blocks.mdf_v4.MDF4.__del__ = _close_quietly
    return asammdf


def _close_quietly(measurement: Any) -> None:
    """Close a collected measurement; asammdf's own way fails on one that could not be opened."""
    with contextlib.suppress(AttributeError):
        measurement.close()


class _Broken(Exception):
    """The block structure is broken at a byte."""

    def __init__(self, byte: int, reason: str) -> None:
        super().__init__(reason)
        self.location = Location(reason, byte=byte)


class _Block(NamedTuple):
    """A block: its kind without ##, its links, and its bytes after them."""

    kind: str
    address: int
    links: tuple[int, ...]
    body: bytes

    def unpack(self, layout: str) -> tuple[int, ...]:
        """Return the first fields of the body. Raises _Broken if it is too short."""
        if len(self.body) < struct.calcsize(layout):
            raise _Broken(self.address, f"{self.kind} block of {len(self.body)} bytes is short")
        return struct.unpack_from(layout, self.body)

    def link(self, index: int) -> int:
        """Return a link, 0 if there is none at this index."""
        return self.links[index] if index < len(self.links) else 0


class _Structure:
    """The blocks of a file that asammdf follows: links, sizes, and where the file is cut off.

    data_bytes: bytes of records by data group. resized: address and available length of each data
    block that is longer than the file, or whose length an unfinished file does not state yet.
    cut_at: the byte of the first one that is longer than the file.
    """

    def __init__(self, file: BinaryIO, open_end: bool) -> None:
        self._file = file
        self._size = file.seek(0, 2)
        self._open_end = open_end
        self._blocks: set[int] = set()
        self.data_bytes: list[int] = []
        self.resized: list[tuple[int, int]] = []
        self.cut_at: int | None = None

    def check(self) -> None:
        """Follow the links from the header. Raises _Broken at the first fault."""
        header = self._block(64, "HD")
        if header.link(5):
            self._block(header.link(5), "MD", "TX")
        for kind, index in (("FH", 1), ("AT", 3), ("EV", 4)):
            for _ in self._chain(header.link(index), kind):
                pass
        for data_group in self._chain(header.link(0), "DG"):
            (id_size,) = data_group.unpack("<B")
            groups = list(self._chain(data_group.link(1), "CG"))
            if id_size not in (0, 1, 2, 4, 8) or (len(groups) > 1 and not id_size):
                raise _Broken(data_group.address, f"record numbers of {id_size} bytes")
            for group in groups:
                _, _, flags, _, _, size, invalid = group.unpack("<QQHHIII")
                values_only = flags & 1 and not group.link(1)  # values of variable length
                if size + invalid > _LARGEST_RECORD and not values_only:
                    raise _Broken(group.address, f"records of {size + invalid} bytes")
                self._channels(group.link(1), size, 0)
            self.data_bytes.append(self._data(data_group.link(2)))

    def _head(self, address: int) -> tuple[str, int, int]:
        """Return kind, length and number of links of the block at `address`."""
        if not 64 <= address <= self._size - _HEADER.size:
            raise _Broken(min(address, self._size), "a link leads out of the file")
        self._file.seek(address)
        mark, _, length, links = _HEADER.unpack(self._file.read(_HEADER.size))
        if mark[:2] != b"##":
            raise _Broken(address, "no block where a link leads")
        return printable(mark[2:].decode("latin-1")), length, links

    def _claim(self, address: int, kind: str) -> None:
        """Note that a block was reached; each one belongs to one other."""
        if address in self._blocks:
            raise _Broken(address, f"the {kind} block is linked twice")
        self._blocks.add(address)
        if len(self._blocks) > _MOST_BLOCKS:
            raise _Broken(address, f"more than {_MOST_BLOCKS} blocks")

    def _block(self, address: int, *kinds: str) -> _Block:
        kind, length, count = self._head(address)
        if kind not in kinds:
            raise _Broken(address, f"a {kind} block where a {kinds[0]} is expected")
        self._claim(address, kind)
        sound = count in _LINK_COUNTS.get(kind, range(_MOST_LINKS))
        if not sound or not _HEADER.size + 8 * count <= length <= _LARGEST_BLOCK:
            raise _Broken(address, f"{kind} block of {length} bytes with {count} links")
        content = self._file.read(length - _HEADER.size)
        if len(content) < length - _HEADER.size:
            raise _Broken(address, f"the file ends inside a {kind} block")
        return _Block(
            kind, address, struct.unpack_from(f"<{count}Q", content), content[8 * count :]
        )

    def _chain(self, address: int, kind: str) -> Iterator[_Block]:
        """Yield blocks that are linked one to the next by their first link."""
        while address:
            block = self._block(address, kind)
            yield block
            address = block.link(0)

    def _channels(self, address: int, record_size: int, depth: int) -> None:
        for channel in self._chain(address, "CN"):
            kind, _, _, bit, byte, bits = channel.unpack("<BBBBII")
            outside = byte + (bit + bits + 7) // 8 > record_size
            if outside and kind not in (3, 6):  # virtual channels have no bytes
                raise _Broken(channel.address, "a channel is outside of its record")
            if channel.link(1) and self._head(channel.link(1))[0] == "CN" and depth < 4:
                self._channels(channel.link(1), record_size, depth + 1)
            if kind == 1 and channel.link(5) and self._head(channel.link(5))[0] != "CG":
                self._data(channel.link(5))

    def _data(self, address: int) -> int:
        """Check the data under a link and return its bytes."""
        if not address:
            return 0
        kind, length, _ = self._head(address)
        if kind not in _DATA_KINDS:
            raise _Broken(address, f"a {kind} block where data is expected")
        if kind == "HL":
            return self._data(self._block(address, "HL").link(0))
        if kind == "DL":
            links = [link for block in self._chain(address, "DL") for link in block.links[1:]]
            return sum(map(self._data, links))
        self._claim(address, kind)
        available = self._size - address
        if length > available or (self._open_end and length <= _HEADER.size):
            if length > available and self.cut_at is None:
                self.cut_at = address
            self.resized.append((address, available))
            length = available
        if kind != "DZ":
            return max(length - _HEADER.size, 0)
        fields = self._file.read(24)
        if len(fields) < 24:
            raise _Broken(address, "the file ends inside a DZ block")
        _, method, _, columns, size, packed = struct.unpack("<2sBBIQQ", fields)
        if method > 1 or (method == 1 and not columns):
            raise _Broken(address, f"packing method {method}, which is not deflate")
        if max(size, packed) > _LARGEST_BLOCK or (packed > length - 48 and self.cut_at is None):
            raise _Broken(address, f"DZ block of {size} bytes, {packed} packed")
        return int(size)


def _copy(source: ByteSource | BinaryIO) -> BinaryIO:
    """Return a temporary file with the content of a file."""
    copy: BinaryIO = tempfile.TemporaryFile()  # noqa: SIM115 closed by the caller
    if isinstance(source, ByteSource):
        while block := source.read(1 << 20):
            copy.write(block)
    else:
        source.seek(0)
        shutil.copyfileobj(source, copy, 1 << 20)
    return copy


class _Stream(NamedTuple):
    """A channel group of CAN frames: its number, kind, and the channel of each part of a frame.

    whole: the channel of all parts together, if there is one and no part is of variable length.
    """

    group: int
    kind: str
    parts: dict[str, int]
    whole: int | None


class Mf4File:
    """An MF4 file, open in asammdf; closes and removes what it needed on the way.

    Raises InputError if the file is no MF4 or its structure is damaged.
    """

    def __init__(self, source: ByteSource, report: LogReport) -> None:
        self.report = report
        asammdf = import_asammdf(report.path)
        head = source.head
        if not head.startswith((b"MDF     4.", b"UnFinMF 4.")):
            version = printable(head[8:16].decode("latin-1").strip("\x00 "))
            raise InputError(f"{report.path}: MDF version {version!r}; expected MDF 4")
        flags = head[_FLAGS_AT] if len(head) > _FLAGS_AT else 0
        self.open_end = head.startswith(b"UnFin") or flags > 0
        with contextlib.ExitStack() as stack:
            file = stack.enter_context(self._opened(source))
            structure = _Structure(file, self.open_end)
            try:
                structure.check()
            except _Broken as broken:
                raise InputError(
                    f"{report.path}: {broken.location}; expected a whole MF4"
                ) from None
            if structure.cut_at is not None:
                report.cut(Location("the file ends inside a data block", byte=structure.cut_at))
                if file is source.file:
                    file = stack.enter_context(_copy(file))
            for address, length in structure.resized:
                file.seek(address + 8)
                file.write(length.to_bytes(8, "little"))
            if self.open_end:
                file.seek(_FLAGS_AT)
                file.write(bytes((flags & _LEFT_TO_ASAMMDF, 0)))
            self.cut = structure.cut_at is not None
            self._data_bytes = structure.data_bytes
            self._file = file
            with self.guard():
                file.seek(0)
                self.mdf: Any = asammdf.MDF(file, process_bus_logging=False)
                stack.callback(self.mdf.close)
                self.mdf.configure(read_fragment_size=_FRAGMENT_BYTES)
            self._stack = stack.pop_all()

    def _opened(self, source: ByteSource) -> BinaryIO:
        """Return the file itself, or a copy if it is packed or asammdf will write to it."""
        if source.packed:
            return _copy(source)
        return _copy(source.file) if self.open_end else source.file

    @contextlib.contextmanager
    def guard(self) -> Iterator[None]:
        """Turn whatever asammdf raises on a damaged file into InputError, and hide its prints."""
        try:
            with contextlib.redirect_stdout(io.StringIO()):
                yield
        except (InputError, GeneratorExit):
            raise
        except Exception as error:
            reason = printable(f"{type(error).__name__}: {error}".split("\n")[0][:120])
            raise InputError(
                f"{self.report.path}: asammdf cannot read it ({reason}); expected a whole MF4"
            ) from None

    def tables(self, stream: _Stream) -> Iterator[tuple[dict[str, NDArray[Any]], NDArray[Any]]]:
        """Yield the columns of a group by part of a frame, and the times; `_ROWS` rows at a time.

        Columns are [n] or [n, bytes], times [n] in s from the start of the file.
        """
        indices = list(stream.parts.values()) if stream.whole is None else [stream.whole]
        for signals in zip(*(self.fragments(stream.group, i) for i in indices), strict=True):
            times_s = signals[0].timestamps
            for begin in range(0, len(times_s), _ROWS):
                rows = slice(begin, begin + _ROWS)
                if stream.whole is None:
                    columns = [signal.samples[rows] for signal in signals]
                else:
                    samples = signals[0].samples[rows]
                    columns = [samples[f"{stream.kind}.{part}"] for part in stream.parts]
                yield dict(zip(stream.parts, columns, strict=True)), times_s[rows]

    def fragments(self, group: int, channel: int) -> Iterator[Any]:
        """Yield a channel as asammdf's signals, some thousand samples at a time."""
        signals = self.mdf.iter_get(group=group, index=channel)
        while True:
            with self.guard():
                signal = next(signals, None)
            if signal is None:
                return
            yield signal

    def close(self) -> None:
        """Close the file."""
        self._stack.close()

    def streams(self) -> list[_Stream]:
        """Return the groups of CAN frames; other groups go to the report."""
        found = []
        for number, group in enumerate(self.mdf.groups):
            names = [channel.name for channel in group.channels]
            kind = next((kind for kind in _FRAME_KINDS if kind in names), None)
            if kind is not None:
                split = [name.rpartition(".") for name in names]
                parts = {part: i for i, (owner, _, part) in enumerate(split) if owner == kind}
                variable = any(c.channel_type == _VARIABLE_LENGTH for c in group.channels)
                structured = group.channel_dependencies[names.index(kind)] and not variable
                whole = names.index(kind) if structured else None
                found.append(_Stream(number, kind, parts, whole))
            elif names and group.channel_group.cycles_nr:
                bus = names[-1].split(".")[0]
                known = bus.split("_")[0].upper() in _OTHER_BUSES
                name = bus.replace("_", " ") if known else "record of decoded signals"
                self.report.other[name] += group.channel_group.cycles_nr
        return found

    def signal_groups(self) -> list[int]:
        """Return the groups with samples; none if there are CAN frame groups."""
        if self.streams():
            return []
        groups = enumerate(self.mdf.groups)
        return [n for n, group in groups if group.channels and group.channel_group.cycles_nr]

    def report_rest(self) -> None:
        """Report bytes at the end of an unfinished file that are no whole record.

        Only for a file with one data group, which is how loggers write it.
        """
        if len(self._data_bytes) != 1:
            return
        used = 0
        for group in self.mdf.groups:
            id_size = group.data_group.record_id_len
            count = group.channel_group.cycles_nr
            size = group.channel_group.samples_byte_nr + group.channel_group.invalidation_bytes_nr
            if group.channels:
                used += count * (size + id_size)
            for index in range(len(group.channels)):
                if group.signal_data[index]:
                    used += stored_bytes(group, index) + count * id_size
        rest = self._data_bytes[0] - used
        if rest > 0:
            self._file.seek(-rest, os.SEEK_END)
            if self._file.read(rest).strip(b"\x00"):
                size = self._file.seek(0, os.SEEK_END)
                self.report.cut(Location("the data ends inside a record", byte=size - rest))
            else:
                self.report.note("zero bytes after the last record")


def stored_bytes(group: Any, index: int) -> int:
    """Return the bytes of a channel's values of variable length, their lengths included."""
    return sum(block.original_size for block in group.get_signal_data_blocks(index))


class Mf4Reader:
    """State of one reading."""

    def __init__(self, report: LogReport) -> None:
        self._report = report
        self._start_ns = 0

    def read(self, source: ByteSource) -> Iterator[Batch]:
        """Yield the frames in batches, those of all groups merged by time.

        Raises InputError if the file cannot be read or holds decoded signals only.
        """
        report = self._report
        file = Mf4File(source, report)
        try:
            header = file.mdf.header
            if file.open_end:
                report.note("the logger did not finish this file; read as far as it goes")
            if header.time_flags & 1:
                report.note("the start is a local time of an unknown zone, taken as UTC")
            if header.abs_time >= 2**63:
                raise InputError(f"{report.path}: byte 64: a start time out of range; expected MF4")
            self._start_ns = header.abs_time
            report.start_ns = header.abs_time or None
            report.time_base = time_base(header.abs_time)
            streams = file.streams()
            if not streams:
                self._refuse_signals(file)
            if file.open_end:
                file.report_rest()
            yield from self._batches([self._frames(file, stream) for stream in streams])
        finally:
            file.close()

    def _refuse_signals(self, file: Mf4File) -> None:
        """Refuse a file of decoded signals; an empty one is noted. Raises InputError."""
        report = self._report
        groups = file.signal_groups()
        if groups:
            channels = [c.name for g in groups for c in file.mdf.groups[g].channels]
            names = [name for name in channels if name.lower() not in ("t", "time")][:4]
            raise InputError(
                f"{report.path}: holds decoded signals only ({printable(', '.join(names))}, ...; "
                f"groups: {len(groups)}), no CAN frames; expected a log of CAN_DataFrame groups"
            )
        report.note("no CAN frame groups in it")

    def _batches(self, streams: Sequence[Iterator[LogFrame]]) -> Iterator[Batch]:
        merged = heapq.merge(*streams, key=itemgetter(0)) if len(streams) > 1 else None
        frames_of_all = merged or (streams[0] if streams else iter(()))
        number = 1
        frames: list[LogFrame] = []
        for frame in frames_of_all:
            frames.append(frame)
            if len(frames) >= _ROWS:
                yield Batch(frames, range(number, number + len(frames)))
                number += len(frames)
                frames = []
        if frames:
            yield Batch(frames, range(number, number + len(frames)))

    def _frames(self, file: Mf4File, stream: _Stream) -> Iterator[LogFrame]:
        """Yield the frames of one group."""
        report, kind = self._report, stream.kind
        group = file.mdf.groups[stream.group]
        missing = "an ID" if "ID" not in stream.parts and kind != "CAN_ErrorFrame" else None
        if stream.group not in file.mdf.masters_db:
            missing = "a time"
        if missing:
            address = group.channel_group.address
            report.skip(Location(f"{kind} without {missing}", byte=address))
            return
        expected, count = group.channel_group.cycles_nr, 0
        values = _Values(file, group, stream.parts.get("DataBytes"))
        for columns, times_s in file.tables(stream) if expected else ():
            with file.guard():
                rows = _rows(kind, columns, times_s, values, self._start_ns)
            for frame, problem in rows:
                count += 1
                if problem == _NO_VALUE and (file.cut or file.open_end):
                    report.cut(Location(f"{kind} record {count}: {problem}"))
                    return
                problem = problem or frame_problem(frame)
                if problem is None:
                    yield frame
                else:
                    report.skip(Location(f"{kind} record {count}: {problem}"))
        if count < expected:
            report.cut(Location(f"{kind} record {count + 1} is missing"))


class _Values:
    """Data of variable length: the values at the offsets that records give.

    asammdf's own extraction reads outside of its memory if an offset is damaged.
    """

    def __init__(self, file: Mf4File, group: Any, index: int | None) -> None:
        """index: the channel of the data in the group, None if there is none."""
        self._file = file
        self._group = group
        self._index = index
        self.used = False
        if index is not None and group.channels[index].channel_type == _VARIABLE_LENGTH:
            self.used = True
            group.channels[index].channel_type = 0  # the offsets, as plain numbers
            self._size = stored_bytes(group, index)

    def at(self, offsets: Sequence[int]) -> list[bytes | None]:
        """Return the values at offsets in bytes, None where there is no whole one."""
        inside = [offset for offset in offsets if 0 <= offset <= self._size - 4]
        if not inside:
            return [None] * len(offsets)
        first = min(inside)
        span = first, max(inside)
        stored = self._file.mdf._mdf._load_signal_data(self._group, self._index, offsets=span)
        found: list[bytes | None] = []
        for offset in offsets:
            begin = offset - first + 4
            length = int.from_bytes(stored[begin - 4 : begin], "little") if begin >= 4 else -1
            value = stored[begin : begin + length] if 0 <= length <= _LARGEST_RECORD else b""
            found.append(value if len(value) == length else None)
        return found


def _numbers(column: NDArray[Any] | None) -> list[int] | None:
    """Return a column as whole numbers, None if there is none."""
    import numpy as np

    if column is None:
        return None
    if column.dtype.kind in "SUO":
        words = [w.decode("latin-1") if isinstance(w, bytes) else str(w) for w in column.tolist()]
        return [_TEXT_FLAGS.get(word.strip("\x00 ").lower(), 0) for word in words]
    if column.dtype.kind == "f":
        column = np.where(np.abs(column) < 2.0**62, column, -1.0)  # also what is not a number
    return list(column.astype(np.int64).tolist())


def _rows(
    kind: str,
    columns: dict[str, NDArray[Any]],
    times_s: NDArray[np.float64],
    values: _Values,
    start_ns: int,
) -> list[tuple[LogFrame, str | None]]:
    """Return frames, and what is wrong with each.

    columns: [n] or [n, bytes] by part of a frame; times_s: [n] in s from the start of the file.
    """
    import numpy as np

    times_s = np.where(np.abs(times_s) < MAX_TIME_NS / 1e9, times_s, np.nan)
    seconds = np.floor(times_s)
    parts_ns = np.rint((times_s - seconds) * 1e9)
    numbers = {part: _numbers(column) for part, column in columns.items() if part != "DataBytes"}
    none = [0] * len(times_s)
    words, dlc, fd, brs, esi = (numbers.get(p) or none for p in ("ID", "DLC", "EDL", "BRS", "ESI"))
    way, channel, ide = numbers.get("Dir"), numbers.get("BusChannel"), numbers.get("IDE")
    lengths = numbers.get("DataLength")
    error, remote = kind == "CAN_ErrorFrame", kind == "CAN_RemoteFrame"
    data = _data(None if remote else columns.get("DataBytes"), len(times_s), values)
    found: list[tuple[LogFrame, str | None]] = []
    for i, (second, part_ns) in enumerate(zip(seconds.tolist(), parts_ns.tolist(), strict=True)):
        problem = None if part_ns == part_ns else "a time that is no number"
        time_ns = 0 if problem else int(second) * NS_PER_S + int(part_ns)
        is_fd, code, content = bool(fd[i]), dlc[i] & 15, data[i]
        coded = DLC_LENGTHS[code] if is_fd else min(code, 8)
        length = 0 if remote else coded if lengths is None else lengths[i]
        if content is None:
            problem, content = problem or _NO_VALUE, b""
        elif len(content) < length and not error:
            problem = problem or f"{len(content)} bytes of data; expected {length}"
        can_id = words[i] & MAX_EXTENDED_ID
        extended = ide[i] if ide is not None else words[i] >> 31 or can_id > MAX_STANDARD_ID
        frame = LogFrame(
            start_ns + time_ns,
            can_id,
            content[: max(length, 0)],
            bool(extended),
            remote,
            error,
            is_fd,
            bool(brs[i]),
            bool(esi[i]),
            "" if channel is None else str(channel[i]),
            "" if way is None else "Tx" if way[i] else "Rx",
            code if remote or (not is_fd and code > 8 and length == 8) else 0,
        )
        found.append((frame, problem))
    return found


def _data(column: NDArray[Any] | None, count: int, values: _Values) -> Sequence[bytes | None]:
    """Return the data bytes of each row."""
    import numpy as np

    if column is None:
        return [b""] * count
    if values.used:
        return values.at(column.tolist())
    if column.ndim != 2:
        return [b""] * count
    width, content = column.shape[1], np.ascontiguousarray(column).tobytes()
    return [content[i : i + width] for i in range(0, count * width, width)]


class SignalTable:
    """The one table of signals in an MF4 file; `rows` yields time in s and values.

    Raises InputError for a file of several tables, and for signals that are no plain numbers.
    """

    def __init__(self, path: str) -> None:
        self._path = path
        report = LogReport(path, "mf4", strict=True)
        self._source = ByteSource(path, report)
        try:
            self._file = Mf4File(self._source, report)
            self._open()
        except BaseException:
            self._source.close()
            raise

    def _open(self) -> None:
        groups = self._file.signal_groups()
        if len(groups) != 1:
            raise InputError(
                f"{self._path}: signals in {len(groups)} groups with times of their own; expected "
                "one group, which is one table"
            )
        (self._group,) = groups
        group = self._file.mdf.groups[self._group]
        master = self._file.mdf.masters_db.get(self._group)
        if master is None or group.channel_group.invalidation_bytes_nr:
            raise InputError(
                f"{self._path}: samples without a time, or that can be marked invalid; expected "
                "a table of numbers over time"
            )
        self._channels = [i for i in range(len(group.channels)) if i != master]
        self.names = tuple(group.channels[i].name for i in self._channels)
        self.units = tuple(group.channels[i].unit for i in self._channels)
        for name in self.names:
            if "," in name or '"' in name or not name.isprintable():
                raise InputError(
                    f"{self._path}: signal {printable(name[:60])}: a comma, quote or control "
                    "character in its name; expected a name that a CSV can hold"
                )
        next(self._pieces(), None)  # refuses signals that are no numbers
        self._expected = group.channel_group.cycles_nr

    def _pieces(self) -> Iterator[list[NDArray[Any]]]:
        """Yield times and values, [n] each, some thousand samples at a time."""
        streams = [self._file.fragments(self._group, index) for index in self._channels]
        for signals in zip(*streams, strict=True):
            for name, signal in zip(self.names, signals, strict=True):
                if signal.samples.ndim != 1 or signal.samples.dtype.kind not in "iufb":
                    raise InputError(
                        f"{self._path}: signal {printable(name[:60])}: no plain numbers; expected "
                        "a table of them"
                    )
            yield [signals[0].timestamps, *(signal.samples for signal in signals)]

    def rows(self) -> Iterator[tuple[float, ...]]:
        """Yield time in s and values of each sample. Raises InputError if samples are missing."""
        count = 0
        for columns in self._pieces():
            count += len(columns[0])
            yield from zip(*(column.tolist() for column in columns), strict=True)
        if count < self._expected:
            raise InputError(f"{self._path}: sample {count + 1} is missing; expected a whole MF4")

    def close(self) -> None:
        """Close the file."""
        self._file.close()
        self._source.close()


def holds_signals_only(path: str) -> bool:
    """Return whether a file is an MF4 with decoded signals and without CAN frames.

    A broken file is none: whoever reads it names what is wrong.
    """
    report = LogReport(path, "mf4")
    source = ByteSource(path, report)
    try:
        if source.packed or not source.head.startswith((b"MDF     4.", b"UnFinMF 4.")):
            return False
        file = Mf4File(source, report)
        found = bool(file.signal_groups())
        file.close()
        return found
    except InputError:
        return False
    finally:
        source.close()


def new_measurement(path: str, start_ns: int) -> Any:
    """Return an empty MDF 4.10 measurement that starts at `start_ns` (0: relative times).

    Nothing in it depends on the wall clock. Raises InputError if asammdf is missing.
    """
    asammdf = import_asammdf(path)
    from asammdf.blocks.v4_blocks import FileHistory

    measurement = asammdf.MDF(version="4.10")
    history = FileHistory()
    history.comment = (
        f"<FHcomment><TX>written</TX><tool_id>{_TOOL}</tool_id><tool_vendor>{_TOOL}</tool_vendor>"
        "<tool_version>1</tool_version></FHcomment>"
    )
    measurement.file_history.append(history)
    for block in (measurement.header, history):
        block.abs_time = start_ns
        block.tz_offset = block.daylight_save_time = block.time_flags = 0
    return measurement


class Mf4Writer(LogWriter):
    """Writes groups of data, CAN FD, error and remote frames in the ASAM bus logging layout."""

    format = "mf4"
    patched = True
    batch = 1 << 14

    def __init__(self, path: str) -> None:
        import_asammdf(path)
        super().__init__(path)
        self._measurement: Any = None
        self._origin_ns = 0
        self._groups: dict[str, int] = {}

    def _begin(self, frames: list[LogFrame]) -> None:
        first_ns = min((frame.time_ns for frame in frames), default=0)
        if first_ns >= RELATIVE_BELOW_NS:
            self._origin_ns = first_ns // NS_PER_MS * NS_PER_MS
        self._measurement = new_measurement(self.path, self._origin_ns)

    def _write_batch(self, frames: list[LogFrame]) -> None:
        if self._measurement is None:
            self._begin(frames)
        kinds: dict[str, list[LogFrame]] = {}
        for frame in frames:
            kinds.setdefault(_kind(frame), []).append(frame)
        for kind, share in kinds.items():
            self._extend(kind, share)

    def _extend(self, kind: str, frames: list[LogFrame]) -> None:
        """Append frames of one kind to their group, which the first of them makes."""
        import numpy as np

        name, data_bytes = _LAYOUT[kind]
        rows = np.zeros(len(frames), dtype=_columns(name, data_bytes))
        rows[f"{name}.BusChannel"] = [self.channel_number(f.channel, 0) for f in frames]
        rows[f"{name}.ID"] = [frame.can_id for frame in frames]
        rows[f"{name}.IDE"] = [frame.extended for frame in frames]
        rows[f"{name}.DLC"] = [frame.dlc for frame in frames]
        rows[f"{name}.Dir"] = [frame.direction == "Tx" for frame in frames]
        rows[f"{name}.EDL"] = [frame.fd for frame in frames]
        rows[f"{name}.BRS"] = [frame.brs for frame in frames]
        rows[f"{name}.ESI"] = [frame.esi for frame in frames]
        if data_bytes:
            padded = b"".join([frame.data.ljust(data_bytes, b"\x00") for frame in frames])
            rows[f"{name}.DataBytes"] = np.frombuffer(padded, np.uint8).reshape(-1, data_bytes)
            rows[f"{name}.DataLength"] = [len(frame.data) for frame in frames]
        self._count_losses(frames)
        times_ns = np.array([frame.time_ns - self._origin_ns for frame in frames], dtype=np.int64)
        # Integer seconds and the rest apart: one rounding, to the double nearest to the decimal.
        seconds = times_ns // 10**9 + (times_ns % 10**9) / 1e9
        group = self._groups.get(kind)
        if group is None:
            self._groups[kind] = len(self._groups)
            self._append(name, rows, seconds)
        else:
            self._measurement.extend(group, [(seconds, None), (rows, None)])

    def _append(self, name: str, rows: NDArray[Any], seconds: NDArray[np.float64]) -> None:
        from asammdf import Signal
        from asammdf.blocks.source_utils import Source

        source = Source("CAN", "CAN", "", _SOURCE_BUS, _BUS_CAN)
        signal = Signal(name=name, samples=rows, timestamps=seconds, source=source)
        self._measurement.append(signal, acq_name=name, acq_source=source)

    def _count_losses(self, frames: list[LogFrame]) -> None:
        for frame in frames:
            if not frame.direction:
                self.losses["direction not recorded, written as Rx"] += 1
            if abs(frame.time_ns - self._origin_ns) > _EXACT_SPAN_NS:
                self.losses["times more than 46 days from the start, rounded"] += 1
            if frame.error and frame.remote:
                self.losses["remote flag of an error frame"] += 1

    def _finish(self) -> None:
        import numpy as np

        if self._measurement is None:
            self._begin([])
        if not self._groups:
            rows = np.zeros(0, dtype=_columns(*_LAYOUT["classic"]))
            self._append("CAN_DataFrame", rows, np.zeros(0))
        try:
            self._measurement.save(
                self._file, compression=_COMPRESSION_DEFLATE, add_history_block=False
            )
        finally:
            self._measurement.close()

    def abort(self) -> None:
        """Throw away what was written."""
        if self._measurement is not None:
            self._measurement.close()
        super().abort()


_LAYOUT: Final = {
    "classic": ("CAN_DataFrame", 8),
    "fd": ("CAN_DataFrame", 64),
    "error": ("CAN_ErrorFrame", 64),
    "remote": ("CAN_RemoteFrame", 0),
}


def _kind(frame: LogFrame) -> str:
    if frame.error:
        return "error"
    if frame.remote:
        return "remote"
    return "fd" if frame.fd else "classic"


def _columns(name: str, data_bytes: int) -> Any:
    import numpy as np

    fields: list[Any] = [
        (f"{name}.BusChannel", "<u1"),
        (f"{name}.ID", "<u4"),
        (f"{name}.IDE", "<u1"),
        (f"{name}.DLC", "<u1"),
        (f"{name}.Dir", "<u1"),
        (f"{name}.EDL", "<u1"),
        (f"{name}.BRS", "<u1"),
        (f"{name}.ESI", "<u1"),
    ]
    if data_bytes:
        fields += [(f"{name}.DataLength", "<u1"), (f"{name}.DataBytes", "<u1", (data_bytes,))]
    return np.dtype(fields)


def _recognise(head: bytes) -> bool:
    return head.startswith((b"MDF     ", b"UnFinMF "))


def _read(source: ByteSource, report: LogReport, times: str) -> Iterator[Batch]:
    return Mf4Reader(report).read(source)


FORMAT: Final = Format("mf4", (".mf4", ".mdf"), _recognise, _read, Mf4Writer, "frame")

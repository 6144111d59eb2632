"""MF4 (ASAM MDF 4) through asammdf: logs of CAN frames.

asammdf is optional (the extra `mdf`) and slow to import: it is imported when an MF4 is read or
written.
"""

from __future__ import annotations

import contextlib
import heapq
import io
import logging
import os
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from itertools import islice
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
from sil.logs.mf4_blocks import LARGEST_RECORD, VARIABLE_LENGTH, Blocks
from sil.logs.mf4_writer import Mf4Writer
from sil.logs.report import Location, LogReport, printable
from sil.logs.source import ByteSource

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

_FRAME_KINDS: Final = ("CAN_DataFrame", "CAN_ErrorFrame", "CAN_RemoteFrame")
_OTHER_BUSES: Final = ("LIN", "FLEXRAY", "ETH", "MOST", "K-LINE", "CAN")
_TRUE_TEXTS: Final = ("tx", "true", "yes")
_ROWS: Final = 2048
"""Rows that become frames at once."""

_FRAGMENT_BYTES: Final = 1 << 18
"""Bytes of records that asammdf takes from the file at once."""

_NO_VALUE: Final = "its data is missing"
_FLAGS_AT, _LEFT_TO_ASAMMDF = 60, 0b1100001
"""Flags of what is unfinished in a file; of these, asammdf is left to count the records."""

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


def _copy(source: ByteSource) -> BinaryIO:
    """Return a temporary file with the unpacked content of a file."""
    copy: BinaryIO = tempfile.TemporaryFile()  # noqa: SIM115 closed by the caller
    if source.packed:
        while block := source.read(1 << 20):
            copy.write(block)
    else:
        source.file.seek(0)
        shutil.copyfileobj(source.file, copy, 1 << 20)
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
    """An MF4 file, open in asammdf; as a context manager it closes what it opened.

    Raises InputError if the file is no MF4 or its structure is damaged.
    """

    def __init__(self, source: ByteSource, report: LogReport) -> None:
        self.report = report
        asammdf = import_asammdf(report.path)
        head = source.head
        if not is_mf4(head):
            version = printable(head[8:16].decode("latin-1").strip("\x00 "))
            raise InputError(f"{report.path}: MDF version {version!r}; expected MDF 4")
        flags = head[_FLAGS_AT] if len(head) > _FLAGS_AT else 0
        self.open_end = head.startswith(b"UnFin") or flags > 0
        with contextlib.ExitStack() as stack:
            file = source.file
            if source.packed or self.open_end:
                file = stack.enter_context(_copy(source))
            blocks = Blocks(report.path, file, self.open_end)
            self.cut = blocks.cut_at is not None
            self.lost = blocks.lost
            if self.cut:
                report.cut(Location("the data ends or its list is broken", byte=blocks.cut_at))
            elif self.lost and report.strict:
                report.skip(Location("a damaged data block", byte=self.lost[0][0]))
            if (self.cut or blocks.patches) and file is source.file:
                file = stack.enter_context(_copy(source))
            for address, content in blocks.patches:
                file.seek(address)
                file.write(content)
            for address, length in blocks.resized:
                file.seek(address + 8)
                file.write(length.to_bytes(8, "little"))
            if self.open_end:
                file.seek(_FLAGS_AT)
                file.write(bytes((flags & _LEFT_TO_ASAMMDF, 0)))
            self._record_bytes = blocks.record_bytes
            self._file = file
            with self.guard():
                file.seek(0)
                self.mdf: Any = asammdf.MDF(file, process_bus_logging=False)
                stack.callback(self.mdf.close)
                self.mdf.configure(read_fragment_size=_FRAGMENT_BYTES)
            self._stack = stack.pop_all()

    def __enter__(self) -> Mf4File:
        return self

    def __exit__(self, *error: object) -> None:
        self._stack.close()

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

    def streams(self) -> list[_Stream]:
        """Return the groups of CAN frames; other groups go to the report."""
        found = []
        for number, group in enumerate(self.mdf.groups):
            names = [channel.name for channel in group.channels]
            kind = next((kind for kind in _FRAME_KINDS if kind in names), None)
            if kind is not None:
                split = [name.rpartition(".") for name in names]
                parts = {part: i for i, (owner, _, part) in enumerate(split) if owner == kind}
                variable = any(c.channel_type == VARIABLE_LENGTH for c in group.channels)
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

    def tables(self, stream: _Stream) -> Iterator[tuple[dict[str, NDArray[Any]], NDArray[Any]]]:
        """Yield the columns of a group by part of a frame, and the times; `_ROWS` rows at a time.

        Columns are [n] or [n, bytes], times [n] in s from the start of the file.
        """
        indices = list(stream.parts.values()) if stream.whole is None else [stream.whole]
        channels = [self.mdf.iter_get(group=stream.group, index=i) for i in indices]
        while True:
            with self.guard():
                signals: list[Any] = [next(channel, None) for channel in channels]
            if any(signal is None for signal in signals):
                return
            for begin in range(0, len(signals[0].timestamps), _ROWS):
                rows = slice(begin, begin + _ROWS)
                if stream.whole is None:
                    columns = [signal.samples[rows] for signal in signals]
                else:
                    samples = signals[0].samples[rows]
                    columns = [samples[f"{stream.kind}.{part}"] for part in stream.parts]
                yield dict(zip(stream.parts, columns, strict=True)), signals[0].timestamps[rows]

    def report_rest(self) -> None:
        """Report bytes at the end of an unfinished file that are no whole record.

        Only for a file with one data group, which is how loggers write it.
        """
        if len({group.data_group.address for group in self.mdf.groups}) != 1:
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
                    used += _stored_bytes(group, index) + count * id_size
        rest = self._record_bytes - used
        if rest > 0:
            size = self._file.seek(0, os.SEEK_END)
            self._file.seek(-rest, os.SEEK_END)
            if self._file.read(rest).strip(b"\x00"):
                self.report.cut(Location("the data ends inside a record", byte=size - rest))
            else:
                self.report.note("zero bytes after the last record")


def _stored_bytes(group: Any, index: int) -> int:
    """Return the bytes of a channel's values of variable length, their lengths included."""
    return sum(block.original_size for block in group.get_signal_data_blocks(index))


class _Values:
    """Data of variable length: the values at the offsets that records give.

    asammdf's own extraction reads outside of its memory if an offset is damaged.
    """

    def __init__(self, file: Mf4File, group: Any, index: int | None) -> None:
        """index: the channel of the data in the group, None if there is none."""
        self._file, self._group, self._index = file, group, index
        self.used = False
        if index is not None and group.channels[index].channel_type == VARIABLE_LENGTH:
            self.used = True
            group.channels[index].channel_type = 0  # the offsets, as plain numbers
            self._size = _stored_bytes(group, index)

    def at(self, offsets: Sequence[int]) -> list[bytes | None]:
        """Return the values at offsets in bytes, None where there is no whole one."""
        inside = [offset for offset in offsets if 0 <= offset <= self._size - 4]
        if not inside:
            return [None] * len(offsets)
        first = min(inside)
        with self._file.guard():
            stored = self._file.mdf._mdf._load_signal_data(
                self._group, self._index, offsets=(first, max(inside))
            )
        found: list[bytes | None] = []
        for offset in offsets:
            begin = offset - first + 4
            length = int.from_bytes(stored[begin - 4 : begin], "little") if begin >= 4 else -1
            value = stored[begin : begin + length] if 0 <= length <= LARGEST_RECORD else b""
            found.append(value if len(value) == length else None)
        return found


def _read(source: ByteSource, report: LogReport, times: str) -> Iterator[Batch]:
    """Yield the frames in batches, those of all groups merged by time.

    Raises InputError if the file cannot be read or holds decoded signals only.
    """
    with Mf4File(source, report) as file:
        header = file.mdf.header
        if file.open_end:
            report.note("the logger did not finish this file; read as far as it goes")
        if header.time_flags & 1:
            report.note("the start is a local time of an unknown zone, taken as UTC")
        if header.abs_time >= 2**63:
            raise InputError(f"{report.path}: byte 64: a start time out of range; expected MF4")
        report.start_ns = header.abs_time or None
        report.time_base = time_base(header.abs_time)
        streams = file.streams()
        if not streams:
            _refuse_signals(file)
        if file.open_end:
            file.report_rest()
        ordered = all("Order" in stream.parts for stream in streams)
        groups = [_frames(file, stream, ordered) for stream in streams]
        merged = map(itemgetter(1), heapq.merge(*groups, key=itemgetter(0)))
        number = 1
        total = sum(file.mdf.groups[stream.group].channel_group.cycles_nr for stream in streams)
        while frames := list(islice(merged, _ROWS)):
            yield Batch(frames, range(number, number + len(frames)))
            number += len(frames)
            source.share = min(number / (total + 1), 1.0)


def _refuse_signals(file: Mf4File) -> None:
    """Refuse a file of decoded signals; an empty one is noted. Raises InputError."""
    groups = file.signal_groups()
    if groups:
        channels = [c.name for g in groups for c in file.mdf.groups[g].channels]
        names = [name for name in channels if name.lower() not in ("t", "time")][:4]
        raise InputError(
            f"{file.report.path}: holds decoded signals only ({printable(', '.join(names))}, ...; "
            f"groups: {len(groups)}), no CAN frames; expected a log of CAN_DataFrame groups"
        )
    file.report.note("no CAN frame groups in it")


def _frames(file: Mf4File, stream: _Stream, ordered: bool) -> Iterator[tuple[int, LogFrame]]:
    """Yield the frames of one group, each with its number in the log if `ordered`, else its time."""
    report, kind = file.report, stream.kind
    group = file.mdf.groups[stream.group]
    missing = "an ID" if "ID" not in stream.parts and kind != "CAN_ErrorFrame" else None
    if stream.group not in file.mdf.masters_db:
        missing = "a time"
    if missing:
        address = group.channel_group.address
        report.skip(Location(f"{kind} without {missing}", byte=address))
        return
    expected, count, lost = group.channel_group.cycles_nr, 0, 0
    values = _Values(file, group, stream.parts.get("DataBytes"))
    for columns, times_s in file.tables(stream) if expected else ():
        rows = _rows(kind, columns, times_s, values, file.mdf.header.abs_time)
        order = _numbers(columns["Order"], len(times_s)).tolist() if ordered else None
        zeros = _zero_rows(columns, times_s) if file.lost else None
        for index, (frame, problem) in enumerate(rows):
            count += 1
            if zeros is not None and zeros[index]:
                lost += 1
                continue
            if problem == _NO_VALUE and (file.cut or file.open_end):
                report.cut(Location(f"{kind} record {count}: {problem}"))
                return
            problem = problem or frame_problem(frame)
            if problem is None:
                yield (order[index] if order else frame.time_ns), frame
            else:
                report.skip(Location(f"{kind} record {count}: {problem}"))
    if file.cut and (missing := lost + expected - count):
        report.note(f"{missing} {kind} records are missing in all")
    elif lost:
        text = f"{lost} {kind} records in damaged blocks left out"
        report.skip(Location(text, byte=file.lost[0][0]), lost)
    if count < expected:
        report.cut(
            Location(f"{kind} record {count + 1} and {expected - count - 1} more are missing")
        )


def _zero_rows(columns: dict[str, NDArray[Any]], times_s: NDArray[np.float64]) -> list[bool]:
    """Return of which rows nothing but zeros is there: they were in a block that is lost."""
    import numpy as np

    empty = times_s == 0
    for column in columns.values():
        if column.dtype.kind in "iu":
            empty &= ~np.any(column.reshape(len(times_s), -1), axis=1)
    found: list[bool] = empty.tolist()
    return found


def _rows(
    kind: str,
    columns: dict[str, NDArray[Any]],
    times_s: NDArray[np.float64],
    values: _Values,
    start_ns: int,
) -> Iterator[tuple[LogFrame, str | None]]:
    """Yield frames, and what is wrong with each.

    columns: [n] or [n, bytes] by part of a frame; times_s: [n] in s from the start of the file.
    """
    import numpy as np

    count = len(times_s)
    error, remote = kind == "CAN_ErrorFrame", kind == "CAN_RemoteFrame"
    valid = np.abs(times_s) < MAX_TIME_NS / 1e9
    seconds = np.floor(np.where(valid, times_s, 0.0))
    parts_ns = np.rint((np.where(valid, times_s, 0.0) - seconds) * 1e9)
    times_ns = seconds.astype(np.int64) * 10**9 + parts_ns.astype(np.int64)
    flags = {name: _numbers(columns.get(name), count) != 0 for name in ("EDL", "BRS", "ESI", "Dir")}
    code, word = _numbers(columns.get("DLC"), count) & 15, _numbers(columns.get("ID"), count)
    fd, can_id = flags["EDL"], word & MAX_EXTENDED_ID
    extended = (word >> 31 != 0) | (can_id > MAX_STANDARD_ID)
    if "IDE" in columns:
        extended = _numbers(columns["IDE"], count) != 0
    length = np.where(fd, np.array(DLC_LENGTHS)[code], np.minimum(code, 8))
    if "DataLength" in columns:
        length = np.maximum(_numbers(columns["DataLength"], count), 0)
    if remote:
        length = np.zeros(count, np.int64)
    raw_dlc = np.where(remote | (~fd & (code > 8) & (length == 8)), code, 0)
    data = _data(None if remote else columns.get("DataBytes"), count, values)
    channel = [""] * count
    if "BusChannel" in columns:
        channel = list(map(str, _numbers(columns["BusChannel"], count).tolist()))
    way = np.where(flags["Dir"], "Tx", "Rx" if "Dir" in columns else "").tolist()
    arrays = (times_ns, can_id, extended, fd, flags["BRS"], flags["ESI"], raw_dlc, length, valid)
    for time_ns, number, long, is_fd, brs, esi, raw, wanted, timed, content, name, direction in zip(
        *(array.tolist() for array in arrays), data, channel, way, strict=True
    ):
        problem = None if timed else "a time that is no number"
        if content is None:
            problem, content = problem or _NO_VALUE, b""
        elif len(content) < wanted and not error:
            problem = problem or f"{len(content)} bytes of data; expected {wanted}"
        flags_and_names = long, remote, error, is_fd, brs, esi, name, direction, raw
        yield LogFrame(start_ns + time_ns, number, content[:wanted], *flags_and_names), problem


def _numbers(column: NDArray[Any] | None, count: int) -> NDArray[np.int64]:
    """Return a column [n] as whole numbers, zeros if there is none."""
    import numpy as np

    if column is None:
        return np.zeros(count, np.int64)
    if column.dtype.kind in "SUO":
        words = [w.decode("latin-1") if isinstance(w, bytes) else str(w) for w in column.tolist()]
        return np.array([word.strip("\x00 ").lower() in _TRUE_TEXTS for word in words], np.int64)
    if column.dtype.kind == "f":
        column = np.where(np.abs(column) < 2.0**62, column, -1.0)  # also what is not a number
    return column.astype(np.int64)


def _data(column: NDArray[Any] | None, count: int, values: _Values) -> Sequence[bytes | None]:
    """Return the data bytes of each row."""
    import numpy as np

    if column is not None and values.used:
        return values.at(column.tolist())
    if column is None or column.ndim != 2:
        return [b""] * count
    width, content = column.shape[1], np.ascontiguousarray(column).tobytes()
    return [content[i : i + width] for i in range(0, count * width, width)]


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


def save(measurement: Any, file: BinaryIO) -> None:
    """Write a measurement, compressed."""
    measurement.save(file, compression=_COMPRESSION_DEFLATE, add_history_block=False)


def is_mf4(head: bytes) -> bool:
    """Return whether a file that begins with these bytes is of MDF version 4."""
    return head.startswith((b"MDF     4.", b"UnFinMF 4."))


def _recognise(head: bytes) -> bool:
    return head.startswith((b"MDF     ", b"UnFinMF "))


FORMAT: Final = Format("mf4", (".mf4", ".mdf"), _recognise, _read, Mf4Writer, "frame")

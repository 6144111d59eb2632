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
from collections.abc import Iterator
from itertools import islice
from operator import itemgetter
from typing import TYPE_CHECKING, Any, BinaryIO, Final, NamedTuple

from can_dbc.errors import InputError
from sil.files.extras import import_extra
from sil.files.quantity import counted
from sil.logs.format import Batch, Format, time_base
from sil.logs.frame import LogFrame, frame_problem
from sil.logs.mf4_blocks import VARIABLE_LENGTH, Blocks
from sil.logs.mf4_columns import NO_VALUE, Values, frames_of, numbers, stored_bytes, zero_rows
from sil.logs.mf4_writer import Mf4Writer
from sil.logs.report import Location, LogReport, printable
from sil.logs.source import ByteSource

if TYPE_CHECKING:
    from numpy.typing import NDArray

_FRAME_KINDS: Final = ("CAN_DataFrame", "CAN_ErrorFrame", "CAN_RemoteFrame")
_OTHER_BUSES: Final = ("LIN", "FLEXRAY", "ETH", "MOST", "K-LINE", "CAN")
_ROWS: Final = 2048
"""Rows that become frames at once."""

_FRAGMENT_BYTES: Final = 1 << 18
"""Bytes of records that asammdf takes from the file at once."""

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
            what = f"MDF version {version!r}" if _recognise(head) else "byte 0: no MDF header"
            raise InputError(f"{report.path}: {what}; expected MDF 4")
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
                    used += stored_bytes(group, index) + count * id_size
        rest = self._record_bytes - used
        if rest > 0:
            size = self._file.seek(0, os.SEEK_END)
            self._file.seek(-rest, os.SEEK_END)
            if self._file.read(rest).strip(b"\x00"):
                self.report.cut(Location("the data ends inside a record", byte=size - rest))
            else:
                self.report.note("zero bytes after the last record")


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
    values = Values(file.mdf, file.guard, group, stream.parts.get("DataBytes"))
    for columns, times_s in file.tables(stream) if expected else ():
        rows = frames_of(kind, columns, times_s, values, file.mdf.header.abs_time)
        order = numbers(columns["Order"], len(times_s)).tolist() if ordered else None
        zeros = zero_rows(columns, times_s) if file.lost else None
        for index, (frame, problem) in enumerate(rows):
            count += 1
            if zeros is not None and zeros[index]:
                lost += 1
                continue
            if problem == NO_VALUE and (file.cut or file.open_end):
                report.cut(Location(f"{kind} record {count}: {problem}"))
                return
            problem = problem or frame_problem(frame)
            if problem is None:
                yield (order[index] if order else frame.time_ns), frame
            else:
                report.skip(Location(f"{kind} record {count}: {problem}"))
    if file.cut and (missing := lost + expected - count):
        report.note(f"{counted(missing, f'{kind} record')} missing in all")
    elif lost:
        text = f"{counted(lost, f'{kind} record')} in damaged blocks left out"
        report.skip(Location(text, byte=file.lost[0][0]), lost)
    if count < expected:
        report.cut(Location(f"{count} of {counted(expected, f'{kind} record')}"))


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

"""MF4 (ASAM MDF 4, bus logging) by the library asammdf.

asammdf is optional (the extra `mdf`) and slow to import: it is imported when an MF4 is read or
written. A measurement is in memory as a whole. What asammdf cannot read is refused with the number
of frames reached.
"""

from __future__ import annotations

import contextlib
import io
import logging
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, BinaryIO, Final

from can_dbc.errors import InputError
from can_dbc.frame import MAX_ID
from sil.files.extras import import_extra
from sil.logs.format import Batch, time_base
from sil.logs.frame import DLC_LENGTHS, MAX_STANDARD_ID, MAX_TIME_NS, LogFrame, frame_problem
from sil.logs.report import Location, LogReport, printable
from sil.logs.source import ByteSource
from sil.logs.writer import LogWriter

if TYPE_CHECKING:
    from numpy.typing import NDArray

KINDS: Final = ("CAN_DataFrame", "CAN_ErrorFrame", "CAN_RemoteFrame")


def import_asammdf(path: str) -> Any:
    """Return the module asammdf. Raises InputError that names the extra if it is missing."""
    asammdf = import_extra("asammdf", "mdf", f"{path}: MF4")
    logging.getLogger("asammdf").setLevel(logging.CRITICAL)
    from asammdf.blocks.mdf_v4 import MDF4

    if "__del__" in vars(MDF4):  # it fails for a file that could not be opened; ours are closed
        del MDF4.__del__
    return asammdf


def new_measurement(path: str, start_ns: int) -> Any:
    """Return an empty MDF 4.10 measurement from `start_ns` (0: relative times), whatever the wall clock shows.

    Raises InputError if asammdf is missing.
    """
    asammdf = import_asammdf(path)
    from asammdf.blocks.v4_blocks import FileHistory

    measurement = asammdf.MDF(version="4.10")
    history = FileHistory()
    history.comment = (
        "<FHcomment><TX>written</TX><tool_id>opc4-sil</tool_id><tool_vendor>opc4-sil</tool_vendor>"
        "<tool_version>1</tool_version></FHcomment>"
    )
    measurement.file_history.append(history)
    for block in (measurement.header, history):
        block.abs_time = start_ns
        block.tz_offset = block.daylight_save_time = block.time_flags = 0
    return measurement


def save(measurement: Any, file: BinaryIO) -> None:
    """Write a measurement, compressed."""
    content = io.BytesIO()  # the library asks a file for its name, which a temporary one has not
    measurement.save(content, compression=1, add_history_block=False)
    file.write(content.getvalue())


def is_mf4(head: bytes) -> bool:
    """Return whether a file that begins with these bytes is of MDF version 4."""
    return head.startswith((b"MDF     4.", b"UnFinMF 4."))


class Mf4File:
    """An MF4 file, open in asammdf; as a context manager it closes what it opened.

    Raises InputError if asammdf cannot open it.
    """

    def __init__(self, source: ByteSource, report: LogReport) -> None:
        self.report = report
        self.frames = 0
        asammdf = import_asammdf(report.path)
        if not is_mf4(source.head):
            version = printable(source.head[8:16].decode("latin-1").strip("\x00 "))
            is_mdf = recognise(source.head)
            what = f"MDF version {version!r}" if is_mdf else "byte 0: no MDF header"
            raise InputError(f"{report.path}: {what}; expected MDF 4")
        content = bytearray()
        while block := source.read(1 << 20):
            content += block
        with self.guard():
            self.mdf: Any = asammdf.MDF(io.BytesIO(content), process_bus_logging=False)
            for group in self.mdf.groups:
                size = group.channel_group.samples_byte_nr
                if size > len(content) or (group.channel_group.cycles_nr and not size):
                    raise ValueError(f"records of {size} bytes")

    def __enter__(self) -> Mf4File:
        return self

    def __exit__(self, *error: object) -> None:
        self.mdf.close()

    @contextlib.contextmanager
    def guard(self) -> Iterator[None]:
        """Turn whatever asammdf raises on a damaged file into InputError, and hide its prints."""
        try:
            with contextlib.redirect_stdout(io.StringIO()):
                yield
        except Exception as error:
            reason = printable(f"{type(error).__name__}: {error}".split("\n")[0][:120])
            raise InputError(
                f"{self.report.path}: asammdf cannot read on after {self.frames} frames ({reason}); "
                "expected a whole MF4"
            ) from None

    def frame_groups(self) -> list[tuple[int, str]]:
        """Return number and kind of the groups of CAN frames; others go to the report."""
        groups = []
        for number, group in enumerate(self.mdf.groups):
            names = [channel.name for channel in group.channels]
            kind = next((kind for kind in KINDS if kind in names), None)
            if kind is not None:
                groups.append((number, kind))
            elif names and group.channel_group.cycles_nr:
                bus = names[-1].split(".")[0].split("_")[0].upper()
                is_bus = bus in ("LIN", "FLEXRAY", "ETH", "MOST", "K-LINE", "CAN")
                name = names[-1].split(".")[0].replace("_", " ")
                name = name if is_bus else "record of decoded signals"
                self.report.other[name] += group.channel_group.cycles_nr
        return groups

    def signal_groups(self) -> list[int]:
        """Return the groups with samples; none if there are CAN frame groups."""
        if self.frame_groups():
            return []
        groups = enumerate(self.mdf.groups)
        return [n for n, group in groups if group.channels and group.channel_group.cycles_nr]

    def columns(self, number: int, kind: str) -> tuple[dict[str, NDArray[Any]], NDArray[Any]]:
        """Return the columns of a group by part of a frame, [n] or [n, bytes], and the times [n] in s.

        Raises InputError for a group that cannot be read (ValueError within the guard).
        """
        group = self.mdf.groups[number]
        parts = {
            name.rpartition(".")[2]: index
            for index, name in enumerate(channel.name for channel in group.channels)
            if name.startswith(f"{kind}.")
        }
        with self.guard():
            if number not in self.mdf.masters_db:
                raise ValueError(f"{kind} without a time")
            if "ID" not in parts and kind != "CAN_ErrorFrame":
                raise ValueError(f"{kind} without an ID")
            columns = {
                part: self.mdf.get(group=number, index=index).samples
                for part, index in parts.items()
            }
            return columns, self.mdf.get_master(number)


def read(source: ByteSource, report: LogReport, times: str) -> Iterator[Batch]:
    """Yield the frames in batches, those of all groups merged by `Order`, or else by time.

    Raises InputError if the file cannot be read or holds decoded signals only.
    """
    with Mf4File(source, report) as file:
        header = file.mdf.header
        if source.head.startswith(b"UnFinMF "):
            report.note("the logger did not finish this file; read as far as it goes")
        if header.time_flags & 1:
            report.note("the start is a local time of an unknown zone, taken as UTC")
        if header.abs_time >= MAX_TIME_NS:
            raise InputError(f"{report.path}: byte 64: a start time out of range; expected MF4")
        report.start_ns = header.abs_time or None
        report.time_base = time_base(header.abs_time)
        groups = file.frame_groups()
        if not groups:
            _refuse_signals(file)
        frames: list[tuple[float, LogFrame]] = []
        ordered = True
        for number, kind in groups:
            stated = file.mdf.groups[number].channel_group.cycles_nr
            if not stated:
                continue
            columns, times_s = file.columns(number, kind)
            ordered = ordered and "Order" in columns
            order = columns["Order"] if ordered else times_s
            group_frames = _frames(kind, columns, times_s, header.abs_time)
            frames += zip(order.tolist(), group_frames, strict=True)
            file.frames = len(frames)
            if len(times_s) < stated:
                report.cut(Location(f"{len(times_s)} of {stated} {kind} records"))
        frames.sort(key=lambda pair: pair[0] if ordered else pair[1].time_ns)
        for begin in range(0, len(frames), LogWriter.batch):
            possible, numbers = [], []
            for index, (_, frame) in enumerate(frames[begin : begin + LogWriter.batch], begin + 1):
                if problem := frame_problem(frame):
                    report.skip(Location(f"frame {index}: {problem}"))
                else:
                    possible.append(frame)
                    numbers.append(index)
            if possible:
                yield Batch(possible, numbers)


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


def _frames(
    kind: str, columns: dict[str, NDArray[Any]], times_s: NDArray[Any], start_ns: int
) -> Iterator[LogFrame]:
    """Yield the frames of a group. columns: [n] or [n, bytes]; times_s: [n], from the file's start."""
    import numpy as np

    count = len(times_s)

    def numbers(part: str) -> NDArray[Any]:
        column = columns.get(part)
        if column is None:
            return np.zeros(count, np.int64)
        if column.dtype.kind in "SUO":  # some loggers write "Tx" and "Rx"
            words = [w.decode("latin-1") if isinstance(w, bytes) else str(w) for w in column]
            return np.array([w.strip("\0 ").lower() in ("tx", "true", "yes") for w in words], int)
        return column.astype(np.int64)

    seconds = np.floor(times_s)
    times_ns = seconds.astype(np.int64) * 10**9
    times_ns += np.rint((times_s - seconds) * 1e9).astype(np.int64)
    error, remote = kind == "CAN_ErrorFrame", kind == "CAN_RemoteFrame"
    code, word, fd = numbers("DLC") & 15, numbers("ID"), numbers("EDL") != 0
    can_id = word & MAX_ID
    extended = (word >> 31 != 0) | (can_id > MAX_STANDARD_ID)
    if "IDE" in columns:
        extended = numbers("IDE") != 0
    length = np.where(fd, np.array(DLC_LENGTHS)[code], np.minimum(code, 8))
    if "DataLength" in columns:
        length = numbers("DataLength")
    if remote:
        length = np.zeros(count, np.int64)
    raw_dlc = np.where(remote | (~fd & (code > 8) & (length == 8)), code, 0)
    data = columns.get("DataBytes")
    width, content = 0, b""
    if data is not None and data.ndim == 2 and not remote:
        width, content = data.shape[1], np.ascontiguousarray(data, np.uint8).tobytes()
    channel = numbers("BusChannel").tolist() if "BusChannel" in columns else [""] * count
    direction = np.where(numbers("Dir"), "Tx", "Rx" if "Dir" in columns else "").tolist()
    arrays = (times_ns, can_id, extended, fd, numbers("BRS") != 0, numbers("ESI") != 0, raw_dlc)
    rows = zip(
        *(array.tolist() for array in arrays), length.tolist(), channel, direction, strict=True
    )
    for index, row in enumerate(rows):
        time_ns, number, is_extended, is_fd, brs, esi, raw, size, name, way = row
        payload = content[index * width : index * width + min(size, width)]
        flags = is_extended, remote, error, is_fd, brs, esi
        yield LogFrame(start_ns + time_ns, number, payload, *flags, str(name), way, raw)


class Mf4Writer(LogWriter):
    """Writes a group for each kind of frames; the part `Order` keeps their common order."""

    format = "mf4"

    def __init__(self, path: str) -> None:
        import_asammdf(path)
        super().__init__(path)
        self._frames: list[LogFrame] = []

    def _write_batch(self, frames: list[LogFrame]) -> None:
        self._frames += frames

    def _finish(self) -> None:
        from asammdf import Signal, Source

        groups: dict[str, list[int]] = {}
        for index, frame in enumerate(self._frames):
            kind = KINDS[1] if frame.error else KINDS[2] if frame.remote else KINDS[0]
            groups.setdefault(kind, []).append(index)
        measurement = new_measurement(self.path, self.start_ns)
        bus = Source(name="CAN", path="CAN", comment="", source_type=2, bus_type=2)
        for kind, order in groups.items():
            samples, times_s = self._columns(kind, order)
            signal = Signal(samples, times_s, name=kind, source=bus)
            measurement.append([signal], acq_name=kind, acq_source=bus, common_timebase=True)
            measurement.groups[-1].channel_group.flags |= 0b110  # a bus event, in plain form
        save(measurement, self._out)
        measurement.close()

    def _columns(self, kind: str, order: list[int]) -> tuple[NDArray[Any], NDArray[Any]]:
        """Return the records [n] of the frames of one kind, and their times [n] in s from the start."""
        import numpy as np

        frames = [self._frames[index] for index in order]
        offsets_ns = np.array([frame.time_ns - self.start_ns for frame in frames], np.int64)
        parts: dict[str, Any] = {
            "BusChannel": [self.channel_number(frame.channel, 0) for frame in frames],
            "ID": [frame.can_id for frame in frames],
            "IDE": [frame.extended for frame in frames],
            "DLC": [frame.dlc for frame in frames],
            "Dir": [frame.direction == "Tx" for frame in frames],
            "EDL": [frame.fd for frame in frames],
            "BRS": [frame.brs for frame in frames],
            "ESI": [frame.esi for frame in frames],
            "Order": order,
        }
        wide = dict.fromkeys(("ID", "Order"), "<u4")
        fields: list[Any] = [(f"{kind}.{part}", wide.get(part, "<u1")) for part in parts]
        if kind != "CAN_RemoteFrame":
            width = max(8, *(len(frame.data) for frame in frames))
            padded = b"".join(frame.data.ljust(width, b"\0") for frame in frames)
            parts["DataLength"] = [len(frame.data) for frame in frames]
            parts["DataBytes"] = np.frombuffer(padded, np.uint8).reshape(-1, width)
            fields += [(f"{kind}.DataLength", "<u1"), (f"{kind}.DataBytes", "<u1", (width,))]
        rows = np.zeros(len(frames), fields)
        for part, column in parts.items():
            rows[f"{kind}.{part}"] = column
        exact_ns = 4_000_000 * 10**9  # up to here seconds in a double are exact to the ns
        for frame in frames:
            self.direction(frame)
            is_far = abs(frame.time_ns - self.start_ns) > exact_ns
            self.lose(is_far, "times more than 46 days from the start, rounded")
            self.lose(frame.error and frame.remote, "remote flag of an error frame")
        # whole seconds and the rest apart: one rounding, to the double nearest to the decimal
        return rows, offsets_ns // 10**9 + (offsets_ns % 10**9) / 1e9


def recognise(head: bytes) -> bool:
    """Return whether a file begins as an MDF file, finished or not."""
    return head.startswith((b"MDF     ", b"UnFinMF "))

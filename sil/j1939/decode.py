"""Signals of a log by a database (DBC), to a table: CSV or parquet with a row per value, or MF4.

A frame is decoded by its identifier; a J1939 message by its parameter group, whoever sends it, long
ones put together. What a sender reports as not available (all bits set, SAE J1939-71) is left out.
"""

from __future__ import annotations

import copy
import csv
import io
import os
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import islice
from typing import TYPE_CHECKING, Any, BinaryIO, Final, NamedTuple, Unpack

from can_dbc.dbc import load_dbc
from can_dbc.errors import InputError
from can_dbc.frame import split_id
from sil.files.extras import import_extra
from sil.files.quantity import counted
from sil.j1939.mapping import ANY_SOURCE
from sil.j1939.transport import PGN_CONTROL, PGN_DATA, Assembler
from sil.logs.frame import LogFrame
from sil.logs.merged import Reading, open_logs
from sil.logs.mf4 import import_asammdf, new_measurement, save
from sil.logs.report import LogReport
from sil.logs.times import NS_PER_MS, RELATIVE_BELOW_NS, format_ns
from sil.logs.traces import written
from sil.logs.writer import packer

if TYPE_CHECKING:
    from cantools.database import Database
    from cantools.database.can import Message, Signal

COLUMNS: Final = ("time_s", "channel", "message", "source", "signal", "value", "unit", "text")


class Field(NamedTuple):
    """A signal under a name that no other one of its message has; `alone`: a message of only it."""

    name: str
    signal: Signal
    alone: Message | None = None


class MessageLayout:
    """Decodes a message: as a whole, or each signal alone if signals overlap or leave the message.

    problems: what is wrong with it, and which signals are therefore not decoded.
    """

    def __init__(self, message: Message) -> None:
        from cantools.database import Error

        self.message = message
        self.problems: list[str] = []
        try:
            message.refresh(strict=True)
            self.fields = [Field(signal.name, signal) for signal in message.signals]
            return
        except Error as error:
            self.problems.append(f"{' '.join(str(error).split())} Each is decoded alone")
        self.fields = []
        for signal in message.signals:
            name = signal.name
            if name in (one.name for one in self.fields):
                name = f"{name} (bit {signal.start})"
                self.problems.append(
                    f"a second signal {signal.name} of {message.name}: as {name!r}"
                )
            try:
                self.fields.append(Field(name, signal, _alone(message, signal)))
            except Error:
                self.problems.append(
                    f"signal {name} of {message.name} is not decoded: it leaves the message's "
                    f"{message.length} bytes"
                )

    def decode(self, data: bytes) -> dict[str, Any]:
        """Return the raw values in a frame by name; those that it is too short for are missing.

        Raises DecodeError, and others that cantools does not declare.
        """
        how: dict[str, Any] = {"decode_choices": False, "scaling": False, "allow_truncated": True}
        if not self.problems:
            return dict(self.message.decode(data, **how))
        raw: dict[str, Any] = {}
        for name, _, alone in self.fields:
            assert alone is not None
            for value in alone.decode(data, **how).values():
                raw[name] = value
        return {f.name: raw[f.name] for f in self.fields if f.name in raw and _sent(f.signal, raw)}


def _alone(message: Message, signal: Signal) -> Message:
    """Return a message of one signal. Raises cantools' Error if that does not fit into it."""
    plain = copy.copy(signal)
    plain.multiplexer_ids, plain.multiplexer_signal = None, None
    plain.is_multiplexer = False
    how = {"is_extended_frame": message.is_extended_frame, "strict": True}
    return type(message)(message.frame_id, message.name, message.length, [plain], **how)


def _sent(signal: Signal, raw: Mapping[str, Any]) -> bool:
    """Return whether a multiplexed signal is in a frame with these raw values."""
    ids = signal.multiplexer_ids
    return not ids or raw.get(signal.multiplexer_signal) in ids


def is_unavailable(signal: Signal, raw: Any) -> bool:
    """Return whether a J1939 sender has no value: all bits set (SAE J1939-71).

    The standard defines it for states of two bits and for numbers from four bits on; flags of one bit
    and what the database names are values.
    """
    wide_enough = signal.length == 2 or signal.length >= 4
    named = signal.choices is not None and raw in signal.choices
    return wide_enough and not named and raw == (1 << signal.length) - 1


class Decoded(NamedTuple):
    """The signals of one message: physical values by name; `source` of a J1939 message, else None."""

    time_ns: int
    channel: str
    message: Message
    source: int | None
    layout: MessageLayout
    values: dict[str, float | int]


@dataclass
class DecodeReport:
    """What was decoded, and what was not.

    unknown: frames of identifiers that the database does not have; broken: frames that cannot be
    decoded; short: frames that lack signals of their message; unavailable: values that the sender does
    not have, by signal; problems: of the database.
    """

    source: str
    target: str
    database: str
    read: LogReport
    messages: Counter[str] = field(default_factory=Counter)
    values: int = 0
    broken: Counter[str] = field(default_factory=Counter)
    short: Counter[str] = field(default_factory=Counter)
    unavailable: Counter[str] = field(default_factory=Counter)
    problems: list[str] = field(default_factory=list)
    unknown: Counter[str] = field(default_factory=Counter)
    transport: Assembler = field(default_factory=Assembler)

    def as_dict(self) -> dict[str, Any]:
        """Return all of it as plain JSON values."""
        values = {name: value for name, value in vars(self).items() if name != "transport"}
        return values | {
            "long_messages": self.transport.assembled,
            "long_messages_lost": self.transport.lost,
            "read": self.read.as_dict(),
        }

    def lines(self) -> list[str]:
        """Return the report as text, one fact per line."""
        lines = [
            f"{self.target}: {counted(self.values, 'value')} of {counted(self.messages.total(), 'message')} "
            f"({', '.join(f'{n} {name}' for name, n in self.messages.most_common())})"
        ]
        lines += [f"{self.database}: {problem}" for problem in self.problems]
        lines += [f"not decoded: {n} {name}" for name, n in self.broken.items()]
        lines += [f"too short: {n} {name}" for name, n in self.short.items()]
        if self.unavailable:
            names = ", ".join(f"{name} ({n})" for name, n in self.unavailable.most_common())
            lines.append(f"not available, left out: {self.unavailable.total()} values: {names}")
        if self.unknown:
            shown = ", ".join(f"{name} ({n})" for name, n in self.unknown.most_common(5))
            more = ", ..." if len(self.unknown) > 5 else ""
            lines.append(
                f"not in {self.database}: {self.unknown.total()} frames of {len(self.unknown)} "
                f"identifiers: {shown}{more}"
            )
        lines += self.transport.lines()
        return [*lines, f"{self.source}:", *(f"  {line}" for line in self.read.lines())]


class Decoder:
    """Decodes frames, one after the other, by the messages of a database."""

    def __init__(self, database: Database, report: DecodeReport) -> None:
        self._report = report
        specifics = database.dbc.attributes if database.dbc is not None else {}
        j1939 = "ProtocolType" in specifics and str(specifics["ProtocolType"].value) == "J1939"
        self._exact: dict[tuple[int, bool], Message] = {}
        self._groups: dict[int, Message] = {}
        self._layouts: dict[str, MessageLayout] = {}
        for message in database.messages:
            can_id, extended = message.frame_id, message.is_extended_frame
            self._exact[can_id, extended] = message
            by_group = j1939 or message.protocol == "j1939" or can_id & 0xFF == ANY_SOURCE
            if extended and by_group:
                self._groups[split_id(can_id).pgn] = message

    def decode(self, frame: LogFrame) -> Decoded | None:
        """Return the signals of a frame, or of the long message that it completes."""
        if frame.error or frame.remote:
            return None
        data = frame.data
        message = self._exact.get((frame.can_id, frame.extended))
        source = pgn = None
        if frame.extended:
            parts = split_id(frame.can_id)
            if parts.pgn in (PGN_CONTROL, PGN_DATA) and message is None:
                whole = self._report.transport.take(frame)
                if whole is None:
                    return None
                pgn, source, data = whole.pgn, whole.source, whole.data
            elif parts.pgn in self._groups:
                pgn, source = parts.pgn, parts.source
        if pgn is not None:
            message = self._groups.get(pgn)
        if message is None:
            name = f"{frame.can_id:0{8 if frame.extended else 3}X}" if pgn is None else f"PGN {pgn}"
            room = len(self._report.unknown) < 100_000 or name in self._report.unknown
            self._report.unknown[name if room else "others"] += 1
            return None
        return self._signals(message, frame, source, data)

    def _signals(
        self, message: Message, frame: LogFrame, source: int | None, data: bytes
    ) -> Decoded | None:
        report = self._report
        layout = self._layouts.get(message.name)
        if layout is None:
            layout = self._layouts[message.name] = MessageLayout(message)
            report.problems += layout.problems
        try:
            raw = layout.decode(data)
        except Exception:  # cantools declares none; a multiplexer without such a branch
            report.broken[f"{message.name} of {len(data)} bytes"] += 1
            return None
        if len(data) < message.length:
            name = f"{message.name} of {len(data)} bytes in place of {message.length}"
            report.short[name] += 1
        values: dict[str, float | int] = {}
        for one in layout.fields:
            if one.name not in raw:
                continue
            if source is not None and is_unavailable(one.signal, raw[one.name]):
                report.unavailable[f"{message.name}.{one.name}"] += 1
                continue
            values[one.name] = one.signal.conversion.raw_to_scaled(raw[one.name], False)
        report.messages[message.name] += 1
        report.values += len(values)
        return Decoded(frame.time_ns, frame.channel, message, source, layout, values)


_Take = Callable[[Sequence[Decoded]], None]
"""Writes a batch of decoded messages into a table, in order."""


def _rows(
    batch: Sequence[Decoded],
) -> Iterator[tuple[int, str, str, int | None, str, float | int, str, str]]:
    for time_ns, channel, message, source, layout, values in batch:
        for name, signal, _ in layout.fields:
            if (value := values.get(name)) is None:
                continue
            choices = signal.choices or {}
            text = str(choices.get(int(value), "")) if value == int(value) else ""
            yield time_ns, channel, message.name, source, name, value, signal.unit or "", text


@contextmanager
def _csv(path: str, file: BinaryIO) -> Iterator[_Take]:
    out = packer(file) if path.endswith(".gz") else file
    text = io.TextIOWrapper(out, "utf-8", newline="", write_through=True)
    table = csv.writer(text, lineterminator="\n")
    table.writerow(COLUMNS)
    yield lambda batch: table.writerows((format_ns(row[0], 9), *row[1:]) for row in _rows(batch))
    text.detach()
    if out is not file:
        out.close()


@contextmanager
def _parquet(path: str, file: BinaryIO) -> Iterator[_Take]:
    arrow = import_extra("pyarrow", "lab", f"{path}: parquet")
    import_extra("pyarrow.parquet", "lab", f"{path}: parquet")
    text = arrow.dictionary(arrow.int32(), arrow.string())
    kinds = (arrow.int64(), text, text, arrow.int16(), text, arrow.float64(), text, text)
    schema = arrow.schema(list(zip(("time_ns", *COLUMNS[1:]), kinds, strict=True)))
    with arrow.parquet.ParquetWriter(file, schema) as writer:

        def take(batch: Sequence[Decoded]) -> None:
            rows = ((*row[:5], float(row[5]), *row[6:]) for row in _rows(batch))
            columns = list(zip(*rows, strict=True)) or [()] * len(COLUMNS)
            arrays = [arrow.array(c, kind) for c, kind in zip(columns, kinds, strict=True)]
            writer.write_table(arrow.Table.from_arrays(arrays, schema=schema))

        yield take


@contextmanager
def _mf4(path: str, file: BinaryIO) -> Iterator[_Take]:
    """Make a group for each message, sender and channel; a missing value is not a number."""
    import numpy as np

    asammdf = import_asammdf(path)
    measurement: Any = None
    start_ns = 0
    groups: dict[tuple[str, int | None, str], int] = {}

    def take(batch: Sequence[Decoded]) -> None:
        nonlocal measurement, start_ns
        if measurement is None:
            if (first_ns := batch[0].time_ns) >= RELATIVE_BELOW_NS:
                start_ns = first_ns // NS_PER_MS * NS_PER_MS
            measurement = new_measurement(path, start_ns)
        parts = defaultdict(list)
        for one in batch:
            parts[one.message.name, one.source, one.channel].append(one)
        for key, part in parts.items():
            times_s = np.array([one.time_ns - start_ns for one in part]) / 1e9
            fields = part[0].layout.fields
            columns = [
                np.array([float(one.values.get(f.name, np.nan)) for one in part]) for f in fields
            ]
            if key in groups:
                measurement.extend(groups[key], [(column, None) for column in (times_s, *columns)])
                continue
            name, source, channel = key
            title = name + ("" if source is None else f" of {source:#04x}")
            title += f" on {channel}" if channel else ""
            signals = []
            for (field_name, signal, _), column in zip(fields, columns, strict=True):
                texts = {"unit": signal.unit or "", "comment": signal.comment or ""}
                signals.append(asammdf.Signal(column, times_s, name=field_name, **texts))
            groups[key] = len(groups)
            measurement.append(signals, acq_name=title, comment=title, common_timebase=True)

    try:
        yield take
        save(measurement, file)
    finally:
        if measurement is not None:
            measurement.close()


def decode(
    sources: Sequence[str | os.PathLike[str]],
    target: str | os.PathLike[str],
    database: str | os.PathLike[str],
    **how: Unpack[Reading],
) -> DecodeReport:
    """Decode the signals of logs by a DBC into .csv, .csv.gz, .mf4 or .parquet, in bounded memory.

    Parameters
    ----------
    sources, **how
        As in `open_logs`.
    target
        The file to write; it appears when it is complete.
    database
        A DBC file.

    Raises
    ------
    InputError
        For what cannot be read or written, and if the log has no message of the database.
    """
    tables = {".csv": _csv, ".mf4": _mf4, ".parquet": _parquet}
    path = os.fspath(target)
    kind = os.path.splitext(path.removesuffix(".gz"))[1].lower() if path != "-" else ".csv"
    if kind not in tables or (path.endswith(".gz") and kind != ".csv"):
        raise InputError(
            f"{path}: --dbc decodes signals; expected OUT .csv, .csv.gz, .mf4 or .parquet"
        )
    log = open_logs(sources, **how)
    report = DecodeReport(log.path, path, os.fspath(database), log.report)
    decoder = Decoder(load_dbc(database, strict=False), report)
    with written(path) as file, tables[kind](path, file) as take:
        decoded = (one for frame in log if (one := decoder.decode(frame)) is not None)
        while batch := list(islice(decoded, 4096)):
            take(batch)
        report.transport.finish()
        report.read = log.report
        if not report.messages and report.broken:
            name, count = report.broken.most_common(1)[0]
            raise InputError(
                f"{log.path}: none of its {report.read.frames} frames can be decoded, {count} are {name}; "
                f"expected frames as {report.database} describes them"
            )
        if not report.messages:
            raise InputError(
                f"{log.path}: none of its {report.read.frames} frames is of a message in "
                f"{report.database}; expected a DBC of this bus"
            )
    return report

"""Tables of signals over time: trace CSV to MF4 with units, and back."""

from __future__ import annotations

import re
from array import array
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

from can_dbc.errors import InputError
from sil.files.atomic import open_atomically
from sil.files.quantity import unit_of
from sil.logs.mf4 import Mf4File, import_asammdf, is_mf4, new_measurement, save
from sil.logs.report import LogReport, printable
from sil.logs.source import ByteSource, lines
from sil.logs.writer import packer

if TYPE_CHECKING:
    from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class TraceReport:
    """A converted table: its rows, and the names and units of its signals without the time."""

    rows: int
    names: tuple[str, ...]
    units: tuple[str, ...]


def is_trace_csv(path: str) -> bool:
    """Return whether a file is a CSV of signals, time_s first. Raises InputError if it cannot be read."""
    if not path.removesuffix(".gz").lower().endswith(".csv"):
        return False
    names = _header(path)
    return names[0] == "time_s" and len(names) > 1 and "data" not in names


def _header(path: str) -> list[str]:
    source = ByteSource(path, LogReport(path, "csv"))
    source.close()
    return source.head.split(b"\n", 1)[0].decode("latin-1").strip().split(",")


def _table(path: str, names: list[str]) -> NDArray[Any]:
    """Return the rows of a trace, [rows, columns], the time first in s. Raises InputError at a broken row."""
    import numpy as np

    count, last_s = len(names), float("-inf")
    cells = array("d")
    source = ByteSource(path, LogReport(path, "csv", strict=True))
    try:
        for line in lines(source):
            text = line.text.strip()
            if line.number == 1 or not text:
                continue
            where = f"{path}: line {line.number}"
            try:
                values = [float(word or "nan") for word in text.split(",")]
            except ValueError:
                what = f"{text[:40]!r} is not numbers; expected {count}"
                raise InputError(f"{where}: {what}") from None
            if len(values) != count:
                raise InputError(f"{where}: {len(values)} columns; expected {count}")
            if not values[0] >= last_s:
                what = f"time {values[0]} s after {last_s} s; expected times that do not fall"
                raise InputError(f"{where}: {what}")
            last_s = values[0]
            cells.extend(values)
    finally:
        source.close()
    if not cells:
        raise InputError(f"{path}: no rows under the header; expected a trace")
    return np.frombuffer(cells).reshape(-1, count)


@contextmanager
def written(path: str) -> Iterator[BinaryIO]:
    """Open the new file. Raises InputError if the disk refuses."""
    try:
        with open_atomically(Path(path)) as file:
            yield file
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}; expected a file to write") from None


def trace_to_mf4(source: str, target: str) -> TraceReport:
    """Write a trace as one MF4 group, every signal with its unit.

    Raises InputError for a torn trace, a time that falls, or when asammdf is missing.
    """
    asammdf = import_asammdf(target)
    import numpy as np

    names = _header(source)
    for name in names:
        if not re.match(r"[A-Za-z_][A-Za-z0-9_.\[\]]*\Z", name) or names.count(name) > 1:
            raise InputError(
                f"{source}: line 1: column {name[:40]!r}; expected distinct names of signals"
            )
    times_s, *columns = (np.ascontiguousarray(column) for column in _table(source, names).T)
    units = [unit_of(name).replace(" ", "·") for name in names[1:]]  # as MDF tools write them: N·s
    signals = [
        asammdf.Signal(column, times_s, name=name, unit=unit)
        for name, unit, column in zip(names[1:], units, columns, strict=True)
    ]
    measurement = new_measurement(target, 0)
    try:
        measurement.append(signals, acq_name="trace", common_timebase=True)
        with written(target) as file:
            save(measurement, file)
    finally:
        measurement.close()
    return TraceReport(len(times_s), tuple(names[1:]), tuple(units))


def mf4_to_trace(source: str, target: str) -> TraceReport | None:
    """Write the signals of an MF4 file as a trace CSV (.gz packs), times from its start; None for other files.

    Raises InputError for a file of several tables, and for signals that are no plain numbers.
    """
    report = LogReport(source, "mf4", strict=True)
    with closing(ByteSource(source, report)) as opened:
        if opened.packed or not is_mf4(opened.head):
            return None
        with Mf4File(opened, report) as file:
            if not file.signal_groups():
                return None
            signals = _signals(source, file)
    names = tuple(signal.name for signal in signals)
    columns = [signals[0].timestamps, *(signal.samples for signal in signals)]
    with written(target) as file, ExitStack() as packed:
        csv = packed.enter_context(packer(file)) if target.endswith(".gz") else file
        csv.write(",".join(["time_s", *names]).encode("utf-8") + b"\n")
        for row in zip(*(column.tolist() for column in columns), strict=True):
            csv.write((",".join(map(repr, row)) + "\n").encode("ascii"))
    return TraceReport(len(columns[0]), names, tuple(signal.unit for signal in signals))


def _signals(path: str, file: Mf4File) -> list[Any]:
    """Return the signals of the one table in a file, as asammdf has them."""
    groups = file.signal_groups()
    if len(groups) != 1:
        raise InputError(
            f"{path}: signals in {len(groups)} groups with times of their own; expected "
            "one group, which is one table"
        )
    group = file.mdf.groups[groups[0]]
    master = file.mdf.masters_db.get(groups[0])
    if master is None or group.channel_group.invalidation_bytes_nr:
        raise InputError(
            f"{path}: samples without a time, or that can be marked invalid; expected "
            "a table of numbers over time"
        )
    indices = [i for i in range(len(group.channels)) if i != master]
    with file.guard():
        signals = [file.mdf.get(group=groups[0], index=i) for i in indices]
    for signal in signals:
        shown = printable(signal.name[:60])
        if "," in signal.name or '"' in signal.name or not signal.name.isprintable():
            raise InputError(
                f"{path}: signal {shown}: a comma, quote or control character in its name; "
                "expected a name that a CSV can hold"
            )
        if signal.samples.ndim != 1 or signal.samples.dtype.kind not in "iufb":
            raise InputError(f"{path}: signal {shown}: no plain numbers; expected a table of them")
        if len(signal) < group.channel_group.cycles_nr:
            raise InputError(f"{path}: sample {len(signal) + 1} is missing; expected a whole MF4")
    if not signals:
        raise InputError(f"{path}: a time without signals; expected a table of numbers over time")
    return signals

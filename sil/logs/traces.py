"""Tables of signals over time: trace CSV to MF4 with units and comments, and back."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice
from typing import Any, Final

from can_dbc.errors import InputError
from can_dbc.messages import Fault, ShiftState
from sil.logs.mf4 import SignalTable, import_asammdf, new_measurement
from sil.logs.report import LogReport
from sil.logs.source import ByteSource, lines
from sil.logs.writer import replacing

_ROWS: Final = 1 << 14
_UNITS: Final = (
    ("_rad_s", "rad/s"),
    ("_m_s", "m/s"),
    ("_n_s", "N·s"),
    ("_pa", "Pa"),
    ("_kg", "kg"),
    ("_rad", "rad"),
    ("_ns", "ns"),
    ("_m", "m"),
    ("_n", "N"),
    ("_s", "s"),
    ("_k", "K"),
    ("_j", "J"),
)
_COMMENTS: Final = {
    "position_m": "true position of the stay, 0 = neutral, + = backward (fixed rig: from its start)",
    "velocity_m_s": "true speed of the stay",
    "position_internal_m": "position as the control unit reports it: late, and held",
    "piston_1_m": "piston 1, inward from its outer stop",
    "piston_2_m": "piston 2, inward from its outer stop",
    "pressure_oil2_pa": "oil damper, chamber two, absolute",
    "spent_impulse_n_s": "impulse given to the synchronizer since it was armed",
    "pulse_s": "time to 8 V of the position sensor's coil",
    "input_rad_s": "speed of the input shaft, referred to the synchronizer",
    "output_rad_s": "speed of the output shaft, referred to the synchronizer",
    "controller_state": "state of the shift: "
    + ", ".join(f"{s.value} {s.name}" for s in ShiftState),
    "controller_faults": "faults reported, sum of: "
    + ", ".join(f"{f.value} {f.name}" for f in Fault if f),
}
_OF_CHAMBER: Final = {
    "pressure": "pressure of chamber {}, absolute",
    "cmd": "duty of the coil of valve {}, 0 to 1",
    "valve": "plunger of valve {}: 1 supply, 0 atmosphere",
}
_NAME: Final = re.compile(r"[A-Za-z_][A-Za-z0-9_.\[\]]*\Z")


@dataclass(frozen=True, slots=True)
class TraceReport:
    """A converted table: its rows, and the names and units of its signals without the time."""

    rows: int
    names: tuple[str, ...]
    units: tuple[str, ...]

    def as_dict(self) -> dict[str, Any]:
        """Return all of it as plain JSON values."""
        return {"rows": self.rows, "names": list(self.names), "units": list(self.units)}


def unit_of(name: str) -> str:
    """Return the unit that a signal's name ends in, "" for none."""
    return next((unit for suffix, unit in _UNITS if name.endswith(suffix)), "")


def comment_of(name: str) -> str:
    """Return what a signal of a trace or a campaign is, "" for one of neither."""
    if name in _COMMENTS:
        return _COMMENTS[name]
    found = re.fullmatch(r"(pressure|cmd|valve)_([BNF12])(?:_pa)?", name)
    return _OF_CHAMBER[found[1]].format(found[2]) if found else ""


def is_trace_csv(path: str) -> bool:
    """Return whether a file is a table of signals: CSV with time_s first that is no log of frames."""
    if not path.removesuffix(".gz").lower().endswith(".csv"):
        return False
    source = ByteSource(path, LogReport(path, "csv"))
    source.close()
    names = source.head.split(b"\n", 1)[0].decode("latin-1").strip().split(",")
    return names[0] == "time_s" and len(names) > 1 and "data" not in names


def _rows(path: str) -> Iterator[tuple[int, list[float]]]:
    """Rows of a trace with their line numbers, the header's names checked by the caller.

    Raises InputError at a broken row: no row of a trace can be left out.
    """
    source = ByteSource(path, LogReport(path, "csv", strict=True))
    try:
        count = 0
        for line in lines(source):
            text = line.text.strip()
            if line.number == 1:
                count = len(text.split(","))
                continue
            if not text:
                continue
            try:
                values = [float(word) if word else float("nan") for word in text.split(",")]
            except ValueError:
                raise InputError(
                    f"{path}: line {line.number}: {text[:40]!r} is not numbers; expected {count}"
                ) from None
            if len(values) != count:
                raise InputError(
                    f"{path}: line {line.number}: {len(values)} columns; expected {count}"
                )
            yield line.number, values
    finally:
        source.close()


def _batches(path: str) -> Iterator[list[tuple[int, list[float]]]]:
    """Yield the rows of a trace, some thousand at a time."""
    rows = _rows(path)
    while batch := list(islice(rows, _ROWS)):
        yield batch


def _names(path: str) -> list[str]:
    source = ByteSource(path, LogReport(path, "csv"))
    source.close()
    names = source.head.split(b"\n", 1)[0].decode("latin-1").strip().split(",")
    for name in names:
        if not _NAME.match(name) or names.count(name) > 1:
            raise InputError(
                f"{path}: line 1: column {name[:40]!r}; expected distinct names of signals"
            )
    return names


def trace_to_mf4(source: str, target: str) -> TraceReport:
    """Write a trace as one MF4 group with time in s and every signal with its unit and comment.

    Raises InputError for a torn trace, a time that falls, or when asammdf is missing.
    """
    asammdf = import_asammdf(target)
    import numpy as np

    names = _names(source)
    signals = tuple(names[1:])
    units = tuple(unit_of(name) for name in signals)
    measurement = new_measurement(target, 0)
    written = 0
    last_s = float("-inf")
    try:
        for rows in _batches(source):
            table = np.array([values for _, values in rows], dtype=np.float64)
            for (number, values), before_s in zip(rows, [last_s, *table[:-1, 0]], strict=True):
                if not values[0] >= before_s:
                    raise InputError(
                        f"{source}: line {number}: time {values[0]} s after {before_s} s; expected "
                        "times that do not fall"
                    )
            last_s = table[-1, 0]
            times, *columns = (np.ascontiguousarray(column) for column in table.T)
            if written:
                measurement.extend(0, [(times, None), *((column, None) for column in columns)])
            else:
                table_signals = [
                    asammdf.Signal(column, times, name=name, unit=unit, comment=comment_of(name))
                    for name, unit, column in zip(signals, units, columns, strict=True)
                ]
                measurement.append(table_signals, acq_name="trace", common_timebase=True)
            written += len(rows)
        if not written:
            raise InputError(f"{source}: no rows under the header; expected a trace")
        with replacing(target) as file:
            measurement.save(file, compression=1, add_history_block=False)
    finally:
        measurement.close()
    return TraceReport(written, signals, units)


def mf4_to_trace(source: str, target: str) -> TraceReport:
    """Write the signals of an MF4 file as a trace CSV; times from the start of the file.

    Raises InputError for a file of several tables, and for signals that are no plain numbers.
    """
    table = SignalTable(source)
    count = 0
    try:
        with replacing(target) as file:
            file.write(",".join(["time_s", *table.names]).encode("utf-8") + b"\n")
            for row in table.rows():
                file.write((",".join(map(repr, row)) + "\n").encode("ascii"))
                count += 1
    finally:
        table.close()
    return TraceReport(count, table.names, table.units)

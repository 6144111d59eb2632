"""trace.csv: the truth of a run and the controller's estimate, on one time axis."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import BinaryIO

import numpy as np

from can_dbc.messages import ControllerStatus
from sil.recording.run_record import Floats, RunRecord

FIRST_COLUMNS = (
    "time_s",
    "position_m",
    "pressure_B_pa",
    "pressure_N_pa",
    "pressure_F_pa",
    "cmd_B",
    "cmd_N",
    "cmd_F",
    "position_internal_m",
)
"""The columns that come first: those of a measured stroke, in its order."""

FROM_STATUS = {
    "position_internal_m": "estimate_m",
    "controller_state": "state",
    "controller_faults": "faults",
}
"""Columns from the controller's frames, each value held until the next frame."""


def held(times: Floats, values: Floats, at: Floats, before: float = math.nan) -> Floats:
    """Return a series, held between its values, at other instants: [n] for `at` [n] in s.

    `times` in s and `values`: [m]; `before` is the value before the first one.
    """
    padded = np.concatenate([[before], values])
    return np.asarray(padded[np.searchsorted(times, at, side="right")])


def trace_columns(
    record: RunRecord, before: Mapping[str, float] | None = None
) -> dict[str, Floats]:
    """Return all columns of trace.csv by name, each [n] in the unit that its name ends with.

    `before`: values before the record's first frame, by column.
    """
    before = before or {}
    columns = dict(record.truth)
    for name, field in FROM_STATUS.items():
        times, values = record.series(ControllerStatus, field)
        numbers = np.array(values, dtype=np.float64)
        columns[name] = held(times, numbers, columns["time_s"], before.get(name, math.nan))
    rest = [name for name in columns if name not in FIRST_COLUMNS]
    return {name: columns[name] for name in (*FIRST_COLUMNS, *rest)}


class TraceCsv:
    """Writes the trace piece by piece: every number reads back to the same bits.

    An unknown number is an empty field.
    """

    def __init__(self, file: BinaryIO) -> None:
        """Write into an empty file."""
        self._file = file
        self._held: dict[str, float] = {}

    def add(self, record: RunRecord) -> None:
        """Append the rows of the next piece of the run."""
        columns = trace_columns(record, self._held)
        whole = ("valve_B", "valve_N", "valve_F", "controller_state", "controller_faults")
        for name, field in FROM_STATUS.items():
            _, values = record.series(ControllerStatus, field)
            if values:
                self._held[name] = float(values[-1])
        if self._file.tell() == 0:
            self._file.write((",".join(columns) + "\n").encode())
        for begin in range(0, len(record.truth["time_s"]), 20_000):
            texts = [
                _texts(column[begin : begin + 20_000].tolist(), name in whole)
                for name, column in columns.items()
            ]
            lines = "".join(",".join(row) + "\n" for row in zip(*texts, strict=True))
            self._file.write(lines.encode())


def _texts(values: list[float], are_integers: bool) -> list[str]:
    if are_integers:
        return ["" if v != v else str(int(v)) for v in values]
    return ["" if v != v else repr(v) for v in values]

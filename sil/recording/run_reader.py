"""The recordings of a run, read piece by piece, so that memory does not grow with its length."""

from __future__ import annotations

import os
from bisect import bisect_left
from collections.abc import Iterator, Mapping
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from can_dbc.errors import InputError
from can_dbc.user_file import parse_json
from sil.coupling.clock import NS_PER_S
from sil.recording.recorder import BUS_FRAMES, EVENTS, PLANT_TRACE, TRACE_FORMAT
from sil.recording.run_record import STORED_FRAME, PlantEvent, RunRecord, StoredFrames

PIECE_S = 60.0
"""A run up to this long is one piece, if it has at most about a million rows of the trace."""


class RowReader:
    """Rows of fixed size in a file, by their index, also while it is written.

    A torn last row is ignored.
    """

    def __init__(self, path: Path, kind: np.dtype[Any], ordered_by: str, begin: int = 0) -> None:
        """Take a file with rows of a structured type, ascending in one field, from a byte on."""
        self.kind = kind
        self._path = path
        self._ordered_by = ordered_by
        self._begin = begin
        self.rows = (path.stat().st_size - begin) // kind.itemsize

    def read(self, begin: int, end: int) -> NDArray[Any]:
        """Return rows begin to end - 1 as a structured array: [rows]."""
        offset = self._begin + begin * self.kind.itemsize
        return np.fromfile(self._path, self.kind, end - begin, offset=offset)

    def first_from(self, value: float) -> int:
        """Return the index of the first row that is at `value` or more in the order of the file."""
        return bisect_left(
            range(self.rows), value, key=lambda k: self.read(k, k + 1)[self._ordered_by][0]
        )

    def between(self, begin: float, end: float) -> NDArray[Any]:
        """Return the rows from `begin` to before `end` in the order of the file: [rows]."""
        first = 0 if begin <= 0.0 else self.first_from(begin)
        return self.read(first, self.rows if end == np.inf else self.first_from(end))


class _Header(msgspec.Struct):
    format: Literal["opc4-trace-1"]
    columns: Annotated[tuple[str, ...], msgspec.Meta(min_length=1)]


def open_trace(path: Path) -> RowReader:
    """Return the reader of a trace.  Raises InputError for a file that is not a trace."""
    with open(path, "rb") as file:
        line = file.readline(65536)
    try:
        if line.endswith(b"\n"):
            columns = msgspec.json.decode(line, type=_Header).columns
            kind = np.dtype([(name, "<f8") for name in columns])
            return RowReader(path, kind, columns[0], len(line))
    except (msgspec.MsgspecError, RecursionError, ValueError):
        pass
    raise InputError(
        f"{path}: line 1: not the header of a trace; expected one line of JSON with "
        f'"format": "{TRACE_FORMAT}" and "columns"'
    )


def event_of(line: bytes, location: str) -> PlantEvent:
    """Return the event of one line.  Raises InputError naming `location` for something else."""
    try:
        values = parse_json(line)
        return PlantEvent(float(values.pop("time_s")), str(values.pop("name")), values)
    except (ValueError, KeyError, TypeError, AttributeError):
        raise InputError(f"{location}: not an event; expected time_s, name and values") from None


class RunReader:
    """The recordings of a run in a folder; use as a context manager."""

    def __init__(
        self,
        folder: Path,
        senders: tuple[str, ...],
        *,
        constants: Mapping[str, float],
        trace_period_s: float,
    ) -> None:
        """Open the files; `constants`: the fields of `RunRecord` that are not recorded.

        Raises OSError without recordings, InputError for other files.
        """
        self._constants = constants
        self._senders = senders
        self._trace = open_trace(folder / PLANT_TRACE)
        self._frames = RowReader(folder / BUS_FRAMES, STORED_FRAME, "arrival")
        self.piece_s = min(PIECE_S, 1e6 * trace_period_s)
        self.rows = self._trace.rows
        self.end_s = float(self._trace.read(self.rows - 1, self.rows)[0][0]) if self.rows else 0.0
        self.pieces = int(self.end_s // self.piece_s) + 1 if self.end_s > self.piece_s else 1
        self._events = open(folder / EVENTS, "rb")  # noqa: SIM115 - closed by __exit__
        self.balances: Mapping[str, Any] = {}
        self._spans = self._read_events()
        self._whole: RunRecord | None = None

    def __enter__(self) -> RunReader:
        return self

    def __exit__(self, *error: object) -> None:
        self._events.close()

    def __iter__(self) -> Iterator[RunRecord]:
        """Yield the pieces in order of time: each frame, row and event is in one of them."""
        return map(self.piece, range(self.pieces))

    def piece(self, number: int) -> RunRecord:
        """Return one piece of the run; all of it, if it has but one."""
        if self._whole is not None:
            return self._whole
        start = -np.inf if number == 0 else number * self.piece_s
        end = np.inf if number == self.pieces - 1 else (number + 1) * self.piece_s
        record = self._record(start, end, end)
        if self.pieces == 1:
            self._whole = record
        return record

    def span(self, start_s: float, until_s: float) -> RunRecord:
        """Return the record from `start_s` to `until_s`, and a second more on either side."""
        if self.pieces == 1:
            return self.piece(0)
        latest_s = until_s + 1.0 + self._longest_way_ns / NS_PER_S
        return self._record(start_s - 1.0, until_s + 1.0, latest_s)

    def _record(self, start_s: float, end_s: float, last_arrival_s: float) -> RunRecord:
        """Return rows and events from start to before end, frames to before the last arrival."""
        rows = self._trace.between(start_s, end_s)
        frames = self._frames.between(start_s * NS_PER_S, last_arrival_s * NS_PER_S)
        return RunRecord(
            truth={name: np.ascontiguousarray(rows[name]) for name in rows.dtype.names or ()},
            events=self._events_between(start_s, end_s),
            frames=StoredFrames(frames, self._senders),
            **self._constants,
        )

    @cached_property
    def _longest_way_ns(self) -> int:
        """The longest time from the release of a frame to its arrival, ns."""
        frames, step = self._frames, 1 << 18
        begins = range(0, frames.rows, step)
        pieces = (frames.read(begin, min(begin + step, frames.rows)) for begin in begins)
        return max((int((p["arrival"] - p["released"]).max()) for p in pieces), default=0)

    def _read_events(self) -> dict[int, tuple[int, int]]:
        """Return the byte range of each piece's events in the file, and store the balances."""
        spans: dict[int, tuple[int, int]] = {}
        begin = 0
        for line in self._events:
            if not line.endswith(b"\n"):
                break  # torn
            event = event_of(line, self._events.name)
            if event.name == "balance" and not self.balances:
                self.balances = event.values
            number = min(int(event.time_s // self.piece_s), self.pieces - 1)
            end = begin + len(line)
            spans[number] = (spans.get(number, (begin, end))[0], end)
            begin = end
        return spans

    def _events_between(self, start_s: float, end_s: float) -> list[PlantEvent]:
        low = 0 if start_s <= 0.0 else int(start_s // self.piece_s)
        high = self.pieces - 1 if end_s == np.inf else int(end_s // self.piece_s)
        spans = [self._spans[n] for n in range(low, high + 1) if n in self._spans]
        if not spans:
            return []
        begin, end = min(span[0] for span in spans), max(span[1] for span in spans)
        lines = os.pread(self._events.fileno(), end - begin, begin).split(b"\n")[:-1]
        events = [event_of(line, self._events.name) for line in lines]
        return [event for event in events if start_s <= event.time_s < end_s]

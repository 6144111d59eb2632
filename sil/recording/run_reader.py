"""The recordings of a run, read piece by piece, so that memory does not grow with its length."""

from __future__ import annotations

from array import array
from bisect import bisect_left
from collections.abc import Iterator, Mapping
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from can_dbc.errors import InputError
from can_dbc.instants import NS_PER_S
from can_dbc.user_file import parse_json
from sil.recording.recorder import BUS_FRAMES, EVENTS, PLANT_TRACE, TRACE_FORMAT
from sil.recording.run_record import STORED_FRAME, PlantEvent, RunRecord, StoredFrames, piece_spans


def stored_rows(path: Path, kind: np.dtype[Any], begin: int = 0) -> NDArray[Any]:
    """Return the rows of a file from a byte on without a torn last one: [rows], read when used."""
    rows = (path.stat().st_size - begin) // kind.itemsize
    return np.memmap(path, kind, "r", begin, (rows,)) if rows else np.empty(0, kind)


def _between(rows: NDArray[Any], ascending: str, start: float, end: float) -> NDArray[Any]:
    """Return the rows from `start` to before `end` in an ascending column: [rows]."""
    return np.array(rows[slice(*(bisect_left(rows[ascending], at) for at in (start, end)))])


class _Header(msgspec.Struct):
    format: Literal["opc4-trace-1"]
    columns: Annotated[tuple[str, ...], msgspec.Meta(min_length=1)]


def open_trace(path: Path) -> NDArray[Any]:
    """Return the rows of a trace: [rows].  Raises InputError for a file that is not a trace."""
    with open(path, "rb") as file:
        line = file.readline(65536)
    try:
        if line.endswith(b"\n"):
            columns = msgspec.json.decode(line, type=_Header).columns
            kind = np.dtype([(name, "<f8") for name in columns])
            return stored_rows(path, kind, len(line))
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
    """The recordings of a run in a folder."""

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
        self._frames = stored_rows(folder / BUS_FRAMES, STORED_FRAME)
        self.rows = len(self._trace)
        self.end_s = float(self._trace[-1][0]) if self.rows else 0.0
        self._bounds = piece_spans(self.end_s, trace_period_s)
        self._events_file = str(folder / EVENTS)
        self._event_bytes = stored_rows(folder / EVENTS, np.dtype("u1"))
        self.balances: Mapping[str, Any] = {}
        times, ends = array("d"), array("q", [0])
        with open(folder / EVENTS, "rb") as lines:
            for line in lines:
                if not line.endswith(b"\n"):
                    break  # torn
                event = event_of(line, self._events_file)
                if event.name == "balance" and not self.balances:
                    self.balances = event.values
                times.append(event.time_s)
                ends.append(ends[-1] + len(line))
        self._event_times, self._event_ends = np.array(times), ends

    @cached_property
    def first(self) -> RunRecord:
        """The first piece of the run; all of it, if it has but one."""
        return self._record(*self._bounds[0])

    def __iter__(self) -> Iterator[RunRecord]:
        """Yield the pieces in order of time: each frame, row and event is in one of them."""
        yield self.first
        for bounds in self._bounds[1:]:
            yield self._record(*bounds)

    def span(self, start_s: float, until_s: float) -> RunRecord:
        """Return the record from `start_s` to `until_s`, and a second more on either side."""
        if len(self._bounds) == 1:
            return self.first
        way_s = self._longest_way_ns / NS_PER_S
        return self._record(start_s - 1.0, until_s + 1.0, way_s)

    def _record(self, start_s: float, end_s: float, way_s: float = 0.0) -> RunRecord:
        """Return rows and events from start to before end, frames that arrive up to `way_s` later."""
        rows = _between(self._trace, "time_s", start_s, end_s)
        until_ns = (end_s + way_s) * NS_PER_S
        frames = _between(self._frames, "arrival", start_s * NS_PER_S, until_ns)
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
        pieces = (frames[begin : begin + step] for begin in range(0, len(frames), step))
        return max((int((p["arrival"] - p["released"]).max()) for p in pieces), default=0)

    def _events_between(self, start_s: float, end_s: float) -> list[PlantEvent]:
        times, ends = self._event_times, self._event_ends
        wanted = np.flatnonzero((times >= start_s) & (times < end_s))
        if not len(wanted):
            return []
        lines = self._event_bytes[ends[wanted[0]] : ends[wanted[-1] + 1]].tobytes().splitlines()
        events = [event_of(line, self._events_file) for line in lines]
        return [event for event in events if start_s <= event.time_s < end_s]

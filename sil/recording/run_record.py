"""The record of a finished run as arrays and messages: the input of metrics and pictures."""

from __future__ import annotations

import math
import struct
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from can_dbc import codec
from can_dbc.e2e import M
from can_dbc.errors import CodecError
from can_dbc.frame import Frame
from can_dbc.instants import NS_PER_S
from can_dbc.messages import ControllerStatus
from sil.coupling.bus import BusFrame

Floats = NDArray[np.float64]

CHAMBERS = ("B", "N", "F")
OPEN_ABOVE = 0.34
"""A commanded duty above this is meant to open (closed at or below 0.33, open at or above 0.35)."""

PIECE_S = 60.0
"""A run up to this long is one piece, if it has at most about a million rows of the trace."""

STORED = struct.Struct("<QQIBB8s")
"""A frame on disk: released and arrival [ns], identifier, length, number of its sender, data."""
STORED_FRAME = np.dtype(
    {
        "names": ["released", "arrival", "can_id", "length", "sender", "data"],
        "formats": ["<u8", "<u8", "<u4", "u1", "u1", "V8"],
    }
)


class StoredFrames(Collection[BusFrame]):
    """Frames in their form on disk, each made into an object on access.

    A minute of a bus is some 60,000 frames: as objects they would cost the garbage collector more
    time than everything that is done with them.
    """

    def __init__(self, stored: NDArray[np.void], senders: Sequence[str]) -> None:
        """Take frames [n] of `STORED_FRAME`; `senders`: names by number."""
        self._stored = stored
        self._senders = senders

    def __len__(self) -> int:
        return len(self._stored)

    def __iter__(self) -> Iterator[BusFrame]:
        senders, rows = self._senders, STORED.iter_unpack(self._stored.tobytes())
        for released, arrival, can_id, length, sender, data in rows:
            yield BusFrame(released, arrival, senders[sender], Frame(can_id, data[:length]))

    def __contains__(self, frame: object) -> bool:
        return any(frame == each for each in self)

    def by_id(self) -> dict[int, StoredFrames]:
        """Return the frames by identifier, in order."""
        ids = self._stored["can_id"]
        return {int(i): StoredFrames(self._stored[ids == i], self._senders) for i in np.unique(ids)}


@dataclass(frozen=True)
class PlantEvent:
    """An event that the plant located exactly: a valve moved, the stay stopped, a block released."""

    time_s: float
    name: str
    values: Mapping[str, Any] = field(default_factory=dict)


def piece_spans(end_s: float, trace_period_s: float) -> list[tuple[float, float]]:
    """Return from when to before when each piece of a run lasts, s; the rules see a piece at a time."""
    piece_s = min(PIECE_S, 1e6 * trace_period_s)
    inner = [piece_s * k for k in range(1, int(end_s // piece_s) + 1)] if end_s > piece_s else []
    return list(pairwise((-math.inf, *inner, math.inf)))


@dataclass(frozen=True)
class RunRecord:
    """The truth (columns over time_s), the plant's events and every frame of one run."""

    truth: Mapping[str, Floats]
    events: Sequence[PlantEvent]
    frames: Collection[BusFrame]
    stroke_m: float
    free_travel_m: float
    supply_pressure_pa: float
    moving_mass_kg: float

    @cached_property
    def messages(self) -> dict[type, list[tuple[BusFrame, Any]]]:
        """The decoded messages of the contract by type, in order of arrival.

        Frames of other identifiers and damaged ones are only in `frames`.
        """
        kinds = map(codec.message_type_of, sorted(self._by_id))
        return {kind: self.of(kind) for kind in kinds if kind and self.of(kind)}

    @cached_property
    def _by_id(self) -> Mapping[int, Collection[BusFrame]]:
        if isinstance(self.frames, StoredFrames):
            return self.frames.by_id()
        frames_by_id: dict[int, list[BusFrame]] = {}
        for entry in self.frames:
            frames_by_id.setdefault(entry.frame.can_id, []).append(entry)
        return frames_by_id

    @cached_property
    def _decoded(self) -> dict[type, list[tuple[BusFrame, Any]]]:
        return {}

    @cached_property
    def derived(self) -> dict[Any, Any]:
        """What has been concluded from the record and is asked for again, by what it is."""
        return {}

    def between(self, start_s: float, end_s: float) -> RunRecord:
        """Return the rows and events from start to before end, and the frames that arrive then."""
        if (start_s, end_s) == (-math.inf, math.inf):
            return self
        start_ns, end_ns = start_s * NS_PER_S, end_s * NS_PER_S
        rows = slice(*np.searchsorted(self.truth["time_s"], (start_s, end_s)))
        truth = {name: column[rows] for name, column in self.truth.items()}
        events = [event for event in self.events if start_s <= event.time_s < end_s]
        frames = [entry for entry in self.frames if start_ns <= entry.arrival_ns < end_ns]
        return replace(self, truth=truth, events=events, frames=frames)

    def frames_of(self, can_id: int) -> Collection[BusFrame]:
        """Return the frames of one identifier, in order of arrival."""
        return self._by_id.get(can_id, ())

    def each(self, kind: type[M]) -> Iterator[tuple[BusFrame, M]]:
        """Yield what `of` returns, without storing it."""
        if kind in self._decoded:
            yield from self._decoded[kind]
            return
        for entry in self.frames_of(codec.can_id_of(kind)):
            try:
                message: Any = codec.decode(entry.frame)
            except CodecError:
                continue
            yield entry, message

    def of(self, kind: type[M]) -> list[tuple[BusFrame, M]]:
        """Return (frame, message) of one message type in order of arrival."""
        if kind not in self._decoded:
            self._decoded[kind] = list(self.each(kind))
        return self._decoded[kind]

    def series(self, kind: type[Any], name: str) -> tuple[Floats, list[Any]]:
        """Return arrival times [n] in s, and the n values, of one field of one message type."""
        entries = self.of(kind)
        times = np.array([e.arrival_ns for e, _ in entries], dtype=np.float64) / NS_PER_S
        return times, [getattr(m, name) for _, m in entries]

    @cached_property
    def estimate(self) -> tuple[Floats, Floats]:
        """Times [n] in s and positions [n] in m of the controller's estimate on the bus."""
        times, values = self.series(ControllerStatus, "estimate_m")
        return times, np.array(values, dtype=np.float64)

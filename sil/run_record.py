"""What a finished run left behind, as arrays and messages: the input of metrics and pictures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from can_dbc import codec
from can_dbc.frame import Frame
from can_dbc.messages import ControllerStatus

Floats = NDArray[np.float64]
M = TypeVar("M")

NS = 1_000_000_000
CHAMBERS = ("B", "N", "F")


class BusFrame(NamedTuple):
    """One frame as it crossed the bus: released by its sender, arrived at everybody else."""

    released_ns: int
    arrival_ns: int
    sender: str
    frame: Frame


@dataclass(frozen=True)
class PlantEvent:
    """Something the plant located exactly: a valve moved, the stay stopped, a block released."""

    time_s: float
    name: str
    values: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class RunRecord:
    """The truth (columns over time_s), the plant's events and every frame of one run."""

    truth: Mapping[str, Floats]
    events: Sequence[PlantEvent]
    frames: Sequence[BusFrame]
    stroke_m: float
    free_travel_m: float
    supply_pressure_pa: float

    @cached_property
    def messages(self) -> dict[type, list[tuple[BusFrame, Any]]]:
        """All frames that our contract knows, decoded, by message type in order of arrival.

        Frames of other ids and damaged ones are left out here: they stay in `frames`.
        """
        kinds = [codec.message_type_of(can_id) for can_id in self._by_id]
        found: dict[type, list[tuple[BusFrame, Any]]]
        found = {kind: self.of(kind) for kind in kinds if kind is not None}
        return {kind: entries for kind, entries in found.items() if entries}

    @cached_property
    def _by_id(self) -> dict[int, list[BusFrame]]:
        found: dict[int, list[BusFrame]] = {}
        for entry in self.frames:
            found.setdefault(entry.frame.can_id, []).append(entry)
        return found

    @cached_property
    def _decoded(self) -> dict[type, list[tuple[BusFrame, Any]]]:
        return {}

    def of(self, kind: type[M]) -> list[tuple[BusFrame, M]]:
        """Return (frame, message) of one message type in order of arrival."""
        if kind not in self._decoded:
            found: list[tuple[BusFrame, Any]] = []
            self._decoded[kind] = found
            for entry in self._by_id.get(codec.can_id_of(kind), ()):
                try:
                    found.append((entry, codec.decode(entry.frame)))
                except codec.CodecError:
                    continue
        return self._decoded[kind]

    def series(self, kind: type[Any], name: str) -> tuple[Floats, list[Any]]:
        """Return arrival times in s, and the values, of one field of one message type."""
        entries = self.of(kind)
        times = np.array([e.arrival_ns for e, _ in entries], dtype=np.float64) / NS
        return times, [getattr(m, name) for _, m in entries]

    @cached_property
    def believed(self) -> tuple[Floats, Floats]:
        """Times (s) and positions (m) that the controller put on the bus as its estimate."""
        times, values = self.series(ControllerStatus, "estimate_m")
        return times, np.array(values, dtype=np.float64)

"""Periods and jitter of the messages of a bus, measured from a log."""

from __future__ import annotations

from array import array
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from can_dbc.errors import InputError
from can_dbc.frame import split_id
from sil.files.quantity import counted
from sil.logs.frame import LogFrame

if TYPE_CHECKING:
    from cantools.database import Database

_LEAST_INTERVALS: Final = 10


@dataclass
class MeasuredMessage:
    """A message of the bus, from its intervals in the log.

    periodic: 80 % of its intervals are within 30 % of their median. period_ns: the mean interval, of a
    periodic message without the others. jitter_ns: by how much an interval is shorter than that, 99 of 100 at most; it includes
    waiting for the bus.
    """

    can_id: int
    extended: bool
    frames: int = 0
    length: int = 0
    periodic: bool = False
    period_ns: int = 0
    jitter_ns: int = 0
    _last_ns: int | None = None
    _intervals: array[int] = field(default_factory=lambda: array("q"))

    def take(self, frame: LogFrame) -> None:
        """Take one frame; the first intervals are kept."""
        self.frames += 1
        self.length = max(self.length, len(frame.data))
        last_ns, room = self._last_ns, len(self._intervals) < 10_000
        if room and last_ns is not None and frame.time_ns > last_ns:
            self._intervals.append(frame.time_ns - last_ns)
        self._last_ns = frame.time_ns

    def measure(self) -> bool:
        """Find period and jitter; return whether there were frames enough for that."""
        if len(self._intervals) < _LEAST_INTERVALS:
            return False
        ordered = sorted(self._intervals)
        median = ordered[len(ordered) // 2]
        near = [i for i in ordered if abs(i - median) <= 0.3 * median]
        self.periodic = len(near) >= 0.8 * len(ordered)
        counted = near if self.periodic else ordered
        self.period_ns = round(sum(counted) / len(counted))
        shortest = ordered[len(ordered) // 100]
        self.jitter_ns = max(self.period_ns - shortest, 0) if self.periodic else 0
        return True


def measure_bus(frames: Iterable[LogFrame], log: str) -> tuple[list[MeasuredMessage], list[str]]:
    """Measure one bus in bounded memory: its messages, most frequent first, and what was left out, as text.

    Raises InputError for a log of several channels, and for one without messages that repeat.
    """
    messages: dict[tuple[int, bool], MeasuredMessage] = {}
    channels: set[str] = set()
    fd = 0
    for frame in frames:
        if frame.error or frame.remote:
            continue
        if frame.fd:
            fd += 1
            continue
        channels.add(frame.channel)
        key = frame.can_id, frame.extended
        if key not in messages:
            if len(messages) >= 4_000:
                raise InputError(f"{log}: over 4000 messages; expected a bus, which has fewer")
            messages[key] = MeasuredMessage(*key)
        messages[key].take(frame)
    if len(channels) > 1:
        raise InputError(
            f"{log}: channels {', '.join(sorted(channels)[:8])}; expected one bus, by --channel"
        )
    measured = [message for message in messages.values() if message.measure()]
    if not measured:
        raise InputError(
            f"{log}: no message comes {_LEAST_INTERVALS + 1} times; expected a log of a bus in traffic"
        )
    irregular = sum(1 for message in measured if not message.periodic)
    counts = (
        (len(messages) - len(measured), "message", "too rare to be measured, left out"),
        (fd, "CAN FD frame", "left out: the analysis covers classic CAN only"),
        (irregular, "message", "not periodic: taken by the mean interval (~)"),
    )
    notes = [f"{counted(count, noun)} {what}" for count, noun, what in counts if count]
    return sorted(measured, key=lambda message: message.period_ns), notes


def names_of(
    database: Database, messages: Iterable[MeasuredMessage]
) -> dict[tuple[int, bool], str]:
    """Return the database's name of each message: by identifier, else by J1939 parameter group."""
    exact = {(m.frame_id, m.is_extended_frame): m.name for m in database.messages}
    groups = {split_id(m.frame_id).pgn: m.name for m in database.messages if m.is_extended_frame}
    names = {}
    for message in messages:
        key, parts = (message.can_id, message.extended), split_id(message.can_id)
        if key in exact:
            names[key] = exact[key]
        elif message.extended and parts.pgn in groups:
            names[key] = f"{groups[parts.pgn]} of {parts.source:02X}"
    return names

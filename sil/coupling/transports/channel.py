"""The interface of a transport, and the transport inside one process, where a grant is a call."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, Protocol

from can_dbc.errors import InputError, RunError
from can_dbc.frame import Frame

if TYPE_CHECKING:
    from sil.coupling.bus import BusFrame


def silent(message: str) -> None:
    """Discard a message for the user."""


Received = Sequence[tuple[int, Frame]]
"""Frames with their arrival instants, ns, in order of arrival."""
Turn = tuple[list[tuple[int, Frame]], int]
"""A participant's answer to a grant: frames in the order of its choice with their release instants
(ns, not before the grant), and the instant of its next event (ns, after the grant)."""


class ParticipantLost(RunError):
    """A participant died, stalled, or broke the protocol; `participant` is its name."""

    def __init__(self, participant: str, what: str) -> None:
        super().__init__(f"{participant} {what}")
        self.participant = participant
        self._what = what

    def at(self, seconds: float) -> ParticipantLost:
        """Return the same error with the simulated instant in its message."""
        return ParticipantLost(self.participant, f"{self._what} (at {seconds:.6f} s simulated)")


@dataclass(frozen=True)
class Timeouts:
    """Times in s: for all to join, for the answer to a grant, for processes to end after Stop."""

    start_s: float = 60.0
    answer_s: float = 2.0
    close_s: float = 1.0


class Participant(Protocol):
    """A node of the co-simulation, granted time at its events and at the end of the run."""

    @property
    def name(self) -> str:
        """Return its name, a key of `sil.coupling.transports.wire.PARTICIPANTS`."""

    def start(self) -> int:
        """Return the simulated instant of the first event, in ns."""

    def advance(self, until_ns: int, deliveries: Received) -> Turn:
        """Advance to `until_ns`; `deliveries`: what others sent and arrived since the last grant, up to it."""

    def close(self) -> None:
        """Release files and the like; called once, also after a run that failed."""


class Channel(ABC):
    """Carries frames and grants to the participants `names`.

    A turn is begun and ended by two calls, so that participants in other processes work in parallel.
    """

    def __init__(self, names: Sequence[str]) -> None:
        self.names = tuple(names)
        self.warnings: list[str] = []
        """Lines for the user about foreign frames, slow monitors and the like."""

    def warn(self, message: str) -> None:
        """Record a line for the user, once."""
        if message not in self.warnings:
            self.warnings.append(message)

    @abstractmethod
    def start(self, end_ns: int) -> dict[str, int]:
        """Return each participant's first event, ns. Raises ParticipantLost when one is not in time."""

    @abstractmethod
    def deliver(
        self, deliveries: Sequence[BusFrame], bus_off: frozenset[str] = frozenset()
    ) -> None:
        """Pass on frames, in order of arrival, to all but their senders and those in `bus_off`."""

    @abstractmethod
    def begin_turn(self, now_ns: int, names: Sequence[str]) -> None:
        """Grant `now_ns` to those of the named participants that are on this channel."""

    @abstractmethod
    def end_turn(self) -> dict[str, Turn]:
        """Return the answers to the grants of begin_turn.  Raises ParticipantLost without one."""

    @abstractmethod
    def retire(self, name: str) -> None:
        """Grant a participant no more time and send it no more frames."""

    @abstractmethod
    def idle(self, seconds: float) -> None:
        """Let wall time pass, still noticing who dies and who connects."""

    @abstractmethod
    def close(self, aborted: bool) -> None:
        """End the participants and release all resources; may be called more than once."""


class InProcess(Channel):
    """A `Channel` in this process; received: identifiers by participant, one that is absent gets all."""

    def __init__(
        self,
        participants: Sequence[Participant],
        received: Mapping[str, Container[int]] = MappingProxyType({}),
    ) -> None:
        super().__init__([participant.name for participant in participants])
        self._participants = {participant.name: participant for participant in participants}
        self._inboxes: dict[str, list[tuple[int, Frame]]] = {name: [] for name in self.names}
        self._received = received
        self._receivers: dict[int, tuple[str, ...]] = {}
        self._turns: dict[str, Turn] = {}
        self._retired: set[str] = set()
        self._closed = False

    def start(self, end_ns: int) -> dict[str, int]:
        """Start the participants."""
        return {name: participant.start() for name, participant in self._participants.items()}

    def deliver(
        self, deliveries: Sequence[BusFrame], bus_off: frozenset[str] = frozenset()
    ) -> None:
        """Queue frames for the participants."""
        inboxes, receivers = self._inboxes, self._receivers
        for _released_ns, arrival_ns, sender, frame in deliveries:
            names = receivers.get(frame.can_id)
            if names is None:
                names = receivers[frame.can_id] = tuple(
                    name
                    for name in self._inboxes
                    if name not in self._retired
                    and (name not in self._received or frame.can_id in self._received[name])
                )
            for name in names:
                if name != sender and name not in bus_off:
                    inboxes[name].append((arrival_ns, frame))

    def begin_turn(self, now_ns: int, names: Sequence[str]) -> None:
        """Run the turns.  Raises ParticipantLost for one that fails; InputError and RunError pass."""
        for name in names:
            inbox = self._inboxes.get(name)
            if inbox is not None and name not in self._retired:
                deliveries = inbox.copy()
                inbox.clear()
                try:
                    self._turns[name] = self._participants[name].advance(now_ns, deliveries)
                except (InputError, RunError):
                    raise
                except Exception as error:  # as when its process dies of it: the run is over
                    what = f"failed: {type(error).__name__}: {error}"
                    raise ParticipantLost(name, what) from error

    def end_turn(self) -> dict[str, Turn]:
        """Return the finished turns."""
        turns = self._turns.copy()
        self._turns.clear()
        return turns

    def retire(self, name: str) -> None:
        """Drop a participant."""
        self._retired.add(name)
        self._receivers.clear()

    def idle(self, seconds: float) -> None:
        """Sleep."""
        if seconds > 0.0:
            time.sleep(seconds)

    def close(self, aborted: bool) -> None:
        """Close the participants."""
        if not self._closed:
            self._closed = True
            for participant in self._participants.values():
                participant.close()

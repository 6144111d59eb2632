"""Participants in the coordinator's own process: a grant is a call."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, Protocol

from can_dbc.errors import InputError, RunError
from can_dbc.frame import Frame
from sil.coupling.transports.channel import NOBODY, ChannelCounts, ParticipantLost, Turn

if TYPE_CHECKING:
    from sil.coupling.bus import Delivery


class Participant(Protocol):
    """A node of the co-simulation: plant, controller, driver and others.

    It is granted time at its events, which its configuration determines, and at the end of the run.
    """

    @property
    def name(self) -> str:
        """Return its name, a key of `sil.coupling.transports.wire.PARTICIPANTS`."""

    def start(self) -> int:
        """Return the simulated instant of the first event, in ns."""

    def advance(
        self, until_ns: int, deliveries: Sequence[tuple[int, Frame]]
    ) -> tuple[list[tuple[int, Frame]], int]:
        """Advance to `until_ns`, given the frames that arrived since the last grant.

        `deliveries` holds arrival instant and frame of what others sent, in order of arrival; one
        that arrives exactly at `until_ns` is among them.  Returns frames with their release
        instants (not before `until_ns`) and the instant of the next event (after `until_ns`).
        """

    def close(self) -> None:
        """Release files and the like; called once, also after a run that failed."""


class InProcess:
    """A `Channel` to participants in this process."""

    def __init__(self, participants: Sequence[Participant]) -> None:
        """Take the participants.  Raises ValueError when two have the same name."""
        self._participants = {participant.name: participant for participant in participants}
        if len(self._participants) != len(participants):
            raise ValueError(f"two participants of one name: {[p.name for p in participants]}")
        self.names = tuple(self._participants)
        self.counts = ChannelCounts()
        self._inboxes: dict[str, list[tuple[int, Frame]]] = {name: [] for name in self.names}
        self._turns: dict[str, Turn] = {}
        self._closed = False

    def start(self, end_ns: int) -> dict[str, int]:
        """Start the participants."""
        return {name: participant.start() for name, participant in self._participants.items()}

    def deliver(self, deliveries: Sequence[Delivery], bus_off: frozenset[str] = NOBODY) -> None:
        """Queue frames for the participants."""
        for name, inbox in self._inboxes.items():
            if name not in bus_off:
                inbox.extend((d.arrival_ns, d.frame) for d in deliveries if d.sender != name)

    def begin_turn(self, now_ns: int, names: Sequence[str]) -> None:
        """Run the turns.  Raises ParticipantLost for one that fails; InputError and RunError pass."""
        for name in names:
            inbox = self._inboxes.get(name)
            if inbox is not None:
                self._inboxes[name] = []
                try:
                    self._turns[name] = Turn(*self._participants[name].advance(now_ns, inbox))
                except (InputError, RunError):
                    raise
                except Exception as error:  # as when its process dies of it: the run is over
                    what = f"failed: {type(error).__name__}: {error}"
                    raise ParticipantLost(name, what) from error

    def end_turn(self) -> dict[str, Turn]:
        """Return the finished turns."""
        turns, self._turns = self._turns, {}
        return turns

    def retire(self, name: str) -> None:
        """Drop a participant."""
        self._inboxes.pop(name, None)

    def idle(self, seconds: float) -> None:
        """Sleep."""
        if seconds > 0.0:
            time.sleep(seconds)

    def close(self, aborted: bool) -> None:
        """Close the participants."""
        if self._closed:
            return
        self._closed = True
        for participant in self._participants.values():
            participant.close()

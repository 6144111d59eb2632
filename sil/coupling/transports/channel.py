"""The interface of a transport: `Channel`, and the `Turn` that a participant answers with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple, Protocol

from can_dbc.errors import RunError
from can_dbc.frame import Frame

if TYPE_CHECKING:
    from sil.coupling.bus import Delivery


NOBODY: frozenset[str] = frozenset()


class Turn(NamedTuple):
    """A participant's answer to a grant.

    `frames`: release instant (not before the grant) and frame, in the order of the participant's
    choice; `next_ns`: its next event, after the grant.
    """

    frames: list[tuple[int, Frame]]
    next_ns: int


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
    """How long the coordinator waits, in seconds of the wall clock.

    `start_s`: for all participants to join (the first start on a machine compiles the plant);
    `answer_s`: for the answer to a grant; `close_s`: for processes to end after Stop.
    """

    start_s: float = 60.0
    answer_s: float = 2.0
    close_s: float = 1.0


@dataclass
class ChannelCounts:
    """What a channel noticed besides the run itself."""

    foreign_frames: int = 0
    garbage: int = 0
    warnings: list[str] = field(default_factory=list)

    def warn(self, message: str) -> None:
        """Record a line for the user, once."""
        if message not in self.warnings:
            self.warnings.append(message)


class Channel(Protocol):
    """Carries frames and grants to some of the participants.

    A turn is begun and ended by two calls, so that participants in other processes work in parallel.
    """

    names: tuple[str, ...]
    counts: ChannelCounts

    def start(self, end_ns: int) -> dict[str, int]:
        """Wait for the participants; return the instant of each one's first event, ns.

        Raises ParticipantLost when one does not join in time.
        """

    def deliver(self, deliveries: Sequence[Delivery], bus_off: frozenset[str] = NOBODY) -> None:
        """Pass on frames, in order of arrival, to all but their senders and those in `bus_off`."""

    def begin_turn(self, now_ns: int, names: Sequence[str]) -> None:
        """Grant `now_ns` to those of the named participants that are on this channel."""

    def end_turn(self) -> dict[str, Turn]:
        """Return the answers to the grants of begin_turn.  Raises ParticipantLost without one."""

    def retire(self, name: str) -> None:
        """Grant a participant no more time and send it no more frames."""

    def idle(self, seconds: float) -> None:
        """Let wall time pass, still noticing who dies and who connects."""

    def close(self, aborted: bool) -> None:
        """End the participants and release all resources; may be called more than once."""

"""The coordinator's side of the lockstep protocol, for participants in other processes."""

from __future__ import annotations

import contextlib
import select
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from functools import partial

from can_dbc.frame import EDP_BIT, Frame
from can_dbc.messages import StopReason
from sil.coupling.processes import ChildProcess, sharing_one_core
from sil.coupling.transports import wire
from sil.coupling.transports.channel import (
    Channel,
    ChannelCounts,
    ParticipantLost,
    Timeouts,
    Turn,
)
from sil.coupling.transports.wire import Kind, Refusal


def silent(message: str) -> None:
    """Discard a message for the user."""


MOST_OFFERS = 100_000
"""Frames that a participant may offer in one turn."""

FAILED_ENDS_S = 2.0
"""How long a process that reported a failure may take to end with its reason."""


class Peer:
    """One participant as the coordinator knows it, and the turn being received from it."""

    def __init__(self, name: str, number: int) -> None:
        self.name = name
        self.number = number
        self.child: ChildProcess | None = None
        """Its process, if the coordinator started it."""
        self.nonce: int | None = None
        self.granted_ns: int | None = None
        self.done: int | None = None
        self.retired = False
        self.delivered = 0
        """Frames of others passed on since the last grant."""
        self._frames: list[tuple[int, Frame]] = []
        self._release_ns = 0

    @property
    def joined(self) -> bool:
        """Whether it has been welcomed."""
        return self.nonce is not None

    def grant(self, now_ns: int) -> bytes:
        """Begin a turn; return the Grant's record."""
        self.granted_ns = self._release_ns = now_ns
        self.done = None
        delivered, self.delivered = self.delivered, 0
        return wire.control(Kind.GRANT, self.number, delivered, now_ns)

    def expect_first_event(self) -> None:
        """Begin the turn that ends with the Done of the handshake."""
        self.granted_ns = self._release_ns = 0

    def take(self, can_id: int, payload: bytes) -> None:
        """Take one record of this participant.  Raises ParticipantLost for a protocol error."""
        if self.granted_ns is None:
            raise self._against_rules(f"sent 0x{can_id:08X} out of its turn")
        control = wire.parse_control(can_id, payload)
        if control is None:
            if not can_id & EDP_BIT:
                raise self._against_rules(
                    f"sent 0x{can_id:08X} past the arbitration; expected an offer (EDP set)"
                )
            self._frames.append((self._release_ns, Frame(can_id & ~EDP_BIT, payload)))
            if len(self._frames) > MOST_OFFERS:
                raise self._against_rules(f"offered more than {MOST_OFFERS} frames in one turn")
        elif control.participant != self.number:
            raise self._against_rules(f"sent as participant number {control.participant}")
        elif control.kind == Kind.RELEASE:
            if control.value < self.granted_ns:
                raise self._against_rules(
                    f"released a frame at {control.value} ns; expected {self.granted_ns} ns or later"
                )
            self._release_ns = control.value
        elif control.kind == Kind.DONE:
            if control.extra != len(self._frames) & 0xFF:
                raise self._against_rules(
                    f"offered {control.extra} frames (modulo 256), {len(self._frames)} arrived: "
                    "the channel lost frames, or another program sent some"
                )
            self.done = control.value
            self.granted_ns = None
        elif control.kind == Kind.FAILED:
            how = self.child.how_it_ended(FAILED_ENDS_S) if self.child is not None else None
            raise ParticipantLost(self.name, how or "failed; its own error output says why")
        else:
            raise self._against_rules(f"sent {control.kind.name}, which only the coordinator sends")

    @property
    def offered(self) -> int:
        """Frames offered so far in this turn."""
        return len(self._frames)

    def turn(self) -> Turn:
        """Return the finished turn.  Raises ValueError when it is not finished."""
        if self.done is None:
            raise ValueError(f"{self.name}: the turn is not finished")
        frames, self._frames = self._frames, []
        return Turn(frames, self.done)

    def _against_rules(self, what: str) -> ParticipantLost:
        return ParticipantLost(self.name, f"broke the lockstep protocol: it {what}")


class RemoteChannel(Channel, ABC):
    """A `Channel` to other processes: handshake, turns, timeouts; subclasses move the records."""

    def __init__(
        self,
        names: Sequence[str],
        scenario: int,
        timeouts: Timeouts,
        say: Callable[[str], None],
        share_core: bool,
    ) -> None:
        """Prepare the handshake.

        `scenario`: 32 bits that distinguish scenarios; 0 joins with any.  `say` takes messages for
        the user while the run waits.  `share_core`: keep this thread and the processes spawned here
        on one core once all have joined (`core` is its number, None without).
        """
        self.names = tuple(names)
        self.counts = ChannelCounts()
        self._by_name = {name: Peer(name, wire.PARTICIPANTS[name]) for name in names}
        self._peers = {peer.number: peer for peer in self._by_name.values()}
        self._children: dict[str, ChildProcess] = {}
        self._scenario = scenario
        self._timeouts = timeouts
        self._share_core = share_core
        self._sharing = contextlib.ExitStack()
        self.core: int | None = None
        self._say = say
        self._now_ns = 0
        self._closed = False
        self._poll = select.epoll()
        self._handlers: dict[int, Callable[[int], None]] = {}
        self._served_first = -1

    @abstractmethod
    def _send(self, peer: Peer, records: bytes) -> None:
        """Send records to one participant (a CAN channel: to everybody)."""

    @abstractmethod
    def _send_all(self, records: bytes) -> None:
        """Send records to all participants."""

    @abstractmethod
    def _where(self) -> str:
        """Return how a program joins this channel, for messages."""

    @abstractmethod
    def _release(self, peer: Peer) -> None:
        """Drop what is stored for a retired participant."""

    @abstractmethod
    def _close_channel(self, stop: bytes, aborted: bool) -> None:
        """Send the Stop record to everybody, and close what the subclass opened."""

    def spawn(self, name: str, command: Sequence[str]) -> ChildProcess:
        """Start `command` as the process of participant `name`, to be watched and ended here."""
        child = ChildProcess(name, command)
        self._by_name[name].child = child
        self._children[name] = child
        self._attend(child.fileno(), partial(self._child_ended, child))
        return child

    def start(self, end_ns: int) -> dict[str, int]:
        """Wait for the participants.  Raises ParticipantLost when one does not come in time."""
        deadline = time.monotonic() + self._timeouts.start_s
        say_at = time.monotonic() + 2.0
        while missing := [p.name for p in self._peers.values() if not p.joined]:
            now = time.monotonic()
            if now >= deadline:
                raise ParticipantLost(
                    missing[0],
                    f"did not join within {self._timeouts.start_s:g} s ({self._where()})",
                )
            if now >= say_at:
                say_at = deadline
                self._say(f"waiting for {' and '.join(missing)} to join ({self._where()})")
            self._pump(min(deadline, say_at) - now)
        for peer in self._peers.values():
            peer.expect_first_event()
        if self._share_core and self._children:
            pids = [child.pid for child in self._children.values()]
            self.core = self._sharing.enter_context(sharing_one_core(pids))
        self._send_all(wire.control(Kind.START, value=end_ns))
        answered = time.monotonic() + self._timeouts.answer_s
        return {p.name: self._await_answer(p, answered).next_ns for p in self._peers.values()}

    def retire(self, name: str) -> None:
        """Grant a participant no more time."""
        peer = self._by_name.get(name)
        if peer is None or peer.retired:
            return
        peer.retired = True
        self._send(peer, wire.control(Kind.RETIRE, peer.number))
        self._release(peer)

    def idle(self, seconds: float) -> None:
        """Let wall time pass, still serving connections."""
        deadline = time.monotonic() + seconds
        self._pump(0.0)
        while (left := deadline - time.monotonic()) > 0.0:
            self._pump(left)

    def close(self, aborted: bool) -> None:
        """Send Stop, end the processes started here, close the channel."""
        if self._closed:
            return
        self._closed = True
        try:
            stop = StopReason.ABORTED if aborted else StopReason.END
            self._close_channel(wire.control(Kind.STOP, stop, value=self._now_ns), aborted)
        finally:
            grace = 0.1 if aborted else self._timeouts.close_s
            deadline = time.monotonic() + grace
            for child in self._children.values():
                child.end(max(0.0, deadline - time.monotonic()))
                for line in child.printed:
                    self._say(line)
            self._poll.close()
            self._sharing.close()

    def _attend(self, fileno: int, handler: Callable[[int], None]) -> None:
        self._handlers[fileno] = handler
        self._poll.register(fileno, select.EPOLLIN)

    def _ignore(self, fileno: int) -> None:
        if self._handlers.pop(fileno, None) is not None:
            self._poll.unregister(fileno)

    def _pump(self, timeout_s: float) -> None:
        """Serve whatever is ready, waiting at most `timeout_s` for the first."""
        ready = self._poll.poll(timeout_s)
        if len(ready) > 1:  # who connected before a frame was sent receives it
            ready.sort(key=lambda entry: entry[0] != self._served_first)
        for fileno, events in ready:
            handler = self._handlers.get(fileno)
            if handler is not None:
                handler(events)

    def _await_answer(self, peer: Peer, deadline: float) -> Turn:
        """Wait until the participant is done.

        Raises ParticipantLost when it sends nothing until the deadline, or later for as long again.
        """
        offered = 0
        while peer.done is None:
            left = deadline - time.monotonic()
            self._pump(max(0.0, left))
            if left <= 0.0 and peer.done is None:
                if peer.offered > offered:
                    offered = peer.offered
                    deadline = time.monotonic() + self._timeouts.answer_s
                    continue
                raise ParticipantLost(
                    peer.name, f"did not answer within {self._timeouts.answer_s:g} s: it stalled"
                )
        return peer.turn()

    def _answer_hello(self, control: wire.Control) -> tuple[Peer | None, bytes]:
        """Return the participant that joins, or None, and the record to answer with."""
        nonce, scenario = control.value & 0xFFFF, control.value >> 16
        peer = self._peers.get(control.participant)
        refusal = None
        if control.extra != wire.VERSION:
            refusal = Refusal.VERSION
        elif peer is None or peer.retired:
            refusal = Refusal.UNEXPECTED
        elif peer.joined and peer.nonce != nonce:
            refusal = Refusal.DUPLICATE
        elif scenario and self._scenario and scenario != self._scenario:
            refusal = Refusal.SCENARIO
        if refusal is not None or peer is None:
            name = wire.NAMES.get(control.participant, f"participant number {control.participant}")
            reason = refusal or Refusal.UNEXPECTED
            self.counts.warn(f"a {name} was refused: {wire.reason(reason)}")
            return None, wire.control(Kind.REFUSED, control.participant, reason, nonce)
        peer.nonce = nonce
        return peer, wire.control(Kind.WELCOME, peer.number, wire.VERSION, nonce)

    def _child_ended(self, child: ChildProcess, events: int) -> None:
        self._ignore(child.fileno())
        peer = self._by_name.get(child.name)
        if not self._closed and peer is not None and not peer.retired:
            raise ParticipantLost(child.name, child.how_it_ended() or "died")

    def _connection_lost(self, peer: Peer) -> None:
        """Raise ParticipantLost for a connection that ended, unless the run or its part is over."""
        if self._closed or peer.retired:
            return
        child = self._children.get(peer.name)
        how = child.how_it_ended() if child is not None else None
        raise ParticipantLost(peer.name, how or "closed its connection: it ended or was killed")

    def _warn_foreign(self) -> None:
        self.counts.foreign_frames += 1
        self.counts.warn(
            "frames of programs that take no part in the run were ignored: their instants depend on "
            "the wall clock, so the run could not be repeated"
        )

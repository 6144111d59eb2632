"""The coordinator's side of the lockstep protocol, for participants in other processes."""

from __future__ import annotations

import contextlib
import time
from abc import abstractmethod
from collections.abc import Callable, Sequence
from functools import partial

from can_dbc.frame import EDP_BIT, Frame
from can_dbc.messages import StopReason
from sil.coupling.processes import ChildProcess, sharing_one_core
from sil.coupling.transports import wire
from sil.coupling.transports.channel import Channel, ParticipantLost, Timeouts, Turn, silent
from sil.coupling.transports.server import Connection, Server
from sil.coupling.transports.wire import Kind, Refusal

MOST_OFFERS = 100_000  # frames that a participant may offer in one turn


class Peer:
    """One participant as the coordinator knows it, and the turn being received from it."""

    def __init__(self, name: str, number: int) -> None:
        self.name = name
        self.number = number
        self.child: ChildProcess | None = None  # its process, if the coordinator started it
        self.connection: Connection | None = None
        self.nonce: int | None = None  # that of its Hello; None until it has joined
        self.granted_ns: int | None = None
        self.done: int | None = None
        self.retired = False
        self.delivered = 0  # frames of others passed on since the last grant
        self.waiting: list[bytes] = []  # records that are sent with the next grant
        self.unread = 0  # records broadcast since it was last known to have read all
        self.frames: list[tuple[int, Frame]] = []
        """Frames offered so far in this turn, with their release instants, ns."""
        self._release_ns = 0

    def grant(self, now_ns: int) -> bytes:
        """Begin a turn; return the Grant's record."""
        self.granted_ns = self._release_ns = now_ns
        self.done = None
        delivered, self.delivered = self.delivered, 0
        return wire.control(Kind.GRANT, self.number, delivered, now_ns)

    def take(self, can_id: int, payload: bytes) -> None:
        """Take one record of this participant.  Raises ParticipantLost for a protocol error."""
        if self.granted_ns is None:
            raise self._against_rules(f"sent 0x{can_id:08X} out of its turn")
        control = wire.parse_control(can_id, payload)
        if control is None:
            if not can_id & EDP_BIT:
                what = f"sent 0x{can_id:08X} past the arbitration; expected an offer (EDP set)"
                raise self._against_rules(what)
            self.frames.append((self._release_ns, Frame(can_id & ~EDP_BIT, payload)))
            if len(self.frames) > MOST_OFFERS:
                raise self._against_rules(f"offered more than {MOST_OFFERS} frames in one turn")
        elif control.participant != self.number:
            raise self._against_rules(f"sent as participant number {control.participant}")
        elif control.kind == Kind.RELEASE:
            if control.value < self.granted_ns:
                what = f"released a frame at {control.value} ns; expected {self.granted_ns} ns or later"
                raise self._against_rules(what)
            self._release_ns = control.value
        elif control.kind == Kind.DONE:
            if control.extra != len(self.frames) & 0xFF:
                what = f"offered {control.extra} frames (modulo 256), {len(self.frames)} arrived"
                why = "the channel lost frames, or another program sent some"
                raise self._against_rules(f"{what}: {why}")
            self.done = control.value
            self.granted_ns = None
        elif control.kind == Kind.FAILED:
            how = self.child.how_it_ended(2.0) if self.child is not None else None
            raise ParticipantLost(self.name, how or "failed; its own error output says why")
        else:
            raise self._against_rules(f"sent {control.kind.name}, which only the coordinator sends")

    def _against_rules(self, what: str) -> ParticipantLost:
        return ParticipantLost(self.name, f"broke the lockstep protocol: it {what}")


class RemoteChannel(Channel, Server):
    """A `Channel` to other processes: handshake, turns, timeouts; subclasses move the records."""

    where: str  # how a program joins this channel, for messages

    def __init__(
        self,
        channel: str,
        names: Sequence[str],
        *,
        scenario: int = 0,
        timeouts: Timeouts | None = None,
        say: Callable[[str], None] = silent,
    ) -> None:
        """Open the channel: the name of a local bus, or of a CAN interface.

        `scenario`: 32 bits that distinguish scenarios; 0 joins with any.  `say` takes messages while the
        run waits. Raises RunError when another run uses it, InputError when there can be no such channel.
        """
        Channel.__init__(self, names)
        Server.__init__(self)
        self._by_name = {name: Peer(name, wire.PARTICIPANTS[name]) for name in names}
        self._peers = {peer.number: peer for peer in self._by_name.values()}
        self._scenario = scenario
        self._timeouts = timeouts or Timeouts()
        self._say = say
        self._now_ns = 0
        self._granted: list[Peer] = []
        self._closed = False
        self._closing = contextlib.ExitStack()
        self._open(channel)
        self._attend(self._listener.fileno(), self._accept)

    @abstractmethod
    def _open(self, channel: str) -> None:
        """Open the channel and the listening socket."""

    @abstractmethod
    def _send(self, records: bytes, *peers: Peer) -> None:
        """Send records to these participants (a CAN channel: to everybody)."""

    @abstractmethod
    def _send_stop(self, stop: bytes) -> None:
        """Send the Stop record to everybody."""

    def spawn(self, name: str, command: Sequence[str]) -> ChildProcess:
        """Start `command` as the process of participant `name`, to be watched and ended here."""
        child = ChildProcess(name, command)
        self._by_name[name].child = child
        self._attend(child.fileno(), partial(self._child_ended, child))
        return child

    def start(self, end_ns: int) -> dict[str, int]:
        """Wait for the participants.  Raises ParticipantLost when one does not come in time."""
        deadline = time.monotonic() + self._timeouts.start_s
        say_at = time.monotonic() + 2.0
        peers = self._by_name.values()
        while missing := [p.name for p in peers if p.nonce is None]:
            now = time.monotonic()
            if now >= deadline:
                what = f"did not join within {self._timeouts.start_s:g} s ({self.where})"
                raise ParticipantLost(missing[0], what)
            if now >= say_at:
                say_at = deadline
                self._say(f"waiting for {' and '.join(missing)} to join ({self.where})")
            self._pump(min(deadline, say_at) - now)
        for peer in peers:
            peer.grant(0)  # the turn that ends with the Done of the handshake
        if pids := [child.pid for child in self._children()]:
            self._closing.enter_context(sharing_one_core(pids))
        self._send(wire.control(Kind.START, value=end_ns), *peers)
        answered = time.monotonic() + self._timeouts.answer_s
        return {p.name: self._await_answer(p, answered)[1] for p in peers}

    def begin_turn(self, now_ns: int, names: Sequence[str]) -> None:
        """Note who is granted time."""
        self._pump(0.0)
        self._now_ns = now_ns
        self._granted = [self._by_name[name] for name in names if name in self._by_name]

    def retire(self, name: str) -> None:
        """Grant a participant no more time."""
        peer = self._by_name.get(name)
        if peer is not None and not peer.retired:
            peer.retired = True
            self._send(wire.control(Kind.RETIRE, peer.number), peer)

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
            self._send_stop(wire.control(Kind.STOP, stop, value=self._now_ns))
            deadline = time.monotonic() + (0.0 if aborted else self._timeouts.close_s)
            # A participant closes its connection once its files are complete.
            while any(c.backlog or c.participant for c in self._connections.values()):
                if (left := deadline - time.monotonic()) <= 0.0:
                    break
                self._pump(left)
        finally:
            self._listener.close()
            for connection in self._connections.values():
                connection.socket.close()
            self._connections.clear()
            deadline = time.monotonic() + (0.1 if aborted else self._timeouts.close_s)
            for child in self._children():
                child.end(max(0.0, deadline - time.monotonic()))
                for line in child.printed:
                    self._say(line)
            self._poll.close()
            self._closing.close()

    def _children(self) -> list[ChildProcess]:
        return [peer.child for peer in self._by_name.values() if peer.child is not None]

    def _await_answer(self, peer: Peer, deadline: float) -> Turn:
        """Wait until the participant is done; lost if silent to the deadline, or later as long again."""
        offered = 0
        while peer.done is None:
            left = deadline - time.monotonic()
            self._pump(max(0.0, left))
            if left <= 0.0 and peer.done is None:
                if len(peer.frames) <= offered:
                    what = f"did not answer within {self._timeouts.answer_s:g} s: it stalled"
                    raise ParticipantLost(peer.name, what)
                offered = len(peer.frames)
                deadline = time.monotonic() + self._timeouts.answer_s
        frames, peer.frames = peer.frames, []
        return frames, peer.done

    def _answer_hello(self, control: wire.Control) -> tuple[Peer | None, bytes]:
        """Return the participant that joins, or None, and the record to answer with."""
        nonce, scenario = control.value & 0xFFFF, control.value >> 16
        peer = self._peers.get(control.participant)
        refusal = None
        if control.extra != wire.VERSION:
            refusal = Refusal.VERSION
        elif peer is None or peer.retired:
            refusal = Refusal.UNEXPECTED
        elif peer.nonce not in (None, nonce):
            refusal = Refusal.DUPLICATE
        elif scenario and self._scenario and scenario != self._scenario:
            refusal = Refusal.SCENARIO
        else:
            peer.nonce = nonce
            return peer, wire.control(Kind.WELCOME, peer.number, wire.VERSION, nonce)
        number = control.participant
        names = {number: name for name, number in wire.PARTICIPANTS.items()}
        name = names.get(number, f"participant number {number}")
        self.warn(f"a {name} was refused: {wire.reason(refusal)}")
        return None, wire.control(Kind.REFUSED, number, refusal, nonce)

    def _gone(self, connection: Connection) -> None:
        if connection.participant is not None:
            peer = self._peers[connection.participant]
            self._lost(peer, "closed its connection: it ended or was killed")

    def _child_ended(self, child: ChildProcess, events: int) -> None:
        self._ignore(child.fileno())
        self._lost(self._by_name[child.name], "died")

    def _lost(self, peer: Peer, what: str) -> None:
        """Raise ParticipantLost with how its process ended, or `what`, unless its part is over."""
        if not (self._closed or peer.retired):
            how = peer.child.how_it_ended() if peer.child is not None else None
            raise ParticipantLost(peer.name, how or what)

    def _warn_foreign(self) -> None:
        why = "their instants depend on the wall clock, so the run could not be repeated"
        self.warn(f"frames of programs that take no part in the run were ignored: {why}")

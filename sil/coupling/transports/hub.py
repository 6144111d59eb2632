"""The coordinator's end of the local bus: a hub on a Unix seqpacket socket."""

from __future__ import annotations

import select
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING

from can_dbc.frame import EDP_BIT
from sil.coupling.transports import address, wire
from sil.coupling.transports.channel import ParticipantLost, Turn
from sil.coupling.transports.remote import Peer, RemoteChannel
from sil.coupling.transports.server import Connection
from sil.coupling.transports.wire import Kind, Refusal

if TYPE_CHECKING:
    from sil.coupling.bus import BusFrame

_FLUSH_RECORDS = 512


class Hub(RemoteChannel):
    """A `Channel` over a Unix socket, to participants (connections that send Hello) and to monitors.

    A monitor may come and go and receives each delivered frame with its BusTime. A participant
    receives all frames since its last grant in one datagram with the next grant.
    """

    def _open(self, channel: str) -> None:
        self._listener, self.path = address.listen(channel)
        self.where = f"--channel local:{channel}"
        self._deadline = 0.0

    def deliver(
        self, deliveries: Sequence[BusFrame], bus_off: frozenset[str] = frozenset()
    ) -> None:
        """Send frames to monitors, and queue them for the participants."""
        delivered: list[bytes] = []
        receiving = [p for p in self._peers.values() if not p.retired and p.name not in bus_off]
        for _released_ns, arrival_ns, sender, frame in deliveries:
            number = wire.PARTICIPANTS.get(sender, wire.NOBODY)
            records = wire.announced(number, arrival_ns, frame)
            delivered.append(records)
            for peer in receiving:
                if peer.number != number:
                    peer.waiting.append(records)
                    peer.delivered += 1
        for peer in receiving:
            if len(peer.waiting) >= _FLUSH_RECORDS:
                self._flush(peer)
        for connection in list(self._connections.values()):
            if connection.participant is None:
                for records in delivered:  # one datagram each, hence one wake-up of its reader
                    self._pass(connection, records)

    def begin_turn(self, now_ns: int, names: Sequence[str]) -> None:
        """Send the grants."""
        super().begin_turn(now_ns, names)
        self._deadline = time.monotonic() + self._timeouts.answer_s
        for peer in self._granted:
            peer.waiting.append(peer.grant(now_ns))
            self._flush(peer)

    def end_turn(self) -> dict[str, Turn]:
        """Wait for the answers; see `Channel`."""
        granted, self._granted = self._granted, []
        return {peer.name: self._await_answer(peer, self._deadline) for peer in granted}

    def _flush(self, peer: Peer) -> None:
        waiting, peer.waiting = peer.waiting, []
        for start in range(0, len(waiting), _FLUSH_RECORDS):
            self._send(b"".join(waiting[start : start + _FLUSH_RECORDS]), peer)

    def _send(self, records: bytes, *peers: Peer) -> None:
        for peer in peers:
            assert peer.connection is not None  # it has joined
            try:
                if not peer.connection.send(records):
                    self._poll.modify(peer.connection.fileno, select.EPOLLIN | select.EPOLLOUT)
            except OSError:
                self._lost(peer, "closed its connection: it ended or was killed")

    def _refuse(self, connection: Connection, error: wire.WireError) -> None:
        if connection.participant is not None:
            name = self._peers[connection.participant].name
            raise ParticipantLost(name, f"sent garbage: {error}") from None
        super()._refuse(connection, error)

    def _take(self, connection: Connection, can_id: int, payload: bytes) -> None:
        if connection.participant is not None:
            self._peers[connection.participant].take(can_id, payload)
            return
        control = wire.parse_control(can_id, payload)
        if control is not None and control.kind == Kind.HELLO:
            peer, answer = self._answer_hello(control)
            if peer is not None and peer.connection is None:
                connection.participant, peer.connection = peer.number, connection
            self._pass(connection, answer)
        elif can_id & EDP_BIT:
            raise wire.WireError(f"0x{can_id:08X} from a connection that has not joined the run")
        else:
            self._warn_foreign()
            refused = wire.control(Kind.REFUSED, extra=Refusal.NO_PARTICIPANT)
            self._pass(connection, refused)

    def _send_stop(self, stop: bytes) -> None:
        self._ignore(self._listener.fileno())
        self.path.unlink(missing_ok=True)
        self._listener.close()
        for connection in list(self._connections.values()):
            self._pass(connection, stop)

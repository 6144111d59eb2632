"""The coordinator's end of the local bus: a hub on a Unix seqpacket socket."""

from __future__ import annotations

import select
import socket
import time
from collections import deque
from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING

from can_dbc.frame import EDP_BIT
from sil.coupling.transports import address, wire
from sil.coupling.transports.channel import NOBODY, ParticipantLost, Timeouts, Turn
from sil.coupling.transports.remote import Peer, RemoteChannel, silent
from sil.coupling.transports.wire import Kind, Refusal

if TYPE_CHECKING:
    from sil.coupling.bus import Delivery

_BUFFER_BYTES = wire.LONGEST_BATCH * wire.RECORD_BYTES
_FLUSH_RECORDS = 512
MOST_CLIENTS = 250
MONITOR_BACKLOG_BYTES = 8 << 20
"""A monitor for which more than this waits unread (some 250,000 frames) is disconnected."""


class _Client:
    """One connection, and the records that could not be sent on it yet."""

    def __init__(self, connection: socket.socket) -> None:
        connection.setblocking(False)
        self.connection = connection
        self.fileno = connection.fileno()
        self.peer: Peer | None = None
        self.backlog: deque[bytes] = deque()
        self.backlog_bytes = 0

    def send(self, records: bytes) -> bool:
        """Send or queue records; return whether everything is sent.  Raises OSError."""
        if not self.backlog:
            try:
                self.connection.send(records)
            except BlockingIOError:
                pass
            else:
                return True
        self.backlog.append(records)
        self.backlog_bytes += len(records)
        return False

    def drain(self) -> bool:
        """Send queued records; return whether everything is sent.  Raises OSError."""
        while self.backlog:
            try:
                self.connection.send(self.backlog[0])
            except BlockingIOError:
                return False
            self.backlog_bytes -= len(self.backlog.popleft())
        return True


class Hub(RemoteChannel):
    """A `Channel` over a Unix socket, to participants and to monitors.

    A connection that sends Hello is a participant.  Every other one is a monitor: it may come and go
    at any time and receives each delivered frame with its BusTime.  A participant receives all
    frames since its last grant in one datagram with the next grant.
    """

    def __init__(
        self,
        channel: str,
        names: Sequence[str],
        *,
        scenario: int = 0,
        timeouts: Timeouts | None = None,
        say: Callable[[str], None] = silent,
        share_core: bool = True,
    ) -> None:
        """Open the channel; parameters as for `RemoteChannel`.

        Raises RunError when another hub uses it, InputError for a name that no channel can have.
        """
        self._listener, self.path = address.listen(channel)
        self.channel = channel
        super().__init__(names, scenario, timeouts or Timeouts(), say, share_core)
        self._buffer = bytearray(_BUFFER_BYTES + 1)
        self._clients: dict[int, _Client] = {}
        self._client_of: dict[int, _Client] = {}
        self._waiting: dict[int, list[bytes]] = {number: [] for number in self._peers}
        self._granted: list[Peer] = []
        self._deadline = 0.0
        self._served_first = self._listener.fileno()
        self._attend(self._served_first, self._accept)

    def deliver(self, deliveries: Sequence[Delivery], bus_off: frozenset[str] = NOBODY) -> None:
        """Send frames to monitors, and queue them for the participants."""
        delivered: list[bytes] = []
        receiving = {n: w for n, w in self._waiting.items() if self._peers[n].name not in bus_off}
        for delivery in deliveries:
            sender = wire.PARTICIPANTS.get(delivery.sender, wire.NOBODY)
            records = wire.announced(sender, delivery.arrival_ns, delivery.frame)
            delivered.append(records)
            for number, waiting in receiving.items():
                if number != sender:
                    waiting.append(records)
                    self._peers[number].delivered += 1
        for number, waiting in receiving.items():
            if len(waiting) >= _FLUSH_RECORDS:
                self._flush(self._peers[number])
        for client in list(self._clients.values()):
            if client.peer is None:  # one frame per datagram, hence per wake-up of its reader
                for records in delivered:
                    self._send_monitor(client, records)

    def begin_turn(self, now_ns: int, names: Sequence[str]) -> None:
        """Send the grants."""
        self._pump(0.0)
        self._now_ns = now_ns
        self._deadline = time.monotonic() + self._timeouts.answer_s
        for name in names:
            peer = self._by_name.get(name)
            if peer is not None:
                self._granted.append(peer)
                self._waiting[peer.number].append(peer.grant(now_ns))
                self._flush(peer)

    def end_turn(self) -> dict[str, Turn]:
        """Wait for the answers; see `Channel`."""
        granted, self._granted = self._granted, []
        return {peer.name: self._await_answer(peer, self._deadline) for peer in granted}

    def _flush(self, peer: Peer) -> None:
        waiting = self._waiting[peer.number]
        self._waiting[peer.number] = []
        for start in range(0, len(waiting), _FLUSH_RECORDS):
            self._send(peer, b"".join(waiting[start : start + _FLUSH_RECORDS]))

    def _send(self, peer: Peer, records: bytes) -> None:
        client = self._client_of[peer.number]
        try:
            if not client.send(records):
                self._poll.modify(client.fileno, select.EPOLLIN | select.EPOLLOUT)
        except OSError:
            self._connection_lost(peer)

    def _send_all(self, records: bytes) -> None:
        for peer in self._peers.values():
            self._send(peer, records)

    def _send_monitor(self, client: _Client, records: bytes) -> None:
        try:
            if client.send(records):
                return
        except OSError:
            self._disconnect(client)
            return
        if client.backlog_bytes > MONITOR_BACKLOG_BYTES:
            self.counts.warn(
                f"a monitor that did not read was disconnected "
                f"({client.backlog_bytes >> 20} MiB of frames waited for it)"
            )
            self._disconnect(client)
        else:
            self._poll.modify(client.fileno, select.EPOLLIN | select.EPOLLOUT)

    def _release(self, peer: Peer) -> None:
        del self._waiting[peer.number]

    def _where(self) -> str:
        return f"--channel local:{self.channel}"

    def _accept(self, events: int) -> None:
        while True:
            try:
                connection, _ = self._listener.accept()
            except BlockingIOError:
                return
            if len(self._clients) >= MOST_CLIENTS:
                self.counts.warn(f"more than {MOST_CLIENTS} connections: further ones were closed")
                connection.close()
                continue
            client = _Client(connection)
            self._clients[client.fileno] = client
            self._attend(client.fileno, partial(self._serve_client, client))

    def _serve_client(self, client: _Client, events: int) -> None:
        if events & select.EPOLLOUT:
            try:
                if client.drain():
                    self._poll.modify(client.fileno, select.EPOLLIN)
            except OSError:
                self._disconnect(client)
                return
        if events & ~select.EPOLLOUT:
            self._read(client)

    def _read(self, client: _Client) -> None:
        try:
            length = client.connection.recv_into(self._buffer)
        except BlockingIOError:
            return
        except OSError:
            length = 0
        if length == 0:
            self._disconnect(client)
            return
        try:
            if length > _BUFFER_BYTES:
                raise wire.WireError(f"more than {wire.LONGEST_BATCH} records in one datagram")
            with memoryview(self._buffer) as view:
                records = list(wire.split(view[:length]))
            for can_id, payload in records:
                self._take(client, can_id, payload)
        except wire.WireError as error:
            self.counts.garbage += 1
            if client.peer is not None:
                raise ParticipantLost(client.peer.name, f"sent garbage: {error}") from None
            self.counts.warn(f"a connection that sent garbage was closed: {error}")
            self._disconnect(client)

    def _take(self, client: _Client, can_id: int, payload: bytes) -> None:
        if client.peer is not None:
            client.peer.take(can_id, payload)
            return
        control = wire.parse_control(can_id, payload)
        if control is not None and control.kind == Kind.HELLO:
            peer, answer = self._answer_hello(control)
            if peer is not None and peer.number not in self._client_of:
                client.peer = peer
                self._client_of[peer.number] = client
            self._send_monitor(client, answer)
        elif can_id & EDP_BIT:
            raise wire.WireError(f"0x{can_id:08X} from a connection that has not joined the run")
        else:
            self._warn_foreign()
            refused = wire.control(Kind.REFUSED, extra=Refusal.NO_PARTICIPANT)
            self._send_monitor(client, refused)

    def _disconnect(self, client: _Client) -> None:
        if self._clients.pop(client.fileno, None) is None:
            return
        self._ignore(client.fileno)
        client.connection.close()
        if client.peer is not None:
            self._connection_lost(client.peer)

    def _close_channel(self, stop: bytes, aborted: bool) -> None:
        self._ignore(self._listener.fileno())
        self.path.unlink(missing_ok=True)
        self._listener.close()
        for client in list(self._clients.values()):
            self._send_monitor(client, stop)
        deadline = time.monotonic() + (0.0 if aborted else self._timeouts.close_s)
        # A participant closes its connection once its files are complete.
        while any(client.backlog or client.peer for client in self._clients.values()):
            left = deadline - time.monotonic()
            if left <= 0.0:
                break
            self._pump(left)
        for client in self._clients.values():
            client.connection.close()
        self._clients.clear()

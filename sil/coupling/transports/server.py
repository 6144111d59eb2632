"""A listening Unix socket and its connections, served without ever waiting for a reader."""

from __future__ import annotations

import select
import socket
import threading
import time
from collections import deque
from collections.abc import Callable
from functools import partial

from can_dbc.frame import EDP_BIT, Frame
from can_dbc.messages import StopReason
from sil.coupling.transports import address, wire
from sil.coupling.transports.wire import Kind


class Connection:
    """An accepted connection, and the records that could not be sent on it yet."""

    def __init__(self, accepted: socket.socket) -> None:
        accepted.setblocking(False)
        self.socket = accepted
        self.fileno = accepted.fileno()
        self.participant: int | None = None  # its number, when it has joined
        self.echo = False  # whether it receives its own frames, too
        self.backlog: deque[bytes] = deque()
        self.backlog_bytes = 0

    def send(self, records: bytes) -> bool:
        """Send or queue records; return whether everything is sent.  Raises OSError."""
        self.backlog.append(records)
        self.backlog_bytes += len(records)
        return self.drain()

    def drain(self) -> bool:
        """Send queued records; return whether everything is sent.  Raises OSError."""
        while self.backlog:
            try:
                self.socket.send(self.backlog[0])
            except BlockingIOError:
                return False
            self.backlog_bytes -= len(self.backlog.popleft())
        return True


class Server:
    """Accepts connections, takes the records that they send, and queues what a slow one reads later."""

    _listener: socket.socket
    most_waiting_bytes = 8 << 20  # for a monitor (some 250,000 frames), which is disconnected then

    def __init__(self) -> None:
        self._connections: dict[int, Connection] = {}
        self._buffer = bytearray(wire.LONGEST_BATCH * wire.RECORD_BYTES + 1)
        self._poll = select.epoll()
        self._handlers: dict[int, Callable[[int], None]] = {}

    def warn(self, message: str) -> None:
        """Take a line for the user."""

    def _take(self, connection: Connection, can_id: int, payload: bytes) -> None:
        """Take one record.  Raises WireError for one that closes the connection."""

    def _welcome(self, connection: Connection) -> None:
        """Greet a new connection."""

    def _gone(self, connection: Connection) -> None:
        """Note that a connection is closed."""

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
            ready.sort(key=lambda entry: entry[0] != self._listener.fileno())
        for fileno, events in ready:
            handler = self._handlers.get(fileno)
            if handler is not None:
                handler(events)

    def _accept(self, events: int) -> None:
        while True:
            try:
                accepted, _ = self._listener.accept()
            except BlockingIOError:
                return
            if len(self._connections) >= 250:
                self.warn("more than 250 connections: further ones were closed")
                accepted.close()
                continue
            connection = Connection(accepted)
            self._connections[connection.fileno] = connection
            self._attend(connection.fileno, partial(self._serve, connection))
            self._welcome(connection)

    def _serve(self, connection: Connection, events: int) -> None:
        length = 0
        try:
            if events & select.EPOLLOUT and connection.drain():
                self._poll.modify(connection.fileno, select.EPOLLIN)
            if events == select.EPOLLOUT:
                return
            length = connection.socket.recv_into(self._buffer)
        except BlockingIOError:
            return
        except OSError:
            pass
        if length == 0:
            self._disconnect(connection)
        else:
            self._receive(connection, length)

    def _receive(self, connection: Connection, length: int) -> None:
        """Take a datagram, which the buffer holds."""
        try:
            if length == len(self._buffer):
                raise wire.WireError(f"more than {wire.LONGEST_BATCH} records in one datagram")
            with memoryview(self._buffer) as view:
                records = list(wire.split(view[:length]))
            for can_id, payload in records:
                self._take(connection, can_id, payload)
        except wire.WireError as error:
            self._refuse(connection, error)

    def _refuse(self, connection: Connection, error: wire.WireError) -> None:
        self.warn(f"a connection that sent garbage was closed: {error}")
        self._disconnect(connection)

    def _pass(self, connection: Connection, records: bytes) -> None:
        """Send records to a monitor, which is disconnected when it does not read."""
        try:
            if connection.send(records):
                return
        except OSError:
            self._disconnect(connection)
            return
        if connection.backlog_bytes > self.most_waiting_bytes:
            waited = f"{connection.backlog_bytes >> 20} MiB of frames waited for it"
            self.warn(f"a monitor that did not read was disconnected ({waited})")
            self._disconnect(connection)
        else:
            self._poll.modify(connection.fileno, select.EPOLLIN | select.EPOLLOUT)

    def _disconnect(self, connection: Connection) -> None:
        if self._connections.pop(connection.fileno, None) is not None:
            self._ignore(connection.fileno)
            connection.socket.close()
            self._gone(connection)


_EPOCH_BITS = (1 << 48) - 1


def epoch_ns(stamp: int, now_ns: int) -> int:
    """Return the instant (ns since 1970) before `now_ns` whose low 48 bits are the stamp."""
    return now_ns - ((now_ns - stamp) & _EPOCH_BITS)


class Relay(Server):
    """A hub without a run of its own, in a thread. Raises RunError when another run uses the channel.

    It greets each connection with Start and passes each frame on at once with its BusTime, the low 48
    bits of ns since 1970. A sender receives its own frames if it asked so by Monitor.
    """

    def __init__(self, channel: str) -> None:
        super().__init__()
        self._listener, self._path = address.listen(channel)
        self._attend(self._listener.fileno(), self._accept)
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"relay {channel}", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Announce the end to all connections and close them."""
        self._closing.set()
        self._thread.join()

    def warn(self, message: str) -> None:
        """Drop the line: a node that misses frames reports it itself."""

    def _run(self) -> None:
        while not self._closing.is_set():
            self._pump(0.2)
        self._path.unlink(missing_ok=True)
        self._listener.close()
        for connection in list(self._connections.values()):
            self._pass(connection, wire.control(Kind.STOP, StopReason.END))
            connection.socket.close()
        self._poll.close()

    def _welcome(self, connection: Connection) -> None:
        self._pass(connection, wire.control(Kind.START))

    def _take(self, connection: Connection, can_id: int, payload: bytes) -> None:
        connection.echo |= can_id == Kind.MONITOR
        if can_id & EDP_BIT:
            return
        stamp = time.time_ns() & _EPOCH_BITS
        records = wire.announced(wire.NOBODY, stamp, Frame(can_id, payload))
        for other in list(self._connections.values()):
            if other is not connection or other.echo:
                self._pass(other, records)

"""The local bus of a free-running system: every frame goes to everybody, stamped on arrival."""

from __future__ import annotations

import select
import threading
import time

from can_dbc.frame import EDP_BIT, Frame
from can_dbc.messages import StopReason
from sil.coupling.transports import address, wire
from sil.coupling.transports.hub import MONITOR_BACKLOG_BYTES
from sil.coupling.transports.remote import BUFFER_BYTES, MOST_CONNECTIONS, Connection
from sil.coupling.transports.wire import Kind

_EPOCH_BITS = (1 << 48) - 1
_CHECK_S = 0.2


def epoch_ns(stamp: int, now_ns: int) -> int:
    """Return the instant (ns since 1970) before `now_ns` whose low 48 bits are the stamp."""
    return now_ns - ((now_ns - stamp) & _EPOCH_BITS)


class Relay(threading.Thread):
    """A hub without a run of its own, in a thread; `close` ends it.

    It greets each connection with Start, takes frames from all of them, and passes each one on with
    its BusTime, the low 48 bits of ns since 1970. A sender receives its own frames if it asked so by
    Monitor. There is neither arbitration nor a bit rate: a frame arrives at once.
    """

    def __init__(self, channel: str) -> None:
        """Listen.  Raises RunError when another run uses the channel."""
        super().__init__(name=f"relay {channel}", daemon=True)
        self._listener, self._path = address.listen(channel)
        self._connections: dict[int, Connection] = {}
        self._echo: set[int] = set()
        self._buffer = bytearray(BUFFER_BYTES + 1)
        self._poll = select.epoll()
        self._poll.register(self._listener.fileno(), select.EPOLLIN)
        self._closing = threading.Event()
        self.start()

    def close(self) -> None:
        """Announce the end to all connections and close them."""
        self._closing.set()
        self.join()

    def run(self) -> None:
        """Serve until closed; the thread's own function."""
        while not self._closing.is_set():
            for fileno, events in self._poll.poll(_CHECK_S):
                if fileno == self._listener.fileno():
                    self._accept()
                elif fileno in self._connections:
                    self._serve(self._connections[fileno], events)
        self._path.unlink(missing_ok=True)
        self._listener.close()
        for connection in list(self._connections.values()):
            self._send(connection, wire.control(Kind.STOP, StopReason.END))
            connection.socket.close()
        self._poll.close()

    def _accept(self) -> None:
        accepted, _ = self._listener.accept()
        if len(self._connections) >= MOST_CONNECTIONS:
            accepted.close()
            return
        connection = Connection(accepted)
        self._connections[connection.fileno] = connection
        self._poll.register(connection.fileno, select.EPOLLIN)
        self._send(connection, wire.control(Kind.START))

    def _serve(self, connection: Connection, events: int) -> None:
        try:
            if events & select.EPOLLOUT and connection.drain():
                self._poll.modify(connection.fileno, select.EPOLLIN)
            if not events & ~select.EPOLLOUT:
                return
            length = connection.socket.recv_into(self._buffer)
            if not length:
                raise ConnectionResetError
            for can_id, payload in list(wire.split(bytes(self._buffer[:length]))):
                self._take(connection, can_id, payload)
        except BlockingIOError:
            return
        except (OSError, wire.WireError):
            self._disconnect(connection)

    def _take(self, sender: Connection, can_id: int, payload: bytes) -> None:
        if can_id == Kind.MONITOR:
            self._echo.add(sender.fileno)
        if can_id & EDP_BIT:
            return
        stamp = time.time_ns() & _EPOCH_BITS
        records = wire.announced(wire.NOBODY, stamp, Frame(can_id, payload))
        for connection in list(self._connections.values()):
            if connection is not sender or sender.fileno in self._echo:
                self._send(connection, records)

    def _send(self, connection: Connection, records: bytes) -> None:
        try:
            if not connection.send(records):
                self._poll.modify(connection.fileno, select.EPOLLIN | select.EPOLLOUT)
        except OSError:
            self._disconnect(connection)
            return
        if connection.backlog_bytes > MONITOR_BACKLOG_BYTES:
            self._disconnect(connection)

    def _disconnect(self, connection: Connection) -> None:
        if self._connections.pop(connection.fileno, None) is not None:
            self._echo.discard(connection.fileno)
            self._poll.unregister(connection.fileno)
            connection.socket.close()

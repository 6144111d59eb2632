"""The local bus of a free-running system: every frame goes to everybody, stamped on arrival."""

from __future__ import annotations

import threading
import time

from can_dbc.frame import EDP_BIT, Frame
from can_dbc.messages import StopReason
from sil.coupling.transports import address, wire
from sil.coupling.transports.server import Connection, Server
from sil.coupling.transports.wire import Kind

_EPOCH_BITS = (1 << 48) - 1


def epoch_ns(stamp: int, now_ns: int) -> int:
    """Return the instant (ns since 1970) before `now_ns` whose low 48 bits are the stamp."""
    return now_ns - ((now_ns - stamp) & _EPOCH_BITS)


class Relay(Server):
    """A hub without a run of its own, in a thread; `close` ends it.

    It greets each connection with Start and passes each frame on at once with its BusTime, the low 48
    bits of ns since 1970. A sender receives its own frames if it asked so by Monitor.
    """

    def __init__(self, channel: str) -> None:
        """Listen.  Raises RunError when another run uses the channel."""
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

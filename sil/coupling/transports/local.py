"""The local bus for python-can: `can.Bus(interface="opc4local", channel="NAME")`."""

from __future__ import annotations

import select
import socket
import time
from collections import deque
from collections.abc import Sequence
from typing import Any

import can
from can.typechecking import AutoDetectedConfig

from can_dbc.errors import InputError, RunError
from can_dbc.frame import EDP_BIT
from can_dbc.messages import StopReason
from sil.coupling.clock import to_seconds
from sil.coupling.transports import address, wire
from sil.coupling.transports.wire import Kind

ONLY_CHANNEL = "auto"
_ECHO = 1


class LocalBus(can.BusABC):
    """One connection to a local bus: a monitor of a lockstep run, or a node of a plain bus.

    In a run, messages carry the simulated time of their arrival in seconds; on a plain bus, the
    wall time of their receipt.  A run takes no frames from outside: sending one is refused, which
    the next `send` or `recv` raises.  Only classic data frames with 29-bit identifiers travel here.
    Checked by test_local_bus.
    """

    def __init__(
        self,
        channel: str = ONLY_CHANNEL,
        can_filters: can.typechecking.CanFilters | None = None,
        receive_own_messages: bool = False,
        **ignored: Any,
    ) -> None:
        """Connect to the hub of `channel`; "auto" means the only one that runs.

        Raises can.CanInitializationError when there is none.
        """
        try:
            self._path = address.socket_path(
                _only_channel() if channel == ONLY_CHANNEL else str(channel)
            )
        except (InputError, RunError) as error:
            raise can.CanInitializationError(str(error)) from None
        self._connection: socket.socket | None = None
        connection = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        try:
            connection.connect(str(self._path))
        except OSError as error:
            connection.close()
            raise can.CanInitializationError(
                f"opc4local: no hub on {self._path}: {error.strerror}"
            ) from None
        connection.setblocking(False)
        self._connection = connection
        self._buffer = bytearray(wire.LONGEST_BATCH * wire.RECORD_BYTES)
        self._received: deque[can.Message] = deque()
        self._arrival: wire.Control | None = None
        self._failure: str | None = None
        self.channel_info = f"opc4local {self._path}"
        if receive_own_messages:
            self._send(wire.control(Kind.MONITOR, extra=_ECHO), None)
        super().__init__(channel=channel, can_filters=can_filters)

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        deadline = None if timeout is None else time.monotonic() + timeout
        while not self._received:
            connection = self._open()
            try:
                length = connection.recv_into(self._buffer)
            except BlockingIOError:
                left = None if deadline is None else max(0.0, deadline - time.monotonic())
                if not _ready(connection, select.POLLIN, left):
                    return None, False
                continue
            except OSError as error:
                raise can.CanOperationError(f"{self.channel_info}: {error.strerror}") from None
            if length == 0:
                self._failure = self._failure or (
                    "the hub closed the connection: it ended, or this program did not read"
                )
                continue
            with memoryview(self._buffer) as view:
                for can_id, payload in wire.split(view[:length]):
                    self._take(can_id, payload)
        return self._received.popleft(), False

    def _take(self, can_id: int, payload: bytes) -> None:
        said = wire.parse_control(can_id, payload)
        if said is None:
            self._received.append(self._message(can_id, payload))
        elif said.kind == Kind.BUS_TIME:
            self._arrival = said
        elif said.kind == Kind.REFUSED:
            self._failure = f"frame refused: {wire.reason(said.extra)}"
        elif said.kind == Kind.STOP:
            regular = said.participant == StopReason.END
            self._failure = "the run has ended" + ("" if regular else " early")

    def _message(self, can_id: int, payload: bytes) -> can.Message:
        arrival, self._arrival = self._arrival, None
        return can.Message(
            timestamp=time.time() if arrival is None else to_seconds(arrival.value),
            arbitration_id=can_id,
            is_extended_id=True,
            data=payload,
            channel=self._path.stem,
        )

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        if msg.is_fd or msg.is_error_frame or msg.is_remote_frame or not msg.is_extended_id:
            raise can.CanOperationError(
                f"{self.channel_info}: cannot carry {msg}; "
                "expected a classic data frame with a 29-bit identifier"
            )
        if msg.arbitration_id & EDP_BIT:
            raise can.CanOperationError(
                f"{self.channel_info}: identifier 0x{msg.arbitration_id:08X} has bit 25 (EDP) set, "
                "which marks lockstep traffic"
            )
        payload = bytes(msg.data)
        self._send(
            wire.RECORD.pack(msg.arbitration_id | wire.EXTENDED, len(payload), payload), timeout
        )

    def _send(self, record: bytes, timeout: float | None) -> None:
        deadline = None if timeout is None else time.monotonic() + timeout
        connection = self._open()
        while True:
            try:
                connection.send(record)
                return
            except BlockingIOError:
                left = None if deadline is None else max(0.0, deadline - time.monotonic())
                if not _ready(connection, select.POLLOUT, left):
                    raise can.CanTimeoutError(f"{self.channel_info}: send timed out") from None
            except OSError as error:
                raise can.CanOperationError(f"{self.channel_info}: {error.strerror}") from None

    def _open(self) -> socket.socket:
        """Return the connection; raises can.CanOperationError when it is closed or has failed."""
        if self._connection is None:
            raise can.CanOperationError(f"{self.channel_info}: the bus is shut down")
        if self._failure is not None:
            raise can.CanOperationError(f"{self.channel_info}: {self._failure}")
        return self._connection

    def fileno(self) -> int:
        """Return the descriptor to wait on; -1 after shutdown.

        One wake-up may stand for several messages: read with `recv(0)` until it returns None.
        """
        return -1 if self._connection is None else self._connection.fileno()

    def shutdown(self) -> None:
        super().shutdown()
        if self._connection is not None:
            self._connection.close()
            self._connection = None

    @staticmethod
    def _detect_available_configs() -> Sequence[AutoDetectedConfig]:
        return [{"interface": "opc4local", "channel": name} for name in address.running_channels()]


def _only_channel() -> str:
    running = address.running_channels()
    if len(running) != 1:
        raise InputError(f"opc4local: {len(running)} buses run ({', '.join(running)}); name one")
    return running[0]


def _ready(connection: socket.socket, event: int, timeout_s: float | None) -> bool:
    poll = select.poll()
    poll.register(connection.fileno(), event)
    return bool(poll.poll(None if timeout_s is None else timeout_s * 1000.0))

"""The local bus for python-can: `can.Bus(interface="opc4local", channel="NAME")`.

Its socket, which needs no root: `address`; what passes frames on: `hub`.
"""

from __future__ import annotations

import select
import socket
import time
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any

import can
from can.typechecking import AutoDetectedConfig

from can_dbc.errors import InputError, RunError
from can_dbc.frame import Frame
from can_dbc.messages import StopReason
from sil.coupling.clock import to_seconds
from sil.coupling.transports import address, wire
from sil.coupling.transports.channel import silent
from sil.coupling.transports.server import epoch_ns
from sil.coupling.transports.wire import Kind

_GREETING_S = 1.0


class RunEnded(can.CanOperationError):
    """The run whose bus this is has ended."""


class LocalBus(can.BusABC):
    """The local bus of a run, for any program: in lockstep a listener by simulated time, else for everybody."""

    def __init__(
        self,
        channel: str = "auto",
        can_filters: can.typechecking.CanFilters | None = None,
        receive_own_messages: bool = False,
        wait_s: float = 0.0,
        say: Callable[[str], None] = silent,
        **ignored: Any,
    ) -> None:
        """Connect to the run on `channel`; "auto": the only one. Raises can.CanInitializationError without one.

        `wait_s`: how long it is waited for; `say` takes the message that it is.
        """
        self._connection: socket.socket | None = None
        try:
            name = _only_channel() if channel == "auto" else str(channel)
            self._path = address.socket_path(name)
            self._connection = address.connect(name, wait_s, say)
        except (InputError, RunError) as error:
            raise can.CanInitializationError(f"opc4local: {error}") from error
        self._connection.setblocking(False)
        self._buffer = bytearray(wire.LONGEST_BATCH * wire.RECORD_BYTES)
        self._received: deque[can.Message] = deque()
        self._arrival_ns = 0
        self._failure: str | None = None
        self._ended = False
        self._echo = receive_own_messages
        self._free: bool | None = None
        self.channel_info = f"opc4local {self._path}"
        super().__init__(channel=channel, can_filters=can_filters)

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        deadline = None if timeout is None else time.monotonic() + timeout
        while not self._received:
            left = None if deadline is None else max(0.0, deadline - time.monotonic())
            if not self._read(left):
                return None, False
        return self._received.popleft(), True

    def _read(self, timeout_s: float | None) -> bool:
        """Take a datagram; return whether there was one in time.  Raises can.CanOperationError."""
        connection = self._open()
        try:
            length = connection.recv_into(self._buffer)
        except BlockingIOError:
            poll = select.poll()
            poll.register(connection.fileno(), select.POLLIN)
            return bool(poll.poll(None if timeout_s is None else timeout_s * 1000.0))
        except OSError as error:
            raise can.CanOperationError(f"{self.channel_info}: {error.strerror}") from None
        if length == 0:
            why = "it was killed, or this program did not read"
            self._failure = self._failure or f"the run closed the connection: {why}"
        with memoryview(self._buffer) as view:
            for can_id, payload in wire.split(view[:length]):
                self._take(can_id, payload)
        return True

    def _take(self, can_id: int, payload: bytes) -> None:
        control = wire.parse_control(can_id, payload)
        if control is None:
            stamp_s, channel = to_seconds(self._arrival_ns), self._path.stem
            message = can.Message(stamp_s, can_id, True, data=payload, channel=channel)
            if self._matches_filters(message):  # here: recv(0) ends at a message that is left out
                self._received.append(message)
        elif control.kind == Kind.BUS_TIME:
            self._free = bool(self._free)
            self._arrival_ns = control.value
            if self._free:
                self._arrival_ns = epoch_ns(control.value, time.time_ns())
        elif control.kind == Kind.START:
            self._free = True
            if self._echo and self._connection is not None:
                self._connection.send(wire.control(Kind.MONITOR, extra=1))
        elif control.kind == Kind.STOP:
            self._ended = True
            regular = control.participant == StopReason.END
            self._failure = "the run has ended" + ("" if regular else " early")

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send on a free-running bus. Raises can.CanOperationError in lockstep or for a wrong frame."""
        connection = self._open()
        deadline = time.monotonic() + _GREETING_S
        while self._free is None and (left := deadline - time.monotonic()) > 0.0:
            self._read(left)
        classic = msg.is_extended_id and not (msg.is_fd or msg.is_remote_frame)
        frame = Frame(msg.arbitration_id, bytes(msg.data))
        if not (self._free and classic and wire.can_be_offered(frame)):
            reason = wire.reason(wire.Refusal.NO_PARTICIPANT)
            if self._free:
                reason = "expected a classic data frame with a 29-bit identifier, EDP clear"
            raise can.CanOperationError(f"{self.channel_info}: frame refused: {reason}")
        try:
            connection.settimeout(timeout or _GREETING_S)
            connection.send(wire.real(frame))
        except OSError as error:
            raise can.CanOperationError(f"{self.channel_info}: {error.strerror}") from None
        finally:
            connection.setblocking(False)

    def _open(self) -> socket.socket:
        if self._connection is None:
            raise can.CanOperationError(f"{self.channel_info}: the bus is shut down")
        if self._ended:
            raise RunEnded(f"{self.channel_info}: {self._failure}")
        if self._failure is not None:
            raise can.CanOperationError(f"{self.channel_info}: {self._failure}")
        return self._connection

    def fileno(self) -> int:
        """Return the descriptor to wait on, -1 after shutdown; read on until `recv(0)` returns None."""
        return -1 if self._connection is None else self._connection.fileno()

    def shutdown(self) -> None:
        """Close the connection."""
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
        names = f" ({', '.join(running)}): name one" if running else ""
        raise InputError(f"{len(running)} runs found{names}")
    return running[0]

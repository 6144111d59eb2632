"""The coordinator's end of a SocketCAN channel: raw sockets that report every lost frame."""

from __future__ import annotations

import errno
import socket
import struct
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING

from can_dbc.errors import InputError, RunError
from can_dbc.frame import EDP_BIT, MAX_ID, PAGE_BITS, SOCKETCAN_EXTENDED, SOCKETCAN_FRAME
from sil.coupling.transports import wire
from sil.coupling.transports.channel import ParticipantLost, Turn
from sil.coupling.transports.remote import Peer, RemoteChannel
from sil.coupling.transports.server import Connection
from sil.coupling.transports.wire import Kind

if TYPE_CHECKING:
    from sil.coupling.bus import BusFrame

_SO_RXQ_OVFL = 40
_REMOTE_FRAME = 0x4000_0000
_FULL_QUEUE_WAIT_S = 2.0

PARTICIPANT_VIEW = (
    (SOCKETCAN_EXTENDED, SOCKETCAN_EXTENDED | _REMOTE_FRAME | EDP_BIT),
    (SOCKETCAN_EXTENDED | PAGE_BITS, SOCKETCAN_EXTENDED | _REMOTE_FRAME | PAGE_BITS),
)
"""Kernel filters: 29-bit data frames without other participants' offers."""


class CanSocket:
    """A raw CAN socket that waits while the queue is full. Raises InputError for no such interface."""

    def __init__(self, interface: str, filters: Sequence[tuple[int, int]]) -> None:
        self.interface = interface
        expected = "expected inproc, local, local:NAME, or the name of a CAN interface"
        try:
            self._socket = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
        except OSError as error:
            what = f"this kernel has no SocketCAN ({error.strerror})"
            raise InputError(f"channel {interface!r}: {what}; {expected}") from None
        try:
            packed = b"".join(struct.pack("=II", *entry) for entry in filters)
            self._socket.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, packed)
            self._socket.setsockopt(socket.SOL_SOCKET, _SO_RXQ_OVFL, 1)
            try:  # SO_RCVBUFFORCE, which the module socket does not have
                self._socket.setsockopt(socket.SOL_SOCKET, 33, 8 << 20)
            except PermissionError:  # the system's limit holds for others than root
                self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 8 << 20)
            self._socket.bind((interface,))
            self._socket.setblocking(False)
        except OSError as error:
            self._socket.close()
            what = f"{error.strerror}; {expected} that is up"
            raise InputError(f"channel {interface!r}: {what}") from None

    def fileno(self) -> int:
        """Return the socket's descriptor."""
        return self._socket.fileno()

    def send(self, records: bytes) -> None:
        """Send the records, one frame each.  Raises RunError when the interface takes none."""
        for start in range(0, len(records), wire.RECORD_BYTES):
            deadline = time.monotonic() + _FULL_QUEUE_WAIT_S
            while not self._sent(records[start : start + wire.RECORD_BYTES], deadline):
                time.sleep(0.0005)

    def _sent(self, record: bytes, deadline: float) -> bool:
        """Send a record; return whether there was room in the interface's queue, which poll does not report."""
        try:
            self._socket.send(record)
        except OSError as error:
            if error.errno not in (errno.ENOBUFS, errno.EAGAIN):
                raise RunError(f"channel {self.interface!r}: {error.strerror}") from None
            if time.monotonic() > deadline:
                what = f"took no frame for {_FULL_QUEUE_WAIT_S:g} s ({error.strerror})"
                raise RunError(f"channel {self.interface!r}: {what}") from None
            return False
        return True

    def receive(self) -> tuple[int, bytes] | None:
        """Return identifier and data of the next frame, or None. Raises RunError when frames were lost."""
        try:
            record, ancillary, _, _ = self._socket.recvmsg(wire.RECORD_BYTES, 64)
        except BlockingIOError:
            return None
        except OSError as error:
            raise RunError(f"channel {self.interface!r}: {error.strerror}") from None
        for level, kind, payload in ancillary:
            is_count = level == socket.SOL_SOCKET and kind == _SO_RXQ_OVFL
            if is_count and (lost := int.from_bytes(payload, "little")):
                what = f"{lost} frames were lost, the receive buffer overflowed"
                raise RunError(f"channel {self.interface!r}: {what}")
        flagged_id, length, payload = SOCKETCAN_FRAME.unpack(record)
        return flagged_id & MAX_ID, payload[:length]

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


def lifeline_address(interface: str) -> str:
    """Return the abstract Unix socket of the run on an interface of this network namespace."""
    return f"\0opc4-lockstep/{interface}"


class SocketCan(RemoteChannel):
    """A `Channel` over a SocketCAN interface.

    Everything is broadcast, so participants of one instant take turns one after the other. An abstract
    Unix socket refuses a second coordinator and shows when a participant connected to it dies; the
    death of another is noticed after `Timeouts.answer_s`.
    """

    def _open(self, channel: str) -> None:
        self._can = CanSocket(channel, ((SOCKETCAN_EXTENDED, SOCKETCAN_EXTENDED | _REMOTE_FRAME),))
        self._closing.callback(self._can.close)
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        try:
            self._listener.bind(lifeline_address(channel))
        except OSError:
            self._listener.close()
            self._closing.close()
            raise RunError(f"channel {channel!r}: another run uses it") from None
        self._listener.listen(16)
        self._listener.setblocking(False)
        self.where = f"--channel {channel}"
        self._speaker: Peer | None = None
        self._attend(self._can.fileno(), self._read)

    def deliver(
        self, deliveries: Sequence[BusFrame], bus_off: frozenset[str] = frozenset()
    ) -> None:
        """Send frames, each after its BusTime."""
        for delivery in deliveries:
            for name in bus_off & self._by_name.keys():
                self._can.send(wire.control(Kind.SKIP, self._by_name[name].number))
            sender = wire.PARTICIPANTS.get(delivery.sender, wire.NOBODY)
            self._can.send(wire.announced(sender, delivery.arrival_ns, delivery.frame))
            for peer in self._peers.values():
                peer.delivered += peer.number != sender and peer.name not in bus_off
                peer.unread += 2 + len(bus_off)
            self._let_them_read()

    def end_turn(self) -> dict[str, Turn]:
        """Grant the turns one after the other, and wait for each."""
        turns = {}
        for peer in self._granted:
            self._speaker = peer
            self._can.send(peer.grant(self._now_ns))
            turns[peer.name] = self._await_answer(peer, time.monotonic() + self._timeouts.answer_s)
            peer.unread = 0
            self._speaker = None
        return turns

    def _let_them_read(self) -> None:
        """Wait for participants with so much unread that a default receive buffer, of about 400 records, might overflow."""
        for peer in self._peers.values():
            if peer.unread > 256 and not peer.retired:
                self._can.send(wire.control(Kind.SYNC, peer.number))
                deadline = time.monotonic() + self._timeouts.answer_s
                while peer.unread:
                    if (left := deadline - time.monotonic()) <= 0.0:
                        what = f"did not read within {self._timeouts.answer_s:g} s: it stalled"
                        raise ParticipantLost(peer.name, what)
                    self._pump(left)

    def _send(self, records: bytes, *peers: Peer) -> None:
        self._can.send(records)

    def _send_stop(self, stop: bytes) -> None:
        self._can.send(stop)

    def _read(self, events: int) -> None:
        for _ in range(64):  # then others have their turn
            received = self._can.receive()
            if received is None:
                return
            self._take_frame(*received)

    def _take_frame(self, can_id: int, payload: bytes) -> None:
        try:
            control = wire.parse_control(can_id, payload)
        except wire.WireError:
            self._warn_foreign()
            return
        if control is None:
            offered = bool(can_id & EDP_BIT)
            for peer in self._peers.values():
                peer.unread += offered
            if offered and self._speaker is not None:
                self._speaker.take(can_id, payload)
            else:
                self._warn_foreign()
            return
        sender = self._peers.get(control.participant)
        if control.kind == Kind.HELLO:
            self._can.send(self._answer_hello(control)[1])
        elif control.kind in (Kind.RELEASE, Kind.DONE, Kind.FAILED) and sender is not None:
            sender.take(can_id, payload)
        elif control.kind == Kind.ACK and sender is not None:
            sender.unread = 0
        elif control.kind in (Kind.START, Kind.STOP, Kind.GRANT, Kind.BUS_TIME, Kind.WELCOME):
            raise RunError(f"channel {self._can.interface!r}: another coordinator sends on it")
        else:
            self._warn_foreign()

    def _receive(self, connection: Connection, length: int) -> None:
        """Take the number of the participant whose lifeline this is."""
        if length == 1 and self._buffer[0] in self._peers:
            connection.participant = self._buffer[0]

"""The J1939 transport protocol: messages of 9 to 1785 bytes in packets of seven (SAE J1939-21).

A message to all is announced once (BAM). One to a single receiver is negotiated: a request to send
(RTS), permissions of the receiver (CTS) for some packets each, and its acknowledgement.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final, NamedTuple

from can_dbc.frame import Frame, join_id, split_id
from sil.files.quantity import counted

if TYPE_CHECKING:
    from sil.logs.frame import LogFrame

PGN_CONTROL: Final = 0xEC00
PGN_DATA: Final = 0xEB00

BAM_PERIOD_NS: Final = 50_000_000
"""Least time from one frame of a message to all to its next."""

MOST_BYTES: Final = 1785
LEAST_BYTES: Final = 9
_PACKET_BYTES: Final = 7
_RTS, _CTS, _ACKNOWLEDGE, _BAM, _ABORT = 16, 17, 19, 32, 255


class Message(NamedTuple):
    """A message put together; `time_ns` is when its last frame arrived."""

    time_ns: int
    pgn: int
    source: int
    destination: int
    data: bytes
    channel: str = ""


@dataclass(slots=True)
class _Transfer:
    """A message under way: the packets that came, by their number from 1."""

    pgn: int
    size: int
    negotiated: bool
    last_ns: int
    packets: dict[int, bytes] = field(default_factory=dict)

    @property
    def count(self) -> int:
        return -(-self.size // _PACKET_BYTES)

    @property
    def complete(self) -> bool:
        return len(self.packets) == self.count

    @property
    def timeout_ns(self) -> int:
        return 1_250_000_000 if self.negotiated else 750_000_000


_Key = tuple[str, int, int]
"""Channel, source and destination: J1939 allows one transfer at a time for each."""


class Assembler:
    """Puts long messages together from a stream of frames: `take` each, then `finish`.

    Transfers of different channels, senders and receivers may be interleaved.
    lost: messages that did not come whole, and packets of none, counted by reason; locations: the
    first of them, with time and sender.
    """

    def __init__(self) -> None:
        self._transfers: dict[_Key, _Transfer] = {}
        self._now_ns = 0
        self.assembled = 0
        self.lost: Counter[str] = Counter()
        self.locations: list[str] = []

    def take(self, frame: LogFrame) -> Message | None:
        """Take one frame of any kind; return the message that it completes."""
        group = frame.can_id >> 16 & 0x3FF
        if group not in (PGN_CONTROL >> 8, PGN_DATA >> 8) or not frame.extended:
            return None
        if frame.remote or frame.error:
            return None
        self._now_ns = frame.time_ns
        parts = split_id(frame.can_id)
        key = frame.channel, parts.source, parts.destination
        if len(frame.data) != 8:
            self._lose(key, "frame of fewer than 8 bytes")
        elif parts.pgn == PGN_CONTROL:
            self._control(key, frame)
        else:
            return self._data(key, frame)
        return None

    def finish(self) -> None:
        """Count what is still under way at the end of the log."""
        for key in list(self._transfers):
            self._close(key, "end of the log")

    def lines(self) -> list[str]:
        """Return what was put together and what was lost as text, nothing if there was neither."""
        if not self.assembled and not self.lost:
            return []
        lines = [f"{counted(self.assembled, 'message')} of the transport protocol put together"]
        lines += [f"not put together: {count}: {name}" for name, count in sorted(self.lost.items())]
        return lines + [f"  {location}" for location in self.locations]

    def _control(self, key: _Key, frame: LogFrame) -> None:
        data, kind = frame.data, frame.data[0]
        if kind in (_RTS, _BAM):
            self._close(key, "new announcement before the end")
            size, pgn = data[1] | data[2] << 8, int.from_bytes(data[5:8], "little")
            transfer = _Transfer(pgn, size, key[2] != 0xFF, frame.time_ns)
            if LEAST_BYTES <= size <= MOST_BYTES and data[3] == transfer.count:
                self._transfers[key] = transfer
            else:
                self._lose(key, "announcement that contradicts itself", transfer)
            return
        towards = key[0], key[2], key[1]
        if kind == _CTS and towards in self._transfers:
            self._transfers[towards].last_ns = frame.time_ns
        elif kind == _ACKNOWLEDGE:
            self._close(towards, "packet missing")
        elif kind == _ABORT:
            self._close(towards if towards in self._transfers else key, "aborted")

    def _close(self, key: _Key, reason: str) -> None:
        transfer = self._transfers.pop(key, None)
        if transfer is not None and not transfer.complete:
            late = self._now_ns - transfer.last_ns > transfer.timeout_ns
            self._lose(key, "timeout" if late else reason, transfer)

    def _data(self, key: _Key, frame: LogFrame) -> Message | None:
        number, packet = frame.data[0], frame.data[1:]
        transfer = self._transfers.get(key)
        if transfer is not None and frame.time_ns - transfer.last_ns > transfer.timeout_ns:
            self._close(key, "timeout")
            transfer = None
        if transfer is None:
            self._lose(key, "packet without an announcement")
            return None
        transfer.last_ns = frame.time_ns
        if transfer.complete or transfer.packets.get(number) == packet:
            return None  # sent again
        expected = len(transfer.packets) + 1
        if not 1 <= number <= transfer.count or not (transfer.negotiated or number == expected):
            self._close(key, "packet missing")
            return None
        transfer.packets[number] = packet
        if not transfer.complete:
            return None
        if not transfer.negotiated:
            del self._transfers[key]
        self.assembled += 1
        data = b"".join(transfer.packets[n] for n in range(1, transfer.count + 1))
        return Message(frame.time_ns, transfer.pgn, key[1], key[2], data[: transfer.size], key[0])

    def _lose(self, key: _Key, reason: str, transfer: _Transfer | None = None) -> None:
        self.lost[reason] += 1
        if len(self.locations) < 10:
            from sil.logs.times import format_ns

            channel, source, destination = key
            what = f"PGN {transfer.pgn} of {transfer.size} bytes, " if transfer else ""
            sender = f"source {source:#04x} to {destination:#04x}"
            sender += f" on {channel}" if channel else ""
            self.locations.append(f"at {format_ns(self._now_ns)} s: {what}{sender}: {reason}")


def broadcast(pgn: int, source: int, data: bytes) -> list[Frame]:
    """Return the frames that carry a long message to all, `BAM_PERIOD_NS` or more apart.

    Raises ValueError for fewer than 9 or more than 1785 bytes, and for no J1939 addresses.
    """
    if not LEAST_BYTES <= len(data) <= MOST_BYTES:
        raise ValueError(f"{len(data)} bytes; expected {LEAST_BYTES} to {MOST_BYTES}")
    packets = [data[n : n + _PACKET_BYTES] for n in range(0, len(data), _PACKET_BYTES)]
    size, group = len(data).to_bytes(2, "little"), pgn.to_bytes(3, "little")
    frames = [
        Frame(join_id(7, PGN_CONTROL, source), bytes((_BAM, *size, len(packets), 0xFF, *group)))
    ]
    packet_id = join_id(7, PGN_DATA, source)  # to all, at the lowest priority
    for number, packet in enumerate(packets, 1):
        frames.append(Frame(packet_id, bytes((number, *packet.ljust(_PACKET_BYTES, b"\xff")))))
    return frames

"""The lockstep protocol: the records that participants and coordinator exchange, byte by byte.

A channel carries records of 16 bytes, each one SocketCAN `struct can_frame`: a CAN channel one per
frame, the local socket many per datagram.  The data page bits of the identifier (EDP and DP) mark
the kind of record:

    EDP clear         a frame of the simulated bus.  Only the coordinator sends these, in the order
                      of their simulated arrival, each right after its BusTime.
    EDP set           an offer: the frame of a participant that waits for arbitration, with EDP set.
    EDP and DP set    a control frame: 8 data bytes, byte 0 the number of the participant it is
                      about, byte 1 an additional number, bytes 2 to 7 a value, little endian; an
                      instant is in nanoseconds (up to 78 h).  Unused fields have all bits set.

One run, as a participant of number n exchanges it:

    participant  Hello(n, version, nonce and scenario)    again every 100 ms until answered
    coordinator  Welcome(n, version, nonce)               or Refused(n, reason, nonce)
    coordinator  Start(end of the run)                    once everybody has joined
    participant  Done(n, 0, first event)
    then, at each of its events:
    coordinator  BusTime(sender, checksum, arrival), frame       any number of times
                 Sync(n)                                         now and then; answer Ack(n)
                 Skip(n)                                         n is bus-off: the next frame is
                                                                 not for it, and not counted
                 Grant(n, number of frames, now)                 now: its own event, or the end
    participant  Release(n, instant)                             before offers released after now
                 offers
                 Done(n, number of offers, next event)
    coordinator  Retire(n)                                       n is granted no more time
                 Stop(reason, instant)                           the end

The numbers of frames are modulo 256; that of a Grant counts the frames of others since the last
Grant, so that either side sees when the channel lost something.
"""

from __future__ import annotations

import struct
import sys
from collections.abc import Iterator
from enum import IntEnum
from typing import NamedTuple

from can_dbc.frame import (
    EDP_BIT,
    MAX_ID,
    MAX_LENGTH,
    PAGE_BITS,
    SOCKETCAN_EXTENDED,
    SOCKETCAN_FRAME,
    Frame,
    checksum,
)
from can_dbc.messages import ParticipantId
from sil.coupling.clock import NEVER_NS

if sys.byteorder != "little":
    raise ImportError("the lockstep records are those of a little-endian machine")

VERSION = 1  # version of the protocol; Hello and Welcome carry it, and another one is refused

NOBODY = 255  # number in control frames that are about no participant in particular
GUEST = "guest"  # the participant that a program of the user may be, announced in the scenario
PARTICIPANTS = {p.name.lower(): int(p) for p in ParticipantId if p != ParticipantId.COORDINATOR}
PARTICIPANTS[GUEST] = 4  # participant name to its number on the wire
RECORD_BYTES = SOCKETCAN_FRAME.size
LONGEST_BATCH = 2048  # records in one datagram of the local socket at most

_CONTROL = struct.Struct("<IB3xQ")


class Kind(IntEnum):
    """The control frames, by identifier: PGN 3FF00 + n; the coordinator sends those from F9."""

    START = 0x1FFF_00F9
    STOP = 0x1FFF_01F9
    GRANT = 0x1FFF_02F9
    BUS_TIME = 0x1FFF_03F9
    DONE = 0x1FFF_04FA
    RELEASE = 0x1FFF_05FA
    HELLO = 0x1FFF_06FA
    WELCOME = 0x1FFF_07F9
    REFUSED = 0x1FFF_08F9
    FAILED = 0x1FFF_09FA
    SYNC = 0x1FFF_0AF9
    ACK = 0x1FFF_0BFA
    RETIRE = 0x1FFF_0CF9
    MONITOR = 0x1FFF_0DFA
    SKIP = 0x1FFF_0EF9


class Refusal(IntEnum):
    """Why a Hello, or a frame of a program that takes no part, was refused."""

    VERSION = 1
    UNEXPECTED = 2
    DUPLICATE = 3
    SCENARIO = 4
    NO_PARTICIPANT = 5


class Control(NamedTuple):
    """A parsed control frame; the module docstring gives the meaning per kind."""

    kind: Kind
    participant: int
    extra: int
    value: int


class WireError(ValueError):
    """Bytes on a channel that do not follow the protocol."""


def reason(refusal: int) -> str:
    """Return in words why something was refused."""
    reasons: dict[int, str] = {
        Refusal.VERSION: "the coordinator speaks another version of the lockstep protocol",
        Refusal.UNEXPECTED: "the run waits for no participant of this name",
        Refusal.DUPLICATE: "a participant of this name has joined already",
        Refusal.SCENARIO: "the coordinator runs another scenario",
        Refusal.NO_PARTICIPANT: "a lockstep run takes frames from its participants only",
    }
    return reasons.get(refusal, f"code {refusal}")


def control(
    kind: Kind, participant: int = NOBODY, extra: int = 0xFF, value: int = NEVER_NS
) -> bytes:
    """Return a control frame's record; `participant`, `extra` modulo 256. Raises struct.error beyond 48 bits."""
    word = value << 16 | (extra & 0xFF) << 8 | participant & 0xFF
    return _CONTROL.pack(SOCKETCAN_EXTENDED | kind, 8, word)


def parse_control(can_id: int, payload: bytes) -> Control | None:
    """Return the control frame, None if the identifier is not one. Raises WireError for an unknown one."""
    if can_id & PAGE_BITS != PAGE_BITS:
        return None
    kind = _KINDS.get(can_id)
    if kind is None or len(payload) != 8:
        raise WireError(f"control frame 0x{can_id:08X} of {len(payload)} bytes is unknown")
    word = int.from_bytes(payload, "little")
    return Control(kind, word & 0xFF, word >> 8 & 0xFF, word >> 16)


_KINDS = {int(kind): kind for kind in Kind}


def real(frame: Frame) -> bytes:
    """Return the record of a frame as the simulated bus delivers it."""
    return SOCKETCAN_FRAME.pack(frame.can_id | SOCKETCAN_EXTENDED, len(frame.data), frame.data)


def offer(frame: Frame) -> bytes:
    """Return the record of a frame that waits for arbitration: the same, EDP set."""
    flagged_id = frame.can_id | (SOCKETCAN_EXTENDED | EDP_BIT)
    return SOCKETCAN_FRAME.pack(flagged_id, len(frame.data), frame.data)


def can_be_offered(frame: Frame) -> bool:
    """Return whether a participant may send the frame: classic, 29-bit, both data page bits clear."""
    is_clear = 0 <= frame.can_id <= MAX_ID and not frame.can_id & PAGE_BITS
    return is_clear and len(frame.data) <= MAX_LENGTH


def announced(sender: int, arrival_ns: int, frame: Frame) -> bytes:
    """Return the two records of a delivered frame: its BusTime and itself.

    The checksum, the low byte of the CRC-32 of its record, tells it from a frame of another program.
    """
    word = arrival_ns << 16 | checksum(*frame) << 8 | sender
    return _CONTROL.pack(SOCKETCAN_EXTENDED | Kind.BUS_TIME, 8, word) + real(frame)


def split(records: bytes | memoryview) -> Iterator[tuple[int, bytes]]:
    """Yield each record's identifier and data. Raises WireError for a torn or foreign one."""
    if len(records) % RECORD_BYTES:
        raise WireError(f"{len(records)} bytes; expected a multiple of {RECORD_BYTES}")
    for flagged_id, length, payload in SOCKETCAN_FRAME.iter_unpack(records):
        if flagged_id & ~MAX_ID != SOCKETCAN_EXTENDED or length > MAX_LENGTH:
            what = f"record with identifier word 0x{flagged_id:08X} and length {length}"
            expected = "expected a classic data frame with a 29-bit identifier"
            raise WireError(f"{what}; {expected}")
        yield flagged_id & MAX_ID, payload[:length]

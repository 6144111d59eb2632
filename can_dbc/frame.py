"""Classic CAN frames with 29-bit identifiers and their J1939 parts (SAE J1939-21).

Most significant bit first: priority (3), extended data page (1), data page (1), PDU format (8), PDU specific (8),
source (8).
"""

from __future__ import annotations

import struct
from typing import NamedTuple
from zlib import crc32

MAX_ID = 0x1FFF_FFFF
MAX_LENGTH = 8
EDP_BIT = 1 << 25
"""Extended data page: reserved by J1939 together with data page 0, so free to mark the lockstep."""

DP_BIT = 1 << 24
"""Data page; set together with EDP in lockstep control frames, clear in offers."""

PAGE_BITS = EDP_BIT | DP_BIT

SOCKETCAN_FRAME = struct.Struct("<IB3x8s")
"""A frame as Linux has it (struct can_frame): identifier with flags, length, data."""

SOCKETCAN_EXTENDED = 0x8000_0000
"""Its flag of a 29-bit identifier; remote and error frames carry others."""


class Frame(NamedTuple):
    """A classic CAN data frame: 29-bit identifier and 0 to 8 bytes."""

    can_id: int
    data: bytes


class J1939Id(NamedTuple):
    """The parts of a 29-bit identifier; `destination` is 255 (global) for broadcast groups."""

    priority: int
    pgn: int
    source: int
    destination: int


def checksum(can_id: int, data: bytes) -> int:
    """Return the checksum that BusTime carries for a frame: the low byte of its record's CRC-32."""
    return crc32(SOCKETCAN_FRAME.pack(can_id | SOCKETCAN_EXTENDED, len(data), data)) & 0xFF


def split_id(can_id: int) -> J1939Id:
    """Split a 29-bit identifier; a PDU format below 240 carries a destination, which is not part of the group number.

    Raises ValueError for a number of more than 29 bits. Source: SAE J1939-21.
    """
    if not 0 <= can_id <= MAX_ID:
        raise ValueError(f"not a 29-bit identifier: {can_id:#x}")
    pgn = can_id >> 8 & 0x3FFFF
    destination = 0xFF
    if pgn >> 8 & 0xFF < 240:
        destination = pgn & 0xFF
        pgn &= 0x3FF00
    return J1939Id(can_id >> 26, pgn, can_id & 0xFF, destination)


def join_id(priority: int, pgn: int, source: int, destination: int = 0xFF) -> int:
    """Build the identifier of a parameter group, as `split_id` splits it. Raises ValueError for a part that does not fit."""
    if not (0 <= priority <= 7 and 0 <= pgn <= 0x3FFFF and 0 <= source <= 0xFF):
        raise ValueError(f"not J1939 parts: priority {priority}, PGN {pgn:#x}, source {source}")
    if not 0 <= destination <= 0xFF:
        raise ValueError(f"not a J1939 destination: {destination}")
    if pgn >> 8 & 0xFF < 240:
        if pgn & 0xFF:
            raise ValueError(f"PGN {pgn:#x} is destination specific: its low byte must be 0")
        pgn |= destination
    return priority << 26 | pgn << 8 | source

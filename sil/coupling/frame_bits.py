"""Exact length of extended CAN 2.0 data frames on the wire: CRC-15 and bit stuffing; bounds for standard ones, too.

Stuffable part of a frame, from start of frame to the end of the CRC sequence, in bits:
extended 54 + 8 n (SOF 1, id 11, SRR 1, IDE 1, id 18, RTR 1, r1 1, r0 1, DLC 4, data 8 n, CRC 15),
standard 34 + 8 n (SOF 1, id 11, RTR 1, IDE 1, r0 1, DLC 4, data 8 n, CRC 15). After five equal
bits a complementary one is inserted, which counts as the first of the next run. Ten bits follow
unstuffed: CRC delimiter, ACK slot, ACK delimiter, seven bits end of frame.
Source: Bosch CAN specification 2.0 part B (1991).
"""

from __future__ import annotations

from functools import lru_cache

INTERMISSION_BITS = 3
UNSTUFFED_BITS = 3 + 7  # delimiters and acknowledgement; end of frame


def _stuff_bits(state: int, word: int, bits: int) -> tuple[int, int]:
    """Return state and stuff bits after the lowest `bits` bits of a word, most significant first.

    A state is the length of the current run of equal bits (1 to 4) times two plus the bit; 0 is before
    the first bit.
    """
    inserted = 0
    for position in range(bits - 1, -1, -1):
        bit = word >> position & 1
        run = (state >> 1) + 1 if state and state & 1 == bit else 1
        inserted += run == 5
        state = 2 | bit ^ 1 if run == 5 else run << 1 | bit
    return state, inserted


def _crc_of_byte(byte: int) -> int:
    crc = byte << 7
    for _ in range(8):
        crc = crc << 1 ^ (0x4599 if crc & 0x4000 else 0)
    return crc & 0x7FFF


# Next state and stuff bits of each state and byte, packed as state | inserted << 4, at index
# state << 8 | byte; and the same for the seven low bits that end the CRC sequence.
_STUFF_BYTE = tuple(
    state_after | inserted << 4
    for state in range(10)
    for byte in range(256)
    for state_after, inserted in (_stuff_bits(state, byte, 8),)
)
_STUFF_LAST7 = tuple(_stuff_bits(state, word, 7)[1] for state in range(10) for word in range(128))
_CRC_BYTE = tuple(_crc_of_byte(byte) for byte in range(256))


def crc15(bits: int, count: int) -> int:
    """Return the CRC-15 of `count` bits, most significant first, starting from 0 (Bosch CAN 2.0, 3.1.1).

    Generator x^15 + x^14 + x^10 + x^8 + x^7 + x^4 + x^3 + 1.
    """
    crc = 0
    padded = (count + 7) // 8
    for byte in bits.to_bytes(padded, "big"):
        crc = (crc << 8 & 0x7FFF) ^ _CRC_BYTE[crc >> 7 ^ byte]
    return crc


@lru_cache(maxsize=4096)
def _after_header(can_id: int, length: int) -> tuple[int, int, int, int]:
    """Return CRC, stuffing state and stuff bits after the length code, and the unstuffed frame's length."""
    if not (0 <= can_id < 1 << 29 and length <= 8):
        raise ValueError(f"{can_id:#x}, {length} bytes; expected 29 bits and at most 8 bytes")
    header = (can_id >> 18) << 27 | 0b11 << 25 | (can_id & 0x3FFFF) << 7 | length
    return crc15(header, 39), *_stuff_bits(0, header, 39), shortest_frame_bits(length)


@lru_cache(maxsize=1 << 15)
def frame_bits(can_id: int, data: bytes) -> int:
    """Return the bits from start to end of frame, stuff bits included, no intermission. Raises ValueError."""
    crc, state, inserted, plain = _after_header(can_id, len(data))
    for byte in data:
        crc = (crc << 8 & 0x7FFF) ^ _CRC_BYTE[crc >> 7 ^ byte]
        step = _STUFF_BYTE[state << 8 | byte]
        state = step & 15
        inserted += step >> 4
    step = _STUFF_BYTE[state << 8 | crc >> 7]
    return plain + inserted + (step >> 4) + _STUFF_LAST7[(step & 15) << 7 | crc & 0x7F]


def longest_frame_bits(length: int, extended: bool = True) -> int:
    """Return an upper bound of `frame_bits` over all identifiers and data of a length.

    g + 8 n + floor((g + 8 n - 1) / 4) + 10 with g = 54 (extended) or 34 (standard).
    Source: Davis, Burns, Bril, Lukkien 2007, eq. 1.
    """
    plain = shortest_frame_bits(length, extended) - UNSTUFFED_BITS
    return plain + (plain - 1) // 4 + UNSTUFFED_BITS


def shortest_frame_bits(length: int, extended: bool = True) -> int:
    """Return the bits of a frame without any stuff bit."""
    return (54 if extended else 34) + 8 * length + UNSTUFFED_BITS

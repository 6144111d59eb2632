"""Values of ETC1 and ETC2 in any truck's log; what is out of range is None, nothing is refused.

The codec of `can_dbc` is strict and knows the project's own source address only. Layout: SAE
J1939-71, PGN 61442 and 61445.
"""

from __future__ import annotations

from typing import Final

PGN_ETC1: Final = 61442
PGN_ETC2: Final = 61445
GEAR_OFFSET: Final = 125
LAST_VALID_WORD: Final = 0xFAFF
_PARK_BYTE: Final = 0xFB


def flag_at(data: bytes, byte: int, bit: int) -> bool | None:
    """Return a two-bit state, bytes and bits from 0; None for error and not available."""
    return (False, True, None, None)[data[byte] >> bit & 3]


def word_at(data: bytes, byte: int) -> int | None:
    """Return a two-byte number, None above the valid range."""
    value = data[byte] | data[byte + 1] << 8
    return value if value <= LAST_VALID_WORD else None


def gear_at(data: bytes, byte: int) -> int | None:
    """Return a gear, -125..125, 126 for park, None if not available (SPN 523, 524)."""
    value = data[byte]
    return value - GEAR_OFFSET if value <= _PARK_BYTE else None

"""ETC1 and ETC2 of any truck's log: tolerant decoding of what other senders put on the bus.

The codec of `can_dbc` is strict and knows our own source address only; a log of another truck has
others, and values out of range. Here a value that is not valid is None, and nothing is refused.
Layout: SAE J1939-71, PGN 61442 and 61445; bytes are numbered from 1 there.
"""

from __future__ import annotations

import math
from typing import Final

from can_dbc.messages import Etc1, Etc2

PGN_ETC1: Final = 61442
PGN_ETC2: Final = 61445
RAD_S_PER_BIT: Final = 0.125 * 2.0 * math.pi / 60.0
"""Shaft speeds (SPN 161, 191): 0.125 rpm per bit."""

GEAR_OFFSET: Final = 125
LAST_VALID_BYTE: Final = 0xFA
LAST_VALID_WORD: Final = 0xFAFF
_PARK_BYTE: Final = 0xFB


def flag_at(data: bytes, byte: int, bit: int) -> bool | None:
    """A two-bit state, bytes from 0, bits from 0: True, False, or None for error and not there."""
    return (False, True, None, None)[data[byte] >> bit & 3]


def word_at(data: bytes, byte: int) -> int | None:
    """A two-byte number, None above the valid range."""
    value = data[byte] | data[byte + 1] << 8
    return value if value <= LAST_VALID_WORD else None


def gear_at(data: bytes, byte: int) -> int | None:
    """A gear, -125..125, 126 for park, None for error and not available (SPN 523, 524)."""
    value = data[byte]
    return value - GEAR_OFFSET if value <= _PARK_BYTE else None


def _scaled(value: int | None, factor: float) -> float | None:
    return None if value is None else value * factor


def _byte_at(data: bytes, byte: int) -> int | None:
    return data[byte] if data[byte] <= LAST_VALID_BYTE else None


def _text_at(data: bytes, byte: int) -> str | None:
    characters = data[byte : byte + 2]
    if not all(0x20 <= character <= 0x7E for character in characters):
        return None
    return characters.decode("ascii")


def decode_etc1(data: bytes) -> Etc1:
    """Electronic Transmission Controller 1 of any sender.

    Raises: ValueError for fewer than 8 bytes.
    Checked by: tests/unit/sil/j1939/test_transmission.py.
    """
    if len(data) < 8:
        raise ValueError(f"ETC1 of {len(data)} bytes; expected 8")
    return Etc1(
        driveline_engaged=flag_at(data, 0, 0),
        torque_converter_lockup=flag_at(data, 0, 2),
        shift_in_process=flag_at(data, 0, 4),
        lockup_transition=flag_at(data, 0, 6),
        output_shaft_rad_s=_scaled(word_at(data, 1), RAD_S_PER_BIT),
        clutch_slip=_scaled(_byte_at(data, 3), 0.004),
        momentary_overspeed=flag_at(data, 4, 0),
        progressive_shift_disabled=flag_at(data, 4, 2),
        momentary_maximum_power=flag_at(data, 4, 4),
        input_shaft_rad_s=_scaled(word_at(data, 5), RAD_S_PER_BIT),
        controlling_address=data[7] if data[7] <= 0xFD else None,
    )


def decode_etc2(data: bytes) -> Etc2:
    """Electronic Transmission Controller 2 of any sender.

    Raises: ValueError for fewer than 8 bytes.
    Checked by: tests/unit/sil/j1939/test_transmission.py.
    """
    if len(data) < 8:
        raise ValueError(f"ETC2 of {len(data)} bytes; expected 8")
    return Etc2(
        selected_gear=gear_at(data, 0),
        gear_ratio=_scaled(word_at(data, 1), 0.001),
        current_gear=gear_at(data, 3),
        requested_range=_text_at(data, 4),
        current_range=_text_at(data, 6),
    )

"""Values of ETC1 and ETC2 as the standard lays them out, and as our own contract has them."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from can_dbc.codec import encode
from can_dbc.messages import GEAR_PARK, Etc1, Etc2
from sil.shifts.reported import gear_at, shift_in_process, word_at


def test_flags_have_two_bits() -> None:
    flags = [shift_in_process(bytes((0xCF | state << 4,))) for state in range(4)]
    assert flags == [False, True, None, None]


def test_words_above_the_valid_range_are_none() -> None:
    assert word_at(bytes((0x40, 0x1F)), 0) == 8000
    assert word_at(bytes((0, 0xFF, 0xFA)), 1) == 0xFAFF
    assert word_at(bytes((0x00, 0xFB)), 0) is None


def test_reverse_neutral_and_park() -> None:
    gears = [gear_at(bytes((raw,)), 0) for raw in (0, 1, 123, 125, 126, 250, 251)]
    assert gears == [None, -124, -2, 0, 1, 125, GEAR_PARK]
    assert [gear_at(bytes((raw,)), 0) for raw in (252, 253, 254, 255)] == [None] * 4


@given(shifting=st.booleans(), bits=st.integers(0, 0xFAFF), gear=st.integers(-124, 126))
def test_our_own_messages_are_read(shifting: bool, bits: int, gear: int) -> None:
    speed_rad_s = bits * 0.125 * 2.0 * math.pi / 60.0
    etc1 = encode(Etc1(shift_in_process=shifting, input_shaft_rad_s=speed_rad_s)).data
    assert shift_in_process(etc1) is shifting
    assert word_at(etc1, 5) == pytest.approx(bits, abs=1)
    assert gear_at(encode(Etc2(current_gear=gear)).data, 3) == gear

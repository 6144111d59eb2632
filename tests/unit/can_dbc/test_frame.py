"""Identifiers: hand-worked J1939 splits, the inverse."""

from __future__ import annotations

from zlib import crc32

import pytest
from hypothesis import given
from hypothesis import strategies as st

from can_dbc.frame import MAX_ID, MAX_LENGTH, J1939Id, checksum, join_id, split_id


@pytest.mark.parametrize(
    ("can_id", "parts"),
    [
        (0x0CF00203, J1939Id(3, 61442, 3, 255)),  # ETC1 of a transmission
        (0x18F00503, J1939Id(6, 61445, 3, 255)),  # ETC2
        (0x0CF00400, J1939Id(3, 61444, 0, 255)),  # EEC1 of an engine
        (0x0C000003, J1939Id(3, 0, 3, 0)),  # TSC1, destination engine
        (0x18EAFF17, J1939Id(6, 59904, 0x17, 255)),  # request to all
        (0x18EF3112, J1939Id(6, 61184, 0x12, 0x31)),  # proprietary A, PDU format 239
        (0x1CFF4090, J1939Id(7, 0xFF40, 0x90, 255)),
        (0x1FFF02F9, J1939Id(7, 0x3FF02, 0xF9, 255)),
        (0, J1939Id(0, 0, 0, 0)),
        (MAX_ID, J1939Id(7, 0x3FFFF, 255, 255)),
    ],
)
def test_known_identifiers(can_id: int, parts: J1939Id) -> None:
    assert split_id(can_id) == parts
    assert join_id(*parts) == can_id


def test_classic_frames_with_29_bits_and_at_most_8_bytes() -> None:
    assert (MAX_ID, MAX_LENGTH) == (2**29 - 1, 8)


def test_the_checksum_is_that_of_the_frame_as_linux_has_it() -> None:
    whole = bytes.fromhex("9120ff8c 03000000 0102030000000000")  # flag of 29 bits in the identifier
    assert checksum(0x0CFF2091, bytes([1, 2, 3])) == crc32(whole) & 0xFF
    assert checksum(0x0CFF2091, bytes([1, 2, 4])) != checksum(0x0CFF2091, bytes([1, 2, 3]))


def test_groups_without_a_destination_are_for_everybody() -> None:
    assert join_id(6, 0xEA00, 0x17) == 0x18EAFF17


@given(st.integers(0, MAX_ID))
def test_join_inverts_split(can_id: int) -> None:
    assert join_id(*split_id(can_id)) == can_id


@pytest.mark.parametrize("can_id", [-1, MAX_ID + 1])
def test_split_refuses_what_is_not_29_bits(can_id: int) -> None:
    with pytest.raises(ValueError, match="29-bit"):
        split_id(can_id)


@pytest.mark.parametrize(
    "parts",
    [
        (8, 0, 0, 0),
        (-1, 0, 0, 0),
        (0, 0x40000, 0, 0),
        (0, -1, 0, 0),
        (0, 0, 256, 0),
        (0, 0, -1, 0),
        (0, 0, 0, 256),
        (0, 0, 0, -1),
        (0, 1, 0, 0),  # a destination-specific group whose low byte is not 0
    ],
)
def test_join_refuses_parts_that_do_not_fit(parts: tuple[int, int, int, int]) -> None:
    with pytest.raises(ValueError, match=r"J1939|destination"):
        join_id(*parts)

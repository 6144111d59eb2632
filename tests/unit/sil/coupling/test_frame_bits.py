"""Frame lengths against a bit-by-bit reference, published values and hand-stuffed frames."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sil.coupling.frame_bits import (
    INTERMISSION_BITS,
    crc15,
    frame_bits,
    header_bits,
    longest_frame_bits,
    shortest_frame_bits,
)

identifiers = st.tuples(st.booleans(), st.integers(0, (1 << 29) - 1)).map(
    lambda pair: (pair[0], pair[1] if pair[0] else pair[1] & 0x7FF)
)
# Runs of equal bits, which stuffing is about, are rare in uniform bytes.
payloads = st.lists(
    st.sampled_from((0x00, 0xFF, 0x0F, 0xF0, 0x1F, 0xE0, 0x83, 0x7C)) | st.integers(0, 255),
    max_size=8,
).map(bytes)


def plain_bits(can_id: int, data: bytes, extended: bool) -> str:
    """Start of frame to end of data, field by field as in the specification."""
    sof, rtr, reserved = "0", "0", "0"
    if extended:
        base, extension = f"{can_id >> 18:011b}", f"{can_id & 0x3FFFF:018b}"
        srr, ide = "1", "1"
        header = sof + base + srr + ide + extension + rtr + reserved + reserved
    else:
        ide = "0"
        header = sof + f"{can_id:011b}" + rtr + ide + reserved
    return header + f"{len(data):04b}" + "".join(f"{byte:08b}" for byte in data)


def divided(bits: str) -> str:
    """Remainder of bits * x^15 by the generator, by long division over GF(2)."""
    generator = 0b1100010110011001
    dividend = int(bits, 2) << 15
    while dividend.bit_length() > 15:
        dividend ^= generator << dividend.bit_length() - 16
    return f"{dividend:015b}"


def stuffed(bits: str) -> str:
    out = ""
    for bit in bits:
        out += bit
        if len(out) >= 5 and out[-5:] == out[-1] * 5:
            out += "10"[int(out[-1])]
    return out


@given(identifiers, payloads)
@settings(max_examples=400, deadline=None)
def test_length_is_that_of_the_frame_written_out(kind: tuple[bool, int], data: bytes) -> None:
    extended, can_id = kind
    bits = plain_bits(can_id, data, extended)
    on_the_wire = stuffed(bits + divided(bits))
    assert "000000" not in on_the_wire
    assert "111111" not in on_the_wire
    acknowledge, end_of_frame = "101", "1111111"
    assert frame_bits(can_id, data, extended) == len(on_the_wire + acknowledge + end_of_frame)


@given(identifiers, payloads)
@settings(max_examples=300, deadline=None)
def test_lengths_lie_between_the_published_bounds(kind: tuple[bool, int], data: bytes) -> None:
    extended, can_id = kind
    length = frame_bits(can_id, data, extended)
    assert shortest_frame_bits(len(data), extended) <= length
    assert length <= longest_frame_bits(len(data), extended)


@given(st.integers(0, (1 << 118) - 1), st.integers(1, 118))
@settings(max_examples=200, deadline=None)
def test_crc_is_the_remainder_of_the_division(bits: int, count: int) -> None:
    bits &= (1 << count) - 1
    assert f"{crc15(bits, count):015b}" == divided(f"{bits:0{count}b}")


def test_crc_has_its_published_check_value() -> None:
    """0x059E for the nine digits (catalogue of parametrised CRC algorithms, CRC-15/CAN)."""
    digits = int.from_bytes(b"123456789", "big")
    assert crc15(digits, 72) == 0x059E


@pytest.mark.parametrize("length", range(9))
def test_published_bounds(length: int) -> None:
    """Davis et al. 2007: at most 55 + 10 s (11-bit) and 80 + 10 s (29-bit), intermission included.

    Without stuff bits 47 + 8 s and 67 + 8 s.
    """
    assert longest_frame_bits(length, False) + INTERMISSION_BITS == 55 + 10 * length
    assert longest_frame_bits(length, True) + INTERMISSION_BITS == 80 + 10 * length
    assert shortest_frame_bits(length, False) + INTERMISSION_BITS == 47 + 8 * length
    assert shortest_frame_bits(length, True) + INTERMISSION_BITS == 67 + 8 * length


def test_frame_of_zeros_by_hand() -> None:
    """Standard, identifier 0, eight zero bytes: SOF to data is 19 + 64 bits.

    All of them zero but the 1 of the length code 1000. Before it 15 zeros: stuff bits after the
    5th, 10th and 15th. Then the 1 of the code, three zeros of it and 64 of data: 67 zeros, 13 stuff
    bits, the last two zeros run on into the CRC.
    """
    bits = plain_bits(0, bytes(8), False)
    crc = divided(bits)
    by_hand = "000001" * 3 + "1" + "000001" * 13 + "00"
    assert stuffed(bits) == by_hand
    assert frame_bits(0, bytes(8), False) == len(by_hand) + len(stuffed("00" + crc)) - 2 + 10


@pytest.mark.parametrize(
    ("can_id", "length", "extended"),
    [(0x800, 0, False), (-1, 0, True), (1 << 29, 0, True), (0, 9, True), (0, -1, False)],
)
def test_what_is_no_frame_is_refused(can_id: int, length: int, extended: bool) -> None:
    with pytest.raises(ValueError, match=r"expected 0 to 8|does not fit"):
        header_bits(can_id, length, extended)


def test_fields_of_an_extended_header() -> None:
    header, count = header_bits(0x1ABC_DEF5, 7)
    assert f"{header:0{count}b}" == plain_bits(0x1ABC_DEF5, b"", True)[:-4] + "0111"
    assert count == 39

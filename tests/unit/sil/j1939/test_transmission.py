"""ETC1 and ETC2 as the standard lays them out, and as our own contract has them."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from can_dbc.codec import decode, encode
from can_dbc.messages import GEAR_PARK, Etc1, Etc2
from sil.j1939.transmission import RAD_S_PER_BIT, decode_etc1, decode_etc2


def test_etc1_of_a_truck_at_rest() -> None:
    """CC 00 00 FF F0 00 00 FF: no shift, shafts stand still, the rest not available."""
    found = decode_etc1(bytes.fromhex("CC0000FFF00000FF"))
    assert found == Etc1(
        driveline_engaged=False,
        shift_in_process=False,
        output_shaft_rad_s=0.0,
        momentary_overspeed=False,
        progressive_shift_disabled=False,
        input_shaft_rad_s=0.0,
    )


def test_etc1_in_a_shift() -> None:
    """Output 1000 rpm (8000 bits), slip 40 % (100), input 1500 rpm (12000), controlled by 3."""
    data = bytes((0b01_01_10_01, 0x40, 0x1F, 100, 0b00_00_01_00, 0xE0, 0x2E, 3))
    found = decode_etc1(data)
    assert found.driveline_engaged is True
    assert found.torque_converter_lockup is None
    assert found.shift_in_process is True
    assert found.lockup_transition is True
    assert found.output_shaft_rad_s == pytest.approx(1000.0 * 2.0 * math.pi / 60.0)
    assert found.clutch_slip == pytest.approx(0.4)
    assert found.momentary_overspeed is False
    assert found.progressive_shift_disabled is True
    assert found.momentary_maximum_power is False
    assert found.input_shaft_rad_s == pytest.approx(1500.0 * 2.0 * math.pi / 60.0)
    assert found.controlling_address == 3


def test_etc2_of_a_truck() -> None:
    """Selected 7th, ratio 1.234, current 6th, ranges D and 6."""
    data = bytes((132, 0xD2, 0x04, 131)) + b" D 6"
    assert decode_etc2(data) == Etc2(
        selected_gear=7, gear_ratio=1.234, current_gear=6, requested_range=" D", current_range=" 6"
    )


def test_reverse_neutral_and_park() -> None:
    def gear(raw: int) -> int | None:
        return decode_etc2(bytes((0xFF, 0xFF, 0xFF, raw, 255, 255, 255, 255))).current_gear

    assert [gear(raw) for raw in (0, 123, 125, 126, 250, 251)] == [-125, -2, 0, 1, 125, GEAR_PARK]
    assert [gear(raw) for raw in (252, 253, 254, 255)] == [None] * 4


@pytest.mark.parametrize("raw", [0xFB00, 0xFDFF, 0xFE00, 0xFEFF, 0xFF00, 0xFFFF])
def test_words_that_are_no_values(raw: int) -> None:
    low, high = raw.to_bytes(2, "little")
    found = decode_etc1(bytes((0xFF, low, high, 0xFE, 0xFF, low, high, 0xFE)))
    assert found == Etc1()
    assert decode_etc2(bytes((0xFE, low, high, 0xFE, 0, 0, 0xFF, 0xFF))) == Etc2()


@pytest.mark.parametrize("decoder", [decode_etc1, decode_etc2])
def test_short_frames_are_refused(decoder: object) -> None:
    with pytest.raises(ValueError, match="expected 8"):
        decoder(bytes(7))  # type: ignore[operator]


flags = st.none() | st.booleans()
gears = st.none() | st.integers(-125, 126)
speeds = st.none() | st.integers(0, 0xFAFF).map(lambda raw: raw * RAD_S_PER_BIT)
letters = st.none() | st.text(
    st.characters(min_codepoint=0x20, max_codepoint=0x7E), min_size=2, max_size=2
)


@given(
    st.builds(
        Etc1,
        flags,
        flags,
        flags,
        flags,
        speeds,
        st.none() | st.integers(0, 250).map(lambda raw: raw * 0.004),
        flags,
        flags,
        flags,
        speeds,
        st.none() | st.integers(0, 253),
    )
)
def test_etc1_agrees_with_our_contract(message: Etc1) -> None:
    frame = encode(message)
    ours, tolerant = decode(frame), decode_etc1(frame.data)
    assert isinstance(ours, Etc1)
    for name in Etc1.__slots__:
        expected = getattr(ours, name)
        found = getattr(tolerant, name)
        assert found == (pytest.approx(expected) if isinstance(expected, float) else expected)


@given(
    st.builds(
        Etc2,
        gears,
        st.none() | st.integers(0, 0xFAFF).map(lambda raw: raw * 0.001),
        gears,
        letters,
        letters,
    )
)
def test_etc2_agrees_with_our_contract(message: Etc2) -> None:
    frame = encode(message)
    ours, tolerant = decode(frame), decode_etc2(frame.data)
    assert isinstance(ours, Etc2)
    for name in Etc2.__slots__:
        expected = getattr(ours, name)
        found = getattr(tolerant, name)
        assert found == (pytest.approx(expected) if isinstance(expected, float) else expected)

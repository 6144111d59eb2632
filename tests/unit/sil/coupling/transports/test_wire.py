"""The lockstep's records: round trips, agreement with the DBC, and garbage."""

from __future__ import annotations

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from can_dbc.frame import DP_BIT, EDP_BIT, Frame, checksum
from sil.coupling.clock import NEVER_NS
from sil.coupling.transports import wire
from sil.coupling.transports.wire import Control, Kind

frames = st.builds(Frame, st.integers(0, (1 << 29) - 1), st.binary(max_size=8))
plain_frames = frames.map(lambda f: Frame(f.can_id & ~(EDP_BIT | DP_BIT), f.data))


@given(st.sampled_from(Kind), st.integers(0, 255), st.integers(0, 255), st.integers(0, NEVER_NS))
def test_control_frames_round_trip(kind: Kind, number: int, extra: int, value: int) -> None:
    ((can_id, payload),) = wire.split(wire.control(kind, number, extra, value))
    assert wire.parse_control(can_id, payload) == Control(kind, number, extra, value)


@given(plain_frames)
def test_frames_and_offers_round_trip(frame: Frame) -> None:
    assert wire.can_be_offered(frame)
    assert list(wire.split(wire.real(frame))) == [frame]
    ((can_id, payload),) = wire.split(wire.offer(frame))
    assert (can_id, payload) == (frame.can_id | EDP_BIT, frame.data)
    assert wire.parse_control(can_id, payload) is None


@given(plain_frames, st.integers(0, 255), st.integers(0, NEVER_NS))
def test_an_announced_frame_comes_with_its_arrival_and_checksum(
    frame: Frame, sender: int, arrival_ns: int
) -> None:
    (time_id, time), (can_id, payload) = wire.split(wire.announced(sender, arrival_ns, frame))
    said = wire.parse_control(time_id, time)
    assert said == Control(Kind.BUS_TIME, sender, checksum(*frame), arrival_ns)
    assert (can_id, payload) == frame


@given(plain_frames, st.integers(0, 63))
def test_the_checksum_sees_every_flipped_bit(frame: Frame, bit: int) -> None:
    padded = frame.data.ljust(8, b"\0")
    flipped = (int.from_bytes(padded, "big") ^ 1 << bit).to_bytes(8, "big")
    assert checksum(frame.can_id, padded) != checksum(frame.can_id, flipped)


@given(frames)
def test_what_could_be_taken_for_lockstep_is_not_offered(frame: Frame) -> None:
    assert wire.can_be_offered(frame) == (not frame.can_id & (EDP_BIT | DP_BIT))
    assert not wire.can_be_offered(Frame(frame.can_id | 1 << 29, frame.data))
    assert not wire.can_be_offered(Frame(frame.can_id, frame.data + bytes(9)))


@given(st.binary(max_size=96))
def test_garbage_is_refused_or_is_made_of_whole_records(garbage: bytes) -> None:
    try:
        records = list(wire.split(garbage))
        controls = [wire.parse_control(*record) for record in records]
    except wire.WireError:
        return
    assert len(controls) == len(garbage) // 16 and len(garbage) % 16 == 0


@pytest.mark.parametrize(
    ("word", "length"),
    [
        (0x123, 8),  # 11 bits
        (0x8000_0000 | 0x4000_0000, 8),  # remote frame
        (0x8000_0000 | 0x2000_0000, 8),  # error frame
        (0x8000_0000, 9),  # CAN FD
    ],
)
def test_other_frames_than_classic_ones_are_refused(word: int, length: int) -> None:
    with pytest.raises(wire.WireError, match="29-bit"):
        list(wire.split(struct.pack("<IB3x8s", word, length, b"")))


def test_unknown_control_frames_are_refused() -> None:
    with pytest.raises(wire.WireError, match="is unknown"):
        wire.parse_control(0x1FFF_FFF9, bytes(8))
    with pytest.raises(wire.WireError, match="of 7 bytes"):
        wire.parse_control(Kind.GRANT, bytes(7))


def test_every_refusal_has_words() -> None:
    assert all(not wire.reason(refusal).startswith("code") for refusal in wire.Refusal)
    assert wire.reason(99) == "code 99"

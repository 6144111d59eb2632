"""The protection against the autosar-e2e library and published values; all it must catch."""

from __future__ import annotations

from itertools import combinations

import pytest
from e2e.p02 import e2e_p02_check
from hypothesis import given, settings
from hypothesis import strategies as st

from can_dbc import messages as m
from can_dbc.codec import can_id_of, decode, encode, spec_of
from can_dbc.e2e import (
    PROTECTED,
    E2eStatus,
    Protector,
    Receiver,
    with_counter,
)
from can_dbc.frame import Frame
from can_dbc.messages import E2eState

MS = 1_000_000
EXAMPLES: dict[type, m.Message] = {
    m.ShiftRequest: m.ShiftRequest(m.Gear.BACKWARD),
    m.ValveCommand: m.ValveCommand(0.98, 0.0, 0.33, m.Gear.BACKWARD),
    m.SafetyBlow: m.SafetyBlow(m.Chamber.N, True, 0.15),
    m.PositionPulse: m.PositionPulse(0.9e-3, 293.15625, 17),
    m.DrivelineSpeeds: m.DrivelineSpeeds(120.5, 118.25),
    m.ControllerStatus: m.ControllerStatus(m.ShiftState.PUSH, m.Gear.UNKNOWN, 0.0064, m.Fault.NONE),
}
every_channel = pytest.mark.parametrize("message_type", PROTECTED, ids=lambda t: t.__name__)


def crc8_2f(octets: bytes) -> int:
    """CRC-8 of polynomial 0x2F, start and final XOR 0xFF, bit by bit (AUTOSAR SWS CRC)."""
    crc = 0xFF
    for octet in octets:
        crc ^= octet
        for _ in range(8):
            crc = (crc << 1 ^ 0x2F if crc & 0x80 else crc << 1) & 0xFF
    return crc ^ 0xFF


def test_published_check_value_of_the_crc() -> None:
    assert crc8_2f(b"123456789") == 0xDF


def test_the_examples_cover_every_channel() -> None:
    assert set(EXAMPLES) == set(PROTECTED)


@every_channel
def test_header_by_hand_and_by_the_library(message_type: type) -> None:
    protector = Protector(message_type)
    data_ids = spec_of(message_type).e2e_data_ids
    for number in range(40):
        frame = protector.protect(EXAMPLES[message_type])
        counter = frame.data[1] & 0x0F
        assert counter == number % 16
        assert frame.data[0] == crc8_2f(frame.data[1:] + data_ids[counter : counter + 1])
        assert e2e_p02_check(frame.data, data_ids, length=8)
        assert decode(frame) == EXAMPLES[message_type]
        plain = encode(EXAMPLES[message_type])
        assert frame.data[2:] == plain.data[2:]
        assert frame.data[1] & 0xF0 == plain.data[1] & 0xF0
        assert frame.can_id == plain.can_id


@every_channel
@given(data=st.binary(min_size=6, max_size=6), header=st.binary(min_size=2, max_size=2))
@settings(max_examples=30, deadline=None)
def test_check_is_the_librarys(message_type: type, data: bytes, header: bytes) -> None:
    """Whatever the bytes: ERROR exactly when the library or the codec says so."""
    frame = Frame(can_id_of(message_type), header + data)
    for candidate in (frame, with_counter(message_type, frame, header[1] & 0x0F)):
        receiver = Receiver(message_type)
        right = e2e_p02_check(candidate.data, spec_of(message_type).e2e_data_ids, length=8)
        try:
            decode(candidate)
        except ValueError:
            right = False
        expected = E2eStatus.INITIAL if right else E2eStatus.ERROR
        assert receiver.receive(0, candidate) is expected


def warmed_up(message_type: type, protector: Protector, frames: int = 3) -> Receiver:
    receiver = Receiver(message_type)
    for number in range(frames):
        receiver.receive(number * MS, protector.protect(EXAMPLES[message_type]))
    assert receiver.state((frames - 1) * MS) is E2eState.VALID
    return receiver


@every_channel
def test_an_undisturbed_channel(message_type: type) -> None:
    protector, receiver = Protector(message_type), Receiver(message_type)
    cycle_ns = spec_of(message_type).cycle_ns
    assert receiver.state(0) is E2eState.INIT
    for number in range(50):
        now_ns = number * cycle_ns
        status = receiver.receive(now_ns, protector.protect(EXAMPLES[message_type]))
        assert status is (E2eStatus.OK if number else E2eStatus.INITIAL)
        assert receiver.state(now_ns) is (E2eState.VALID if number else E2eState.INIT)
        assert receiver.message == (EXAMPLES[message_type] if number else None)
        assert receiver.message_ns == (now_ns if number else -1)
    assert receiver.counts == {E2eStatus.INITIAL: 1, E2eStatus.OK: 49}


@every_channel
def test_every_one_and_two_bit_error_is_an_error(message_type: type) -> None:
    """The code is linear, so that one frame per counter stands for all."""
    data_ids = spec_of(message_type).e2e_data_ids
    patterns = [1 << bit for bit in range(64)]
    patterns += [1 << a | 1 << b for a, b in combinations(range(64), 2)]
    assert len(patterns) == 64 + 2016
    protector = Protector(message_type)
    for _ in range(16):
        word = int.from_bytes(protector.protect(EXAMPLES[message_type]).data, "little")
        for pattern in patterns:
            wrong = (word ^ pattern).to_bytes(8, "little")
            assert not e2e_p02_check(wrong, data_ids, length=8), hex(pattern)


@every_channel
def test_masqueraded_frames_are_errors(message_type: type) -> None:
    """A frame of any other channel, under this channel's identifier, at every counter."""
    receiver = warmed_up(message_type, Protector(message_type))
    for other in PROTECTED:
        if other is message_type:
            continue
        protector = Protector(other)
        for _ in range(16):
            foreign = protector.protect(EXAMPLES[other])
            frame = Frame(can_id_of(message_type), foreign.data)
            assert receiver.receive(3 * MS, frame) is E2eStatus.ERROR
            assert receiver.reason == "CRC does not match"


def test_right_crc_around_a_meaningless_value_is_an_error() -> None:
    protector = Protector(m.ValveCommand)
    receiver = warmed_up(m.ValveCommand, protector)
    good = protector.protect(m.ValveCommand(0.0, 0.0, 0.0, m.Gear.NEUTRAL))
    wrong = Frame(good.can_id, good.data[:2] + b"\xff\xff" + good.data[4:])
    assert receiver.receive(3 * MS, with_counter(m.ValveCommand, wrong, 3)) is E2eStatus.ERROR
    assert "duty_b" in receiver.reason
    assert receiver.receive(3 * MS, good) is E2eStatus.OK


def test_only_protected_messages_have_channels() -> None:
    for end in (Protector, Receiver):
        with pytest.raises(TypeError, match="Etc1 is not protected"):
            end(m.Etc1)
    with pytest.raises(TypeError, match="does not belong to the ShiftRequests"):
        Protector(m.ShiftRequest).protect(EXAMPLES[m.SafetyBlow])  # type: ignore[arg-type]


# One step of a disturbed channel; the sender sends one frame in each.
SEND, LOSE, REPEAT, CORRUPT, MASQUERADE, INSERT, JUMP = range(7)


@given(
    steps=st.lists(st.integers(SEND, JUMP), max_size=60),
    bits=st.lists(st.integers(0, 63), min_size=60, max_size=60),
)
@settings(max_examples=150, deadline=None)
def test_whatever_happens_to_a_channel(steps: list[int], bits: list[int]) -> None:
    """Only messages sent on this channel get through, and a quiet bus makes it valid again."""
    message_type = m.ValveCommand
    cycle_ns = 10 * MS
    protector, stranger = Protector(message_type), Protector(m.SafetyBlow)
    receiver = Receiver(message_type)
    timeout_ns = receiver.timeout_ns
    sent: list[m.ValveCommand] = []
    latest = protector.protect(m.ValveCommand(0.5, 0.0, 0.0, m.Gear.NEUTRAL))
    heard = False
    now_ns = 0
    for number, (step, bit) in enumerate(zip(steps, bits, strict=False)):
        now_ns += cycle_ns
        command = m.ValveCommand(number / 128, 0.0, 0.0, m.Gear.NEUTRAL)
        before = receiver.message
        if step == JUMP:
            protector.counter = (protector.counter + bit) % 16
        if step in (SEND, CORRUPT, LOSE, JUMP):
            fresh = protector.protect(command)
        if step in (SEND, JUMP):
            sent.append(command)
            latest, heard = fresh, True
            status = receiver.receive(now_ns, fresh)
            assert status not in (E2eStatus.ERROR, E2eStatus.NO_NEW_DATA)
        elif step == REPEAT:
            status = receiver.receive(now_ns, latest)
            assert status is (E2eStatus.REPEATED if heard else E2eStatus.INITIAL)
            heard = True
        elif step == CORRUPT:
            word = int.from_bytes(fresh.data, "little") ^ 1 << bit
            status = receiver.receive(now_ns, Frame(fresh.can_id, word.to_bytes(8, "little")))
            assert status is E2eStatus.ERROR
        elif step in (MASQUERADE, INSERT):
            foreign = stranger.protect(m.SafetyBlow(m.Chamber.B, True, 0.1))
            status = receiver.receive(now_ns, Frame(latest.can_id, foreign.data))
            assert status is E2eStatus.ERROR
        if step in (CORRUPT, MASQUERADE, INSERT, LOSE):
            assert receiver.message is before
        if receiver.message is not None:
            assert receiver.message in sent
        if receiver.state(now_ns) is E2eState.VALID:
            assert receiver.message is not None
            assert now_ns - receiver.message_ns <= timeout_ns
    for _ in range(6):  # sequence accepted, confirmed, good often enough
        now_ns += cycle_ns
        receiver.receive(now_ns, protector.protect(EXAMPLES[message_type]))
    assert receiver.state(now_ns) is E2eState.VALID
    assert receiver.status is E2eStatus.OK and receiver.message == EXAMPLES[message_type]
    assert receiver.state(now_ns + timeout_ns) is E2eState.VALID
    assert receiver.state(now_ns + timeout_ns + 1) is E2eState.INVALID


def test_timeout_of_a_receiver() -> None:
    receiver = Receiver(m.ShiftRequest, 5, start_ns=100)
    assert receiver.state(105) is E2eState.INIT and receiver.state(106) is E2eState.INVALID
    assert Receiver(m.ShiftRequest).timeout_ns == 60 * MS
    assert Receiver(m.PositionPulse).timeout_ns == 30 * MS

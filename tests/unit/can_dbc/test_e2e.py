"""Receiver of profile 2, step by step: hand-worked counter sequences, windows, timeout, config."""

from __future__ import annotations

import pytest

from can_dbc import messages as m
from can_dbc.codec import can_id_of
from can_dbc.e2e import E2eStatus, Protector, Receiver, with_counter
from can_dbc.frame import Frame
from can_dbc.messages import E2eState

MS = 1_000_000
CYCLE = 10 * MS
S, V = E2eStatus, E2eState
TIMEOUT_NS = 30 * MS


def frame(counter: int) -> Frame:
    request = m.ShiftRequest(m.Gear.FORWARD)
    return with_counter(m.ShiftRequest, Protector(m.ShiftRequest).protect(request), counter)


def corrupted(counter: int) -> Frame:
    good = frame(counter)
    return Frame(good.can_id, bytes([good.data[0] ^ 1]) + good.data[1:])


def run(arrivals: list[int | str]) -> tuple[list[S], list[V], Receiver[m.ShiftRequest]]:
    """One arrival per cycle: a counter, or "x" for a corrupted frame."""
    receiver = Receiver(m.ShiftRequest, 10**12)
    statuses, states = [], []
    for number, arrival in enumerate(arrivals):
        arrived = corrupted(0) if isinstance(arrival, str) else frame(arrival)
        statuses.append(receiver.receive(number * CYCLE, arrived))
        states.append(receiver.state(number * CYCLE))
    return statuses, states, receiver


@pytest.mark.parametrize(
    ("arrivals", "statuses"),
    [
        ([5, 6, 7], [S.INITIAL, S.OK, S.OK]),
        ([14, 15, 0, 1], [S.INITIAL, S.OK, S.OK, S.OK]),
        ([0, 1, 3, 4], [S.INITIAL, S.OK, S.OK_SOME_LOST, S.OK]),
        ([0, 1, 4, 5], [S.INITIAL, S.OK, S.OK_SOME_LOST, S.OK]),  # init 2, one more per check
        ([15, 0, 3], [S.INITIAL, S.OK, S.OK_SOME_LOST]),
        ([0, 1, 5, 6, 7], [S.INITIAL, S.OK, S.WRONG_SEQUENCE, S.SYNC, S.OK]),
        ([0, 1, 0, 1, 2], [S.INITIAL, S.OK, S.WRONG_SEQUENCE, S.SYNC, S.OK]),  # backwards
        ([0, 1, "x", 5, 6], [S.INITIAL, S.OK, S.ERROR, S.OK_SOME_LOST, S.OK]),
        ([0, 1, "x", 6, 7], [S.INITIAL, S.OK, S.ERROR, S.WRONG_SEQUENCE, S.SYNC]),
        ([0, 1, 1, 1, 1, 2], [S.INITIAL, S.OK, *[S.REPEATED] * 3, S.OK]),
        ([0, 1, 1, 1, 1, 1, 2, 3], [S.INITIAL, S.OK, *[S.REPEATED] * 4, S.SYNC, S.SYNC]),
        (["x", 0, 1], [S.ERROR, S.INITIAL, S.OK]),
        ([0, 0, 1], [S.INITIAL, S.REPEATED, S.OK]),
    ],
)
def test_status_of_each_arrival(arrivals: list[int | str], statuses: list[S]) -> None:
    got, _, receiver = run(arrivals)
    assert got == statuses
    assert sum(receiver.counts.values()) == len(arrivals)
    assert receiver.status is statuses[-1]


def test_accepted_step_never_grows_beyond_the_counter() -> None:
    got, _, _ = run([0, 1, *["x"] * 40, 0])
    assert got[-1] is S.OK_SOME_LOST


@pytest.mark.parametrize(
    ("arrivals", "states"),
    [
        ([0, 1], [V.INIT, V.VALID]),
        (["x", "x", "x", "x", 0, 1], [*[V.INIT] * 5, V.VALID]),  # nothing heard: NODATA
        ([0, "x", "x", 1], [V.INIT, V.INIT, V.INVALID, V.INVALID]),
        ([0, 1, 1, 1, 1], [V.INIT, V.VALID, V.VALID, V.VALID, V.INVALID]),  # frozen counter
        ([0, 1, "x", 2, 3], [V.INIT, V.VALID, V.VALID, V.VALID, V.VALID]),
        ([0, 1, "x", "x", 2], [V.INIT, V.VALID, V.VALID, V.INVALID, V.INVALID]),
        # errors leave the window of three, then two good frames in it
        (
            [0, 1, "x", "x", 2, 3, 4, 5],
            [V.INIT, V.VALID, V.VALID, V.INVALID, V.INVALID, V.INVALID, V.VALID, V.VALID],
        ),
        ([0, 1, 9, 10, 11], [V.INIT, V.VALID, V.VALID, V.VALID, V.VALID]),
        ([0, 1, 9, 2, 11], [V.INIT, V.VALID, V.VALID, V.VALID, V.INVALID]),  # jumping counter
    ],
)
def test_state_after_each_arrival(arrivals: list[int | str], states: list[V]) -> None:
    _, got, _ = run(arrivals)
    assert got == states


def test_silence_makes_invalid_and_two_frames_in_sequence_valid_again() -> None:
    receiver = Receiver(m.ShiftRequest, TIMEOUT_NS)
    receiver.receive(0, frame(0))
    receiver.receive(10 * MS, frame(1))
    assert receiver.state(40 * MS) is V.VALID and receiver.state(40 * MS + 1) is V.INVALID
    assert receiver.receive(50 * MS, frame(5)) is S.WRONG_SEQUENCE
    assert receiver.state(50 * MS) is V.INVALID
    assert receiver.receive(60 * MS, frame(6)) is S.SYNC
    assert receiver.state(60 * MS) is V.INVALID
    assert receiver.receive(70 * MS, frame(7)) is S.OK
    assert receiver.state(70 * MS) is V.INVALID
    assert receiver.receive(80 * MS, frame(8)) is S.OK
    assert receiver.state(80 * MS) is V.VALID and receiver.state(110 * MS) is V.VALID


def test_good_frames_from_before_a_silence_do_not_count_after_it() -> None:
    receiver = Receiver(m.ShiftRequest, TIMEOUT_NS)
    for number in range(3):
        receiver.receive(number * CYCLE, frame(number))
    assert receiver.receive(20 * MS + 30 * MS + 1, frame(3)) is S.OK
    assert receiver.state(50 * MS + 1) is V.INVALID
    receiver.receive(60 * MS, frame(4))
    assert receiver.state(60 * MS) is V.VALID


def test_errors_and_repetitions_do_not_stop_the_timeout() -> None:
    for arrival in (frame(1), corrupted(2)):
        receiver = Receiver(m.ShiftRequest, TIMEOUT_NS)
        receiver.receive(0, frame(0))
        receiver.receive(10 * MS, frame(1))
        receiver.receive(20 * MS, arrival)
        assert receiver.state(40 * MS) is V.VALID and receiver.state(40 * MS + 1) is V.INVALID


def test_frames_that_only_resynchronise_keep_nothing_alive() -> None:
    """A counter that jumps every other frame: WRONG_SEQUENCE and SYNC for ever."""
    receiver = Receiver(m.ShiftRequest, TIMEOUT_NS)
    receiver.receive(0, frame(0))
    receiver.receive(10 * MS, frame(1))
    assert receiver.receive(20 * MS, frame(9)) is S.WRONG_SEQUENCE
    assert receiver.receive(30 * MS, frame(10)) is S.SYNC
    assert receiver.state(40 * MS) is V.VALID and receiver.state(40 * MS + 1) is V.INVALID
    assert receiver.message_ns == 10 * MS


def test_a_channel_that_starts_with_jumps_is_not_valid_without_a_message() -> None:
    _, states, receiver = run([0, 8, 9, 0, 1])
    assert states == [V.INIT] * 5
    assert receiver.status is S.SYNC and receiver.message is None


def test_a_channel_that_never_speaks_becomes_invalid() -> None:
    receiver = Receiver(m.ShiftRequest, TIMEOUT_NS, start_ns=5 * MS)
    assert receiver.state(35 * MS) is V.INIT and receiver.state(35 * MS + 1) is V.INVALID
    assert receiver.message is None
    receiver.receive(36 * MS, frame(0))
    receiver.receive(46 * MS, frame(1))
    assert receiver.state(46 * MS) is V.INVALID
    receiver.receive(56 * MS, frame(2))
    assert receiver.state(56 * MS) is V.VALID


def test_message_is_kept_from_good_frames_only() -> None:
    protector = Protector(m.ShiftRequest)
    receiver = Receiver(m.ShiftRequest, TIMEOUT_NS)
    receiver.receive(0, protector.protect(m.ShiftRequest(m.Gear.NEUTRAL)))
    assert receiver.message is None
    receiver.receive(1, protector.protect(m.ShiftRequest(m.Gear.FORWARD)))
    assert (receiver.message, receiver.message_ns) == (m.ShiftRequest(m.Gear.FORWARD), 1)
    receiver.receive(2, corrupted(2))
    assert (receiver.message, receiver.message_ns) == (m.ShiftRequest(m.Gear.FORWARD), 1)
    protector.counter = 9
    receiver.receive(3, protector.protect(m.ShiftRequest(m.Gear.BACKWARD)))
    assert (receiver.message, receiver.message_ns) == (m.ShiftRequest(m.Gear.FORWARD), 1)
    receiver.receive(4, protector.protect(m.ShiftRequest(m.Gear.BACKWARD)))
    assert receiver.status is S.SYNC
    assert (receiver.message, receiver.message_ns) == (m.ShiftRequest(m.Gear.FORWARD), 1)
    receiver.receive(5, protector.protect(m.ShiftRequest(m.Gear.BACKWARD)))
    assert receiver.status is S.OK
    assert (receiver.message, receiver.message_ns) == (m.ShiftRequest(m.Gear.BACKWARD), 5)


def undisturbed(status: m.ControllerStatus) -> tuple[list[Frame], Receiver[m.ControllerStatus]]:
    """A channel that has taken the frames of counters 0 to 14 without a fault, and those frames."""
    protector = Protector(m.ControllerStatus)
    receiver = Receiver(m.ControllerStatus, 10**12)
    frames = [protector.protect(status) for _ in range(15)]
    for frame in frames:
        receiver.receive(0, frame)
    assert receiver.status is S.OK
    return frames, receiver


@pytest.mark.parametrize("state", [m.ShiftState.INIT, m.ShiftState.FAULT])
def test_a_channel_without_faults_still_looks_at_every_counter(state: m.ShiftState) -> None:
    status = m.ControllerStatus(state, m.Gear.NEUTRAL, 0.0, m.Fault.NONE)
    for counter, expected in ((14, S.REPEATED), (0, S.OK_SOME_LOST), (3, S.WRONG_SEQUENCE)):
        frames, receiver = undisturbed(status)
        assert receiver.receive(0, frames[counter]) is expected


def test_time_does_not_run_backwards() -> None:
    receiver = Receiver(m.ShiftRequest, TIMEOUT_NS)
    receiver.receive(10, frame(0))
    with pytest.raises(ValueError, match="time runs backwards: 9 ns after 10 ns"):
        receiver.state(9)
    with pytest.raises(ValueError, match="time runs backwards"):
        receiver.receive(9, frame(1))
    assert receiver.state(10) is V.INIT


def test_with_counter_keeps_the_payload() -> None:
    first = Protector(m.ShiftRequest).protect(m.ShiftRequest(m.Gear.FORWARD))
    other = with_counter(m.ShiftRequest, first, 11)
    assert other.data[1] == first.data[1] & 0xF0 | 11 and other.data[2:] == first.data[2:]
    assert with_counter(m.ShiftRequest, other, 0) == first


def test_after_many_good_frames_a_bad_one_is_still_seen() -> None:
    receiver = Receiver(m.ShiftRequest, 10**12)
    for counter in range(8):
        receiver.receive(counter * CYCLE, frame(counter))
    good = frame(8)
    short = Frame(good.can_id, good.data[:-1])
    unknown = with_counter(m.ShiftRequest, Frame(good.can_id, b"\x00\x00" + b"\xff" * 6), 8)
    assert len(unknown.data) == len(good.data)
    for bad in (short, unknown, corrupted(8)):
        assert receiver.receive(8 * CYCLE, bad) is S.ERROR
        for counter in range(8, 16):
            receiver.receive(8 * CYCLE, frame(counter))
        for counter in range(8):
            assert receiver.receive(8 * CYCLE, frame(counter)) is S.OK
    for other_id in (good.can_id + 1, can_id_of(m.Etc1)):
        with pytest.raises(
            ValueError, match=f"^identifier {other_id:#010x} is not a ShiftRequest$"
        ):
            receiver.receive(8 * CYCLE, Frame(other_id, good.data))


def test_what_is_wrong_with_a_frame_is_reported() -> None:
    receiver = Receiver(m.ShiftRequest, 10**12)
    assert (receiver.status, receiver.reason) == (S.NO_NEW_DATA, "")
    good = frame(0)
    for bad, reason in (
        (Frame(good.can_id, good.data[:7]), "7 bytes instead of 8"),
        (corrupted(0), "CRC does not match"),
    ):
        assert receiver.receive(0, bad) is S.ERROR
        assert receiver.reason == reason
    unused = with_counter(m.ShiftRequest, Frame(good.can_id, bytes(8)), 0)
    assert receiver.receive(0, unused) is S.ERROR
    assert receiver.reason.startswith("opc4.dbc: ShiftRequest: unused bits of")

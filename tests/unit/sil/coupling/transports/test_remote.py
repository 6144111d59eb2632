"""The coordinator's side of the protocol: what it takes from a participant, and what not."""

from __future__ import annotations

import socket
import struct
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from can_dbc.frame import DP_BIT, EDP_BIT, Frame, checksum
from sil.coupling.clock import NEVER_NS
from sil.coupling.transports import remote, wire
from sil.coupling.transports.channel import ParticipantLost, Timeouts
from sil.coupling.transports.hub import Hub
from sil.coupling.transports.remote import Peer
from sil.coupling.transports.wire import Control, Kind

PLANT = wire.PARTICIPANTS["plant"]
FRAME = Frame(0x0CFF2091, b"\x01\x02")


def feed(peer: Peer, *records: bytes) -> None:
    for record in records:
        for can_id, payload in wire.split(record):
            peer.take(can_id, payload)


@pytest.fixture
def peer() -> Peer:
    granted = Peer("plant", PLANT)
    granted.grant(1000)
    return granted


def test_a_turn_is_offers_with_their_releases_and_a_done(peer: Peer) -> None:
    feed(
        peer,
        wire.offer(FRAME),
        wire.control(Kind.RELEASE, PLANT, value=1500),
        wire.offer(FRAME),
        wire.control(Kind.RELEASE, PLANT, value=1000),
        wire.offer(FRAME),
        wire.control(Kind.DONE, PLANT, 3, 2000),
    )
    assert peer.frames == [(1000, FRAME), (1500, FRAME), (1000, FRAME)] and peer.done == 2000
    with pytest.raises(ParticipantLost, match="out of its turn"):
        feed(peer, wire.offer(FRAME))


def test_a_grant_counts_what_was_delivered_since_the_last_one(peer: Peer) -> None:
    feed(peer, wire.control(Kind.DONE, PLANT, 0, 2000))
    peer.delivered = 300
    ((can_id, payload),) = wire.split(peer.grant(2000))
    assert wire.parse_control(can_id, payload) == (Kind.GRANT, PLANT, 300 - 256, 2000)
    assert peer.delivered == 0 and peer.done is None


@pytest.mark.parametrize(
    ("record", "complaint"),
    [
        (wire.real(FRAME), r"sent 0x0CFF2091 past the arbitration; expected an offer"),
        (wire.control(Kind.DONE, PLANT + 1, 0, 2000), "sent as participant number 2"),
        (wire.control(Kind.RELEASE, PLANT, value=999), "at 999 ns; expected 1000 ns or later"),
        (wire.control(Kind.DONE, PLANT, 1, 2000), r"offered 1 frames .*, 0 arrived"),
        (wire.control(Kind.GRANT, PLANT, 0, 2000), "sent GRANT, which only the coordinator sends"),
        (wire.control(Kind.FAILED, PLANT), "failed; its own error output says why"),
    ],
)
def test_what_is_against_the_rules_ends_the_run_by_name(
    record: bytes, complaint: str, peer: Peer
) -> None:
    with pytest.raises(ParticipantLost, match=rf"^plant .*{complaint}") as lost:
        feed(peer, record)
    assert lost.value.participant == "plant"


def test_a_babbler_is_stopped(peer: Peer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(remote, "MOST_OFFERS", 10)
    feed(peer, *[wire.offer(FRAME)] * 10)
    with pytest.raises(ParticipantLost, match="offered more than 10 frames in one turn"):
        feed(peer, wire.offer(FRAME))


@pytest.fixture
def joined(runtime_folder: Path) -> Iterator[tuple[Hub, socket.socket]]:
    """A hub whose plant, a bare socket, has joined and named its first event."""
    hub = Hub("run", ["plant"], timeouts=Timeouts(start_s=5.0, answer_s=0.25))
    plant = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    plant.connect(str(hub.path))
    plant.send(wire.control(Kind.HELLO, PLANT, wire.VERSION, 7))
    waker = threading.Timer(0.05, plant.send, (wire.control(Kind.DONE, PLANT, 0, 0),))
    waker.start()
    assert hub.start(10**9) == {"plant": 0}
    waker.join()
    yield hub, plant
    plant.close()
    hub.close(aborted=True)


def test_who_is_still_talking_has_not_stalled(joined: tuple[Hub, socket.socket]) -> None:
    hub, plant = joined

    def talk() -> None:
        for _ in range(6):
            time.sleep(0.1)
            plant.send(wire.offer(FRAME))
        plant.send(wire.control(Kind.DONE, PLANT, 6, 10))

    talker = threading.Thread(target=talk)
    hub.begin_turn(0, ["plant"])
    talker.start()
    assert hub.end_turn()["plant"] == ([(0, FRAME)] * 6, 10)
    talker.join()


def test_who_falls_silent_has_stalled(joined: tuple[Hub, socket.socket]) -> None:
    hub, plant = joined
    hub.begin_turn(0, ["plant"])
    plant.send(wire.offer(FRAME))
    started = time.monotonic()
    with pytest.raises(ParticipantLost, match=r"plant did not answer within 0.25 s: it stalled"):
        hub.end_turn()
    assert time.monotonic() - started >= 0.25


@pytest.mark.parametrize("garbage", [b"x", b"\xff" * 16, bytes(40_000)], ids=len)
def test_garbage_from_a_participant_ends_the_run(
    garbage: bytes, joined: tuple[Hub, socket.socket]
) -> None:
    hub, plant = joined
    hub.begin_turn(0, ["plant"])
    plant.send(garbage)
    with pytest.raises(ParticipantLost, match="plant sent garbage: "):
        hub.end_turn()


def test_a_hang_up_is_noticed_between_turns(joined: tuple[Hub, socket.socket]) -> None:
    hub, plant = joined
    plant.close()
    with pytest.raises(ParticipantLost, match="plant closed its connection"):
        hub.idle(1.0)


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
        controls = [wire.parse_control(*record) for record in wire.split(garbage)]
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

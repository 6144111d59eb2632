"""The bus model: hand-worked timing, arbitration as properties, fault seams, statistics."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate
from typing import NamedTuple

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from can_dbc.errors import InputError
from can_dbc.frame import Frame
from sil.coupling.bus import BusFrame, BusModel, ErrorFrame, Transmission
from sil.coupling.frame_bits import INTERMISSION_BITS, frame_bits

BIT = 2_000
"""Nanoseconds of a bit at 500 kbit/s."""

URGENT = Frame(0x0800_0001, b"\x55" * 8)
USUAL = Frame(0x0C00_0001, b"\x55" * 8)
SLACK = Frame(0x1800_0001, b"\x55" * 8)


def duration_ns(frame: Frame) -> int:
    """Start to end of frame."""
    return frame_bits(frame.can_id, frame.data) * BIT


GAP = INTERMISSION_BITS * BIT


def test_one_frame_arrives_at_the_end_of_its_frame() -> None:
    bus = BusModel(500_000)
    bus.queue(1_000, USUAL, "plant")
    end_ns = 1_000 + duration_ns(USUAL)
    assert bus.advance(end_ns - 1) == []
    assert bus.waiting == 0
    assert bus.advance(end_ns) == [BusFrame(1_000, end_ns, "plant", USUAL)]
    assert bus.advance(end_ns + 10**9) == []


def test_length_scales_with_the_bit_rate() -> None:
    for bitrate, bit_ns in ((10_000, 100_000), (125_000, 8_000), (1_000_000, 1_000)):
        bus = BusModel(bitrate)
        bus.queue(0, USUAL, "plant")
        (delivery,) = bus.advance(10**9)
        assert delivery.arrival_ns == frame_bits(USUAL.can_id, USUAL.data) * bit_ns


def test_frames_released_at_the_instant_reached_still_compete() -> None:
    """What is released at T, after the bus advanced to T, takes part in the arbitration at T."""
    bus = BusModel()
    bus.queue(500, SLACK, "a")
    assert bus.advance(500) == []
    bus.queue(500, URGENT, "b")
    assert [d.frame for d in bus.advance(10**9)] == [URGENT, SLACK]
    late = BusModel()
    late.queue(500, SLACK, "a")
    assert late.advance(501) == []
    late.queue(501, URGENT, "b")
    assert [d.frame for d in late.advance(10**9)] == [SLACK, URGENT]


def test_equal_identifiers_released_together_keep_the_order_of_queueing() -> None:
    bus = BusModel()
    frames = [Frame(7, bytes([number])) for number in range(12)]
    for frame in frames:
        bus.queue(0, frame, "a")
    assert [d.frame for d in bus.advance(10**9)] == frames


def test_arrivals_at_the_same_instant_keep_the_order_of_the_bus() -> None:
    meet_ns = 5_000_000
    bus = BusModel(
        frame_filter=lambda sent: [d._replace(arrival_ns=meet_ns) for d in sent.delivered()]
    )
    frames = [Frame(number, b"") for number in range(12)]
    for frame in reversed(frames):
        bus.queue(0, frame, "a")
    assert [d.frame for d in bus.advance(meet_ns)] == frames


def test_the_number_of_frames_waiting() -> None:
    bus = BusModel()
    for number in range(3):
        bus.queue(0, USUAL, "a")
        bus.queue(10**9 * (number + 1), SLACK, "a")
    assert bus.waiting == 6
    bus.advance(1)  # one on the bus, two released, three to be released
    assert bus.waiting == 5
    bus.advance(10**8)
    assert bus.waiting == 3


class Offer(NamedTuple):
    release_ns: int
    frame: Frame


offers = st.lists(
    st.builds(
        Offer,
        st.integers(0, 3_000_000),
        st.builds(
            Frame,
            st.sampled_from((1, 2, 3, 0x0CFF_0005, 0x0CFF_0006, 0x1FFF_FFFF)),
            st.binary(max_size=8),
        ),
    ),
    max_size=25,
)
instants = st.lists(st.integers(0, 12_000_000), max_size=12)


def run(bus: BusModel, sent: Sequence[Offer], stops: Sequence[int]) -> list[BusFrame]:
    """Queue each frame at the latest stop before its release, and advance from stop to stop."""
    arrived: list[BusFrame] = []
    left = sorted(enumerate(sent), key=lambda item: item[1].release_ns)
    previous_ns = 0
    for stop_ns in [*sorted(stops), 60_000_000]:
        while left and left[0][1].release_ns < stop_ns:
            number, offer = left.pop(0)
            bus.queue(offer.release_ns, offer.frame, str(number))
        deliveries = bus.advance(stop_ns)
        assert all(previous_ns < d.arrival_ns <= stop_ns for d in deliveries)
        arrived += deliveries
        previous_ns = stop_ns
    return arrived


@given(offers, instants)
@settings(max_examples=200, deadline=None)
def test_arbitration(sent: list[Offer], stops: list[int]) -> None:
    arrived = run(BusModel(), sent, stops)
    # Everything arrives once, as it was sent.
    waiting = {str(number): offer for number, offer in enumerate(sent)}
    offered = sorted((name, *offer) for name, offer in waiting.items())
    assert sorted((d.sender, d.released_ns, d.frame) for d in arrived) == offered
    free_ns = 0
    for delivery in arrived:
        start_ns = delivery.arrival_ns - duration_ns(delivery.frame)
        # Never two frames at once, nor without the intermission between them.
        assert start_ns >= free_ns
        # Work conserving: the bus starts as soon as it is free and something is there.
        assert start_ns == max(free_ns, min(offer.release_ns for offer in waiting.values()))
        # The most urgent of those released goes first.
        competing = [offer for offer in waiting.values() if offer.release_ns <= start_ns]
        assert delivery.frame.can_id == min(offer.frame.can_id for offer in competing)
        alike = [offer for offer in competing if offer.frame.can_id == delivery.frame.can_id]
        assert delivery.released_ns == min(offer.release_ns for offer in alike)
        del waiting[delivery.sender]
        free_ns = delivery.arrival_ns + GAP


@given(offers, instants)
@settings(max_examples=100, deadline=None)
def test_it_does_not_matter_where_the_clock_stops(sent: list[Offer], stops: list[int]) -> None:
    assert run(BusModel(), sent, stops) == run(BusModel(), sent, [])


def test_statistics_and_load() -> None:
    bus = BusModel()
    assert bus.load == 0.0
    bus.queue(0, USUAL, "a")
    bus.queue(0, SLACK, "b")
    bus.queue(400_000_000, USUAL, "a")
    bus.advance(duration_ns(USUAL) // 2)
    assert bus.load == 1.0
    bus.advance(1_000_000_000)
    one = duration_ns(USUAL) + GAP
    assert duration_ns(SLACK) + GAP == one
    assert bus.load == pytest.approx(3 * one / 1e9, rel=1e-12)
    statistics = bus.statistics
    assert statistics.frames == 3
    assert statistics.sent == {USUAL.can_id: 2, SLACK.can_id: 1}
    assert statistics.longest_wait_ns == {
        USUAL.can_id: duration_ns(USUAL),
        SLACK.can_id: 2 * duration_ns(USUAL) + GAP,
    }
    assert (statistics.lost, statistics.error_frames) == (0, 0)
    assert bus.now_ns == 1_000_000_000


def test_lost_delayed_corrupted_and_inserted_frames() -> None:
    def judge(sent: Transmission) -> tuple[BusFrame, ...]:
        (perfect,) = sent.delivered()
        number = sent.frame.data[0]
        if number == 0:
            return ()
        if number == 1:
            return (perfect._replace(arrival_ns=sent.end_ns + 5_000_000),)
        if number == 2:
            return (perfect._replace(frame=Frame(sent.frame.can_id, b"wrong")),)
        return (perfect, BusFrame(0, sent.end_ns + 7, "stranger", Frame(9, b"inserted")))

    bus = BusModel(frame_filter=judge)
    frames = [Frame(0x100 + number, bytes([number])) for number in range(4)]
    for frame in frames:
        bus.queue(0, frame, "a")
    ends = [end - GAP for end in accumulate(duration_ns(frame) + GAP for frame in frames)]
    assert bus.advance(4_000_000) == [
        BusFrame(0, ends[2], "a", Frame(0x102, b"wrong")),
        BusFrame(0, ends[3], "a", frames[3]),
        BusFrame(0, ends[3] + 7, "stranger", Frame(9, b"inserted")),
    ]
    assert bus.advance(10_000_000) == [BusFrame(0, ends[1] + 5_000_000, "a", frames[1])]
    assert bus.statistics.lost == 1
    assert bus.statistics.frames == 4


def test_what_the_filter_sees() -> None:
    seen: list[Transmission] = []

    def judge(sent: Transmission) -> tuple[BusFrame, ...] | ErrorFrame:
        seen.append(sent)
        return ErrorFrame() if sent.attempt < 3 else sent.delivered()

    bus = BusModel(frame_filter=judge)
    bus.queue(100, USUAL, "a")
    (delivery,) = bus.advance(10**9)
    # A CRC error is flagged after the ACK delimiter, seven bits before the end of frame.
    until_next = duration_ns(USUAL) - 7 * BIT + 23 * BIT
    starts = [100, 100 + until_next, 100 + 2 * until_next]
    assert seen == [
        Transmission(start, start + duration_ns(USUAL), USUAL, "a", 100, attempt)
        for attempt, start in enumerate(starts, 1)
    ]
    assert delivery == BusFrame(100, starts[2] + duration_ns(USUAL), "a", USUAL)
    statistics = bus.statistics
    assert (statistics.frames, statistics.error_frames) == (3, 2)
    assert statistics.sent == {USUAL.can_id: 1}
    assert statistics.busy_ns == 2 * until_next + duration_ns(USUAL) + GAP
    assert statistics.longest_wait_ns[USUAL.can_id] == delivery.arrival_ns - 100


def test_a_more_urgent_frame_overtakes_the_retransmission() -> None:
    bus = BusModel(
        frame_filter=lambda sent: (
            ErrorFrame() if sent.frame is USUAL and sent.attempt == 1 else sent.delivered()
        )
    )
    bus.queue(0, USUAL, "a")
    bus.queue(10, URGENT, "b")
    bus.queue(10, SLACK, "c")
    free_ns = duration_ns(USUAL) + (23 - 7) * BIT
    assert [(d.frame, d.arrival_ns) for d in bus.advance(10**9)] == [
        (URGENT, free_ns + duration_ns(URGENT)),
        (USUAL, free_ns + duration_ns(URGENT) + GAP + duration_ns(USUAL)),
        (SLACK, free_ns + duration_ns(URGENT) + duration_ns(USUAL) + 2 * GAP + duration_ns(SLACK)),
    ]


def test_frames_of_a_bus_off_sender_are_dropped() -> None:
    """Off from 1 to 2 ms: what waits then is dropped, and what is released then."""
    bus = BusModel(is_off=lambda sender, now_ns: sender == "a" and 10**6 <= now_ns < 2 * 10**6)
    for number in range(5):  # 1.3 ms of frames ahead of what follows
        bus.queue(0, Frame(number, b"\x55" * 8), "b")
    bus.queue(0, Frame(0x100, b"waits"), "a")
    bus.queue(1_500_000, Frame(0x101, b"off"), "a")
    bus.queue(2_000_000, Frame(0x102, b"back"), "a")
    bus.queue(1_500_000, Frame(0x200, b"other"), "b")
    assert [d.frame.data for d in bus.advance(10**9)[5:]] == [b"other", b"back"]
    assert bus.statistics.dropped_bus_off == 2
    assert bus.waiting == 0


def test_a_full_transmit_buffer_drops_and_counts() -> None:
    bus = BusModel(capacity=2)
    for number in range(5):
        bus.queue(0, Frame(number, b""), "a")
    bus.queue(0, Frame(9, b""), "b")
    assert [d.frame.can_id for d in bus.advance(10**9)] == [0, 1, 9]
    assert bus.statistics.dropped_full == 3
    bus.queue(10**9, Frame(7, b""), "a")
    assert len(bus.advance(2 * 10**9)) == 1


def test_capacity_counts_frames_that_were_dropped_or_given_up_as_gone() -> None:
    bus = BusModel(
        capacity=1,
        is_off=lambda sender, now_ns: now_ns < 10,
        frame_filter=lambda sent: ErrorFrame(retransmit=False),
    )
    bus.queue(0, USUAL, "a")
    assert bus.advance(10**6) == []
    bus.queue(10**6, USUAL, "a")
    assert bus.advance(10**7) == []
    bus.queue(10**7, USUAL, "a")
    statistics = bus.statistics
    assert statistics.dropped_full == 0
    assert statistics.dropped_bus_off == statistics.error_frames == 1


@pytest.mark.parametrize("bitrate", [0, -1, 9_999, 1_000_001, 333_333, 83_333])
def test_bit_rates_that_do_not_fit_are_refused(bitrate: int) -> None:
    with pytest.raises(InputError, match=f"bitrate: {bitrate} bit/s; expected 10000 to 1000000"):
        BusModel(bitrate)


def test_newer_content_overwrites_what_its_sender_has_waiting_in_the_same_mailbox() -> None:
    bus = BusModel(mailboxes={USUAL.can_id})
    newer, newest = Frame(USUAL.can_id, bytes(8)), Frame(USUAL.can_id, b"\x0f" * 8)
    bus.queue(0, USUAL, "a")  # on the bus at once: no longer in the mailbox
    bus.queue(1, newer, "a")
    bus.queue(2, newer, "b")
    bus.queue(3, newest, "a")
    bus.queue(4, SLACK, "a")
    bus.queue(5, SLACK, "a")  # has no mailbox: both are sent
    sent = [(d.frame, d.sender, d.released_ns) for d in bus.advance(10**9)]
    assert sent[0] == (USUAL, "a", 0)
    assert sent[1:3] == [(newer, "b", 2), (newest, "a", 3)]
    assert [entry[0] for entry in sent[3:]] == [SLACK, SLACK]
    assert bus.statistics.overwritten == 1
    assert bus.statistics.frames == 5


def test_what_is_overwritten_makes_room_in_the_buffer_and_is_not_sent_again() -> None:
    def rejects_once(sent: Transmission) -> ErrorFrame | Sequence[BusFrame]:
        return ErrorFrame() if sent.attempt == 1 and sent.frame == USUAL else sent.delivered()

    bus = BusModel(frame_filter=rejects_once, capacity=2, mailboxes={USUAL.can_id})
    newer = Frame(USUAL.can_id, bytes(8))
    bus.queue(0, USUAL, "a")
    bus.advance(10)  # on the bus, and about to be rejected
    bus.queue(10, newer, "a")
    assert [d.frame for d in bus.advance(10**9)] == [newer]
    assert bus.statistics.overwritten == 1
    bus.queue(10**9, newer, "a")  # nothing waits any more
    bus.queue(10**9, SLACK, "a")
    assert bus.statistics.dropped_full == 0

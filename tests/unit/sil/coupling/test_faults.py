"""Faults: each kind does what its text says, repeatably, and what is not implemented is refused."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec
import pytest

from can_dbc.codec import can_id_of, decode, encode
from can_dbc.e2e import E2eStatus, Protector, Receiver
from can_dbc.errors import InputError
from can_dbc.frame import Frame
from can_dbc.messages import Etc1, Gear, PositionPulse, ShiftRequest
from sil.coupling.bus import BusFrame, BusModel
from sil.coupling.clock import NEVER_NS
from sil.coupling.faults import (
    BusFault,
    BusOff,
    Dead,
    Delay,
    DetectedCorruption,
    FaultPlan,
    FrozenCounter,
    Loss,
    OtherBitRate,
    Stalled,
    UndetectedCorruption,
)

MS = 1_000_000
PERIOD_NS = 10 * MS


def run(
    faults: Sequence[BusFault], count: int = 100, seed: int = 1
) -> tuple[list[BusFrame], FaultPlan, BusModel]:
    """Send `count` protected requests by the driver and as many ETC1 by the controller."""
    plan = FaultPlan(faults, seed)
    bus = BusModel(500_000, frame_filter=plan.frame_filter, is_off=plan.is_off)
    protector = Protector(ShiftRequest)
    for number in range(count):
        bus.queue(number * PERIOD_NS, protector.protect(ShiftRequest(Gear.FORWARD)), "driver")
        bus.queue(number * PERIOD_NS, encode(Etc1(shift_in_process=True)), "controller")
    return bus.advance((count + 1) * PERIOD_NS), plan, bus


def of(deliveries: Sequence[BusFrame], kind: type) -> list[BusFrame]:
    return [d for d in deliveries if d.frame.can_id == can_id_of(kind)]


def statuses(deliveries: Sequence[BusFrame]) -> list[E2eStatus]:
    receiver = Receiver(ShiftRequest)
    return [receiver.receive(d.arrival_ns, d.frame) for d in of(deliveries, ShiftRequest)]


CLEAN, _, _ = run([])


def lateness_ns(deliveries: Sequence[BusFrame]) -> list[int]:
    """How much later than without faults each request arrives."""
    pairs = zip(of(deliveries, ShiftRequest), of(CLEAN, ShiftRequest), strict=True)
    return [late.arrival_ns - clean.arrival_ns for late, clean in pairs]


def test_without_faults_everything_arrives() -> None:
    assert len(CLEAN) == 200
    assert statuses(CLEAN) == [E2eStatus.INITIAL, *[E2eStatus.OK] * 99]
    plan = FaultPlan([], 1)
    assert not plan.touches_frames and plan.hits == {}


def test_loss_takes_bus_time_and_nothing_else_is_touched() -> None:
    lost, plan, bus = run([Loss(message="ShiftRequest", every=3, start_s=0.1, end_s=0.4)])
    assert of(lost, Etc1) == of(CLEAN, Etc1)
    gone = [d for d in of(CLEAN, ShiftRequest) if d not in lost]
    assert [d.released_ns // PERIOD_NS for d in gone] == list(range(10, 40, 3))
    assert plan.hits == {0: 10} and bus.statistics.lost == 10
    assert statuses(lost).count(E2eStatus.OK_SOME_LOST) == 10


def test_how_often_is_bounded_by_count_and_probability() -> None:
    lost, plan, _ = run([Loss(message="ShiftRequest", count=4)])
    assert len(of(lost, ShiftRequest)) == 96 and plan.hits == {0: 4}
    lost, plan, _ = run([Loss(message="ShiftRequest", probability=0.2)], count=2000)
    assert 320 < plan.hits[0] < 480


def test_the_same_seed_draws_the_same_and_another_seed_does_not() -> None:
    faults = [
        Loss(message="ShiftRequest", probability=0.5),
        UndetectedCorruption(message="Etc1", probability=0.5, bits=5),
        Delay(message="Etc1", delay_s=0.0, jitter_s=0.001),
    ]
    first, again, other = (run(faults, seed=seed)[0] for seed in (1, 1, 2))
    assert first == again != other
    alone, _, _ = run(faults[1:])
    assert of(alone, Etc1) != of(first, Etc1), "each fault draws from a generator of its place"


def test_a_detected_corruption_comes_again_after_an_error_frame() -> None:
    for attempts in (1, 3):
        fault = DetectedCorruption(message="ShiftRequest", every=2, attempts=attempts)
        hit, plan, bus = run([fault])
        frames, clean = ([d.frame for d in of(each, ShiftRequest)] for each in (hit, CLEAN))
        assert frames == clean
        assert statuses(hit) == statuses(CLEAN)
        assert bus.statistics.error_frames == plan.hits[0] == 50 * attempts
        late = lateness_ns(hit)
        assert set(late[1::2]) == {0} and min(late[::2]) > attempts * 200_000


def test_an_undetected_corruption_flips_bits_that_e2e_sees() -> None:
    hit, plan, _ = run([UndetectedCorruption(message="ShiftRequest", every=2, bits=1)])
    clean = {d.released_ns: d for d in of(CLEAN, ShiftRequest)}
    for number, found in enumerate(of(hit, ShiftRequest)):
        before = clean[found.released_ns]
        assert found.arrival_ns == before.arrival_ns
        flipped = int.from_bytes(found.frame.data, "big") ^ int.from_bytes(before.frame.data, "big")
        assert flipped.bit_count() == (number + 1) % 2
    assert statuses(hit)[::2] == [E2eStatus.ERROR] * 50
    assert plan.hits == {0: 50}


def test_a_delay_shifts_arrivals_in_whole_microseconds() -> None:
    late, _, _ = run([Delay(message="ShiftRequest", delay_s=0.0042)])
    assert set(lateness_ns(late)) == {4_200_000}
    jittered, _, _ = run([Delay(message="ShiftRequest", delay_s=0.001, jitter_s=0.002)])
    shifts = set(lateness_ns(jittered))
    assert len(shifts) > 50 and all(shift % 1000 == 0 for shift in shifts)
    assert min(shifts) >= 1 * MS and max(shifts) <= 3 * MS
    assert of(late, Etc1) == of(CLEAN, Etc1)


def test_a_frozen_counter_is_a_repetition_with_a_right_checksum() -> None:
    frozen, plan, _ = run([FrozenCounter(message="ShiftRequest", start_s=0.1)])
    found = statuses(frozen)
    assert found[:11] == statuses(CLEAN)[:11]
    assert found[11:] == [E2eStatus.REPEATED] * 89
    assert plan.hits == {0: 90}
    assert all(decode(d.frame) == ShiftRequest(Gear.FORWARD) for d in of(frozen, ShiftRequest))


def test_a_node_that_is_bus_off_neither_sends_nor_receives() -> None:
    start_ns, end_ns = 200 * MS + 400_000, 300 * MS
    off, plan, bus = run([BusOff(node="driver", start_s=0.2004, end_s=0.3)])
    assert of(off, Etc1)[:20] == of(CLEAN, Etc1)[:20]
    clean, sent = ({d.released_ns for d in of(each, ShiftRequest)} for each in (CLEAN, off))
    gone = clean - sent
    assert gone == set(range(200 * MS, end_ns, PERIOD_NS)), "the one in transmission is cut off"
    assert bus.statistics.error_frames == 1 and bus.statistics.dropped_bus_off == 9
    assert plan.bus_off(start_ns) == plan.bus_off(end_ns - 1) == {"driver"}
    assert plan.bus_off(start_ns - 1) == plan.bus_off(end_ns) == frozenset()


def test_a_node_on_another_bit_rate_disturbs_the_bus_until_it_is_bus_off() -> None:
    wrong, plan, bus = run([OtherBitRate(node="driver", start_s=0.2, end_s=0.9)])
    sent = {d.released_ns for d in of(wrong, ShiftRequest)}
    gone = {at for at in range(0, 1000 * MS, PERIOD_NS) if at not in sent}
    assert gone == set(range(200 * MS, 900 * MS, PERIOD_NS))
    assert bus.statistics.error_frames == 15 + 32, "its error flags, then its own attempts"
    assert {d.released_ns for d in of(wrong, Etc1)} == {d.released_ns for d in of(CLEAN, Etc1)}
    assert [d.arrival_ns for d in of(wrong, Etc1)] != [d.arrival_ns for d in of(CLEAN, Etc1)]
    assert plan.is_off("driver", 500 * MS) and not plan.is_off("controller", 500 * MS)
    assert plan.bus_off(200 * MS) == {"driver"} and not plan.bus_off(900 * MS)


def test_the_dead_have_no_events_and_the_stalled_go_on_with_their_schedule() -> None:
    plan = FaultPlan(
        [
            Dead(node="driver", start_s=0.05),
            Stalled(node="controller", start_s=0.02, end_s=0.045),
            Stalled(node="controller", start_s=0.05, end_s=0.06),
        ],
        1,
    )
    assert not plan.touches_frames
    assert plan.next_event("driver", 50 * MS - 1, PERIOD_NS) == 50 * MS - 1
    assert plan.next_event("driver", 50 * MS, PERIOD_NS) == NEVER_NS
    events = [plan.next_event("controller", n * PERIOD_NS, PERIOD_NS) // MS for n in range(9)]
    assert events == [0, 10, 60, 60, 60, 60, 60, 70, 80], "50 is inside the second one"
    assert plan.next_event("plant", 30 * MS, PERIOD_NS) == 30 * MS


def test_faults_add_up_and_error_frames_come_first() -> None:
    faults = [
        Loss(message="ShiftRequest", every=2),
        DetectedCorruption(message="ShiftRequest"),
        Delay(message="ShiftRequest", delay_s=0.001),
    ]
    hit, plan, bus = run(faults)
    assert plan.hits == {0: 50, 1: 100, 2: 100}
    assert bus.statistics.error_frames == 100
    assert [d.released_ns // PERIOD_NS for d in of(hit, ShiftRequest)] == list(range(1, 100, 2))


@pytest.mark.parametrize(
    ("table", "complaint"),
    [
        ({"kind": "melted", "message": "Etc1"}, "Invalid value 'melted'"),
        ({"kind": "loss"}, "missing required field `message`"),
        ({"kind": "loss", "message": "Grant"}, "Invalid enum value 'Grant'"),
        ({"kind": "loss", "message": "Etc1", "probability": 0.0}, "> 0.0"),
        ({"kind": "loss", "message": "Etc1", "start_s": -1.0}, ">= 0.0"),
        ({"kind": "dead", "node": "plant"}, "Invalid enum value 'plant'"),
        ({"kind": "bus_off", "node": "gearbox"}, "Invalid enum value 'gearbox'"),
    ],
)
def test_what_is_not_implemented_is_refused(table: dict[str, object], complaint: str) -> None:
    with pytest.raises(msgspec.ValidationError) as refused:
        msgspec.convert(table, BusFault)
    assert complaint in str(refused.value)


@pytest.mark.parametrize(
    ("fault", "complaint"),
    [
        (Loss(message="Etc1", start_s=1.0, end_s=1.0), r"fault\[1\].end_s: 1.0 s; expected later"),
        (Stalled(node="controller", start_s=1.0), r"fault\[1\].end_s: missing; .*'dead'"),
        (Dead(node="controller", end_s=2.0), r"fault\[1\].end_s: .*'stalled'"),
        (FrozenCounter(message="Etc1"), r"fault\[1\].message: Etc1 carries no counter; expected"),
    ],
)
def test_impossible_faults_are_refused_by_name(fault: BusFault, complaint: str) -> None:
    with pytest.raises(InputError, match=complaint):
        FaultPlan([Loss(message="Etc1"), fault], 1)


def test_frames_of_other_messages_pass_untouched() -> None:
    plan = FaultPlan([Loss(message="PositionPulse")], 1)
    bus = BusModel(500_000, frame_filter=plan.frame_filter)
    unknown = Frame(can_id_of(PositionPulse) + 1, b"abc")
    bus.queue(0, unknown, "restbus")
    assert [d.frame for d in bus.advance(MS)] == [unknown]

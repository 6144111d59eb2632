"""Driver, other traffic and intruder, clocks that drift, and the counts of end-to-end protection."""

from __future__ import annotations

from typing import Any

import pytest

from can_dbc.codec import can_id_of
from can_dbc.e2e import Protector, Receiver
from can_dbc.errors import InputError
from can_dbc.frame import Frame, split_id
from can_dbc.messages import E2eState, Gear, ShiftRequest
from sil.coupling.bus import BusFrame, BusModel
from sil.coupling.faults import Babbling, Replayed, Sent, Spoofed, window_of
from sil.nodes.simulated import Drifting, DriverNode, IntruderNode, TrafficNode
from sil.recording.end_to_end import EndToEnd
from sil.recording.run_record import RunRecord
from sil.simulation import load_scenario

MS = 1_000_000
REQUEST = Frame(can_id_of(ShiftRequest), bytes(8))


def sent(
    fault: Any, heard: dict[int, list[tuple[int, Frame]]] | None = None, until_ms: int = 100
) -> list[tuple[int, Frame]]:
    node = IntruderNode([fault], 500_000, 1)
    at, found = node.start(), []
    while at < until_ms * MS:
        frames, following = node.advance(at, (heard or {}).get(at, []))
        assert all(release >= at for release, _ in frames) and following == at + MS
        found += frames
        at = following
    assert node.advance(at - 1, []) == ([], at)  # the run ends within a millisecond
    node.close()
    return found


def test_babbling_takes_the_bus_while_it_lasts() -> None:
    frames = sent(Babbling(load=0.5, priority=0, start_s=0.02, end_s=0.07))
    bus = BusModel(500_000)
    for release, frame in frames:
        bus.queue(release, frame, "intruder")
    bus.advance(100 * MS)
    assert bus.load == pytest.approx(0.5 * 0.05 / 0.1, rel=0.05)
    assert {split_id(frame.can_id).priority for _, frame in frames} == {0}
    assert frames[0][0] >= 20 * MS and frames[-1][0] < 71 * MS


def test_replayed_frames_come_again_once() -> None:
    heard = {
        5 * MS: [(4 * MS + 7, REQUEST), (5 * MS, Frame(1, b""))],
        60 * MS: [(60 * MS, REQUEST)],
    }
    fault = Replayed(message="ShiftRequest", delay_s=0.03, end_s=0.05)
    assert sent(fault, heard) == [(34 * MS + 7, REQUEST)]


def test_spoofed_frames_are_drawn_by_the_seed() -> None:
    fault = Spoofed(message="ShiftRequest", period_s=0.0025, start_s=0.01, end_s=0.03)
    frames = sent(fault)
    assert [release for release, _ in frames] == [10 * MS + k * 2_500_000 for k in range(8)]
    assert frames == sent(fault)
    assert len({frame.data for _, frame in frames}) == 8
    assert {frame.can_id for _, frame in frames} == {REQUEST.can_id}


@pytest.mark.parametrize("ppm", [0.0, 1000.0, -1000.0, 33.3])
def test_a_drifting_clock_ticks_on_its_own_time(ppm: float) -> None:
    node = Drifting(DriverNode(Gear.NEUTRAL, [(50 * MS, Gear.FORWARD)], 20 * MS, 3 * MS), ppm)
    at, releases = node.start(), []
    for _ in range(200):
        assert node.name == "driver"
        frames, following = node.advance(at, [(at, REQUEST)])
        assert following > at and len(frames) == 1
        releases += [release for release, _ in frames]
        at = following
    own = [release * (1.0 + 1e-6 * ppm) for release in releases]
    assert own == pytest.approx([3 * MS + k * 20 * MS for k in range(200)], abs=1.0 + 1e-3)
    assert node.advance(at - 5, [])[1] == at  # the run ends between two ticks
    node.close()


def test_a_drifting_node_that_stood_still_wakes_at_a_tick_of_its_own() -> None:
    node = Drifting(DriverNode(Gear.NEUTRAL, [], 20 * MS), 1000.0)
    first = node.start()
    _, second = node.advance(first, [])
    _, third = node.advance(second, [])
    late = third + 5 * (third - second)
    frames, following = node.advance(late, [])
    assert len(frames) == 1 and following - late == pytest.approx(20 * MS / 1.001, abs=10)


def test_a_clock_that_has_run_before() -> None:
    ticks = []
    for start_ns in (0, 1000 * MS):
        node = Drifting(DriverNode(Gear.NEUTRAL, [], 20 * MS), -50.0, start_ns)
        first = node.start()
        (frame,), second = node.advance(first, [])
        ticks.append((first, frame[0], second))
    assert ticks[0] == ticks[1] == (0, 0, 20_001_001)


def test_what_the_checks_of_the_frames_found_is_counted() -> None:
    sender = Protector(ShiftRequest)
    good = [sender.protect(ShiftRequest(Gear.NEUTRAL)) for _ in range(6)]
    forged = Frame(good[0].can_id, bytes(len(good[0].data)))
    order = [(good[0], "driver"), (good[1], "driver"), (good[1], "intruder"), (forged, "intruder"),
             (good[2], "intruder"), (good[4], "driver")]  # fmt: skip
    frames = [BusFrame(k * MS, k * MS, who, frame) for k, (frame, who) in enumerate(order)]
    checked = EndToEnd()
    checked.add(RunRecord({}, [], frames[:3], 0.0, 0.0, 0.0, 0.0))
    checked.add(RunRecord({}, [], frames[3:], 0.0, 0.0, 0.0, 0.0))
    assert checked.counts()["ShiftRequest"] == {
        "ok": 2,
        "ok, some lost": 1,
        "repeated": 1,
        "wrong sequence": 0,
        "error": 1,
        "initial": 1,
        "sync": 0,
        "intruder's taken": 1,
    }


def test_an_overloaded_bus_needs_a_limit_of_what_waits() -> None:
    with pytest.raises(InputError, match=r"bus\.send_buffer: missing"):
        load_scenario.load("lab_n_b", settings={"bus.extra_load": 1.2})
    assert load_scenario.load("lab_n_b", settings={"bus.extra_load": 1.2, "bus.send_buffer": 8})


def sent_by(driver: DriverNode, end_ms: int) -> list[tuple[int, Frame]]:
    at, frames = driver.start(), []
    while at <= end_ms * MS:
        released, at = driver.advance(at, [])
        frames += released
    return frames


def test_frames_go_out_on_schedule_and_carry_the_gear_asked_for() -> None:
    schedule = [(35 * MS, Gear.BACKWARD), (60 * MS, Gear.FORWARD)]
    frames = sent_by(DriverNode(Gear.NEUTRAL, schedule, 20 * MS, 5 * MS), 90)
    assert [at // MS for at, _ in frames] == [5, 25, 45, 65, 85]
    receiver = Receiver(ShiftRequest, 100 * MS)
    gears = []
    for at, frame in frames:
        receiver.receive(at, frame)
        gears.append(receiver.message.target if receiver.message else None)
    assert receiver.state(85 * MS) is E2eState.VALID
    assert gears[-3:] == [Gear.BACKWARD, Gear.FORWARD, Gear.FORWARD]


def carried(load: float, seed: int) -> tuple[BusModel, list[tuple[int, int, bytes]]]:
    node, bus = TrafficNode(load, 6, 500_000, seed), BusModel(500_000)
    at, log = node.start(), []
    while at < 2_000 * MS:
        log += [(d.arrival_ns, d.frame.can_id, d.frame.data) for d in bus.advance(at)]
        frames, at = node.advance(at, [])
        for release, frame in frames:
            bus.queue(release, frame, node.name)
    return bus, log


@pytest.mark.parametrize("load", [0.05, 0.4, 0.9])
def test_load_is_what_was_asked_for(load: float) -> None:
    bus, log = carried(load, 1)
    assert bus.load == pytest.approx(load, rel=0.03)
    assert {split_id(can_id).priority for _, can_id, _ in log} == {6}


def test_nothing_between_two_windows() -> None:
    node = TrafficNode(0.5, 3, 500_000, 1)
    assert node.advance(0, [])[1] == 10 * MS
    assert node.advance(4 * MS, []) == ([], 10 * MS)


def test_a_frame_is_sent_once_at_its_instant() -> None:
    fault = Sent(can_id=0x18FF1234, data="01 fF", start_s=0.0305)
    assert sent(fault) == [(30_500_000, Frame(0x18FF1234, b"\x01\xff"))]
    with pytest.raises(InputError, match="one frame has no end"):
        window_of(Sent(can_id=1, start_s=0.1, end_s=0.2))
    with pytest.raises(InputError, match="0x02000001 is on data page 1 to 3"):
        window_of(Sent(can_id=0x2000001))

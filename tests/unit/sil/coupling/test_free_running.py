"""Nodes by their own clock: what counts for a step, what is sent, what a late node does."""

from __future__ import annotations

import errno
import threading
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import can
import pytest

from can_dbc.errors import InputError, RunError
from can_dbc.frame import Frame
from sil.coupling import free_running
from sil.coupling.free_running import FreeNode, epoch_s, open_bus
from sil.coupling.real_time import Pacer
from sil.coupling.transports.channel import Received, Turn
from sil.coupling.transports.local import LocalBus, RunEnded
from sil.coupling.transports.server import Relay, epoch_ns

MS = 1_000_000
EPOCH = 1_700_000_000_000_000_000


class Wall:
    """A clock that only passes by sleeping."""

    def __init__(self) -> None:
        self.now = EPOCH

    def clock(self) -> int:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += round(seconds * 1e9)


class Every10ms:
    """Sends one frame a step, 1 ms after it; notes what it received, and can take long."""

    name = "controller"

    def __init__(self, work: Callable[[int], None] = lambda now_ns: None) -> None:
        self.steps: list[tuple[int, list[int]]] = []
        self.work = work

    def start(self) -> int:
        return 0

    def advance(self, until_ns: int, deliveries: Received) -> Turn:
        self.steps.append((until_ns // MS, [frame.can_id for _, frame in deliveries]))
        assert all(at <= until_ns for at, _ in deliveries)
        self.work(until_ns)
        return [(until_ns + MS, Frame(0x100, bytes([len(self.steps) % 256])))], until_ns + 10 * MS

    def close(self) -> None: ...


class FakeBus:
    """Holds messages by their time of arrival, and notes what is sent."""

    def __init__(self, wall: Wall, *waiting: tuple[float, int]) -> None:
        self.wall = wall
        self.waiting = [(EPOCH + round(at_ms * MS), can_id) for at_ms, can_id in waiting]
        self.sent: list[int] = []
        self.errors: list[can.CanError] = []

    def recv(self, timeout: float) -> can.Message | None:
        if self.errors:
            raise self.errors.pop()
        if not self.waiting or self.waiting[0][0] > self.wall.now:
            return None
        at, can_id = self.waiting.pop(0)
        return can.Message(timestamp=at / 1e9, arbitration_id=can_id, is_extended_id=True)

    def send(self, message: can.Message) -> None:
        self.sent.append((self.wall.now - EPOCH) // MS)


@pytest.fixture
def wall(monkeypatch: pytest.MonkeyPatch) -> Wall:
    wall = Wall()
    monkeypatch.setattr(free_running, "Pacer", lambda: Pacer(1.0, wall.clock, wall.sleep))
    clock = SimpleNamespace(time_ns=wall.clock, sleep=wall.sleep)
    monkeypatch.setattr(free_running, "time", clock)
    return wall


def ran(participant: Every10ms, bus: Any, catches_up: bool = False, s: float = 0.1) -> FreeNode:
    node = FreeNode(participant, bus, catches_up=catches_up)
    node.run(threading.Event(), s)
    return node


def test_frames_count_for_the_step_after_their_arrival(wall: Wall) -> None:
    unit, bus = Every10ms(), FakeBus(wall, (3.0, 1), (10.0, 2), (10.01, 3), (29.9, 4))
    ran(unit, bus)
    assert unit.steps[:4] == [(0, []), (10, [1, 2]), (20, [3]), (30, [4])]
    assert bus.sent == [1 + 10 * k for k in range(9)]


def test_a_late_node_counts_frames_by_their_time_and_makes_up_for_its_steps(wall: Wall) -> None:
    def work(now_ns: int) -> None:
        wall.now += 35 * MS * (now_ns == 10 * MS)

    unit, bus = Every10ms(work), FakeBus(wall, (15.0, 1), (25.0, 2), (44.0, 3))
    node = ran(unit, bus)
    assert unit.steps[1:6] == [(10, []), (20, [1]), (30, [2]), (40, []), (50, [3])]
    assert bus.sent[:6] == [1, 45, 45, 45, 45, 51] and "steps missed" not in node.counts
    assert node.pacer.lateness().max_s == pytest.approx(0.025)


def test_one_that_stood_still_has_missed_its_steps(wall: Wall) -> None:
    def work(now_ns: int) -> None:
        wall.now += 2000 * MS * (now_ns == 10 * MS)

    unit, bus = Every10ms(work), FakeBus(wall)
    node = ran(unit, bus, s=2.1)
    assert [at for at, _ in unit.steps[:4]] == [0, 10, 2010, 2020]
    assert node.counts["steps missed"] == 199 and node.counts["frames too late to send"] == 1
    assert "199 steps missed" in node.report()


def test_the_plant_makes_up_for_everything_and_does_not_send_the_past(wall: Wall) -> None:
    def work(now_ns: int) -> None:
        wall.now += 2000 * MS * (now_ns == 10 * MS)

    plant, bus = Every10ms(work), FakeBus(wall)
    node = ran(plant, bus, catches_up=True, s=2.1)
    assert [at for at, _ in plant.steps] == list(range(0, 2100, 10))
    assert node.counts["frames too late to send"] == pytest.approx(190, abs=2)
    assert bus.sent[0] == 1 and min(bus.sent[1:]) == 2010


def test_an_interface_that_is_down_for_a_while_costs_frames_only(wall: Wall) -> None:
    bus = FakeBus(wall)
    bus.errors = [can.CanOperationError("down", errno.ENETDOWN)] * 3
    unit = Every10ms()
    ran(unit, bus)
    assert len(unit.steps) == 10 and not bus.errors


def test_a_bus_that_is_gone_ends_the_node(wall: Wall) -> None:
    bus = FakeBus(wall)
    bus.errors = [can.CanOperationError("no such device", errno.ENODEV)]
    with pytest.raises(RunError, match="the bus is gone"):
        ran(Every10ms(), bus)
    bus.errors = [RunEnded("the run has ended")]
    unit = Every10ms()
    ran(unit, bus)
    assert not unit.steps


def test_bus_off_is_counted(wall: Wall, monkeypatch: pytest.MonkeyPatch) -> None:
    bus = FakeBus(wall)
    off = [can.Message(is_error_frame=True, arbitration_id=0x40, is_extended_id=False)]
    monkeypatch.setattr(bus, "recv", lambda timeout: off.pop() if off else None)
    assert ran(Every10ms(), bus).counts["bus-off reports"] == 1


def test_stamps_are_the_latest_instant_with_their_low_bits() -> None:
    for ago in (0, 5, 1 << 40):
        assert epoch_ns((EPOCH - ago) & ((1 << 48) - 1), EPOCH) == EPOCH - ago


def message(can_id: int = 0x0CFF2503, **how: Any) -> can.Message:
    return can.Message(**{"arbitration_id": can_id, "is_extended_id": True, "data": b"12"} | how)


@pytest.mark.usefixtures("runtime_folder")
def test_everybody_sends_on_a_free_running_bus() -> None:
    relay = Relay("bench")
    try:
        with LocalBus("bench") as a, LocalBus("bench", receive_own_messages=True) as b:
            only = [{"can_id": 0x0CFF2504, "can_mask": 0x1FFFFFFF, "extended": True}]
            with LocalBus("bench", only) as c:
                assert c.recv(0.0) is None and b.recv(0.01) is None
                a.send(message())
                b.send(message(0x0CFF2504))
                assert [b.recv(60.0).arbitration_id for _ in range(2)] == [0x0CFF2503, 0x0CFF2504]
                found = a.recv(60.0)
                assert found.arbitration_id == 0x0CFF2504 and a.recv(0.05) is None
                assert c.recv(60.0).timestamp == found.timestamp > 1.6e9
            for odd in (message(0x123, is_extended_id=False), message(0x0EFF2503)):
                with pytest.raises(can.CanOperationError, match="expected a classic data frame"):
                    a.send(odd)
            relay.close()
            with pytest.raises(RunEnded, match="has ended"):
                a.recv(60.0)
    finally:
        relay.close()


@pytest.mark.usefixtures("runtime_folder")
def test_a_bus_that_does_not_come_is_reported() -> None:
    reported: list[str] = []
    with pytest.raises(RunError, match=r"no run on local:nobody within 0\.05 s"):
        open_bus("local:nobody", 0.05, reported.append)
    assert len(reported) == 1
    with pytest.raises(InputError, match="expected local:NAME, the name of a CAN interface"):
        open_bus("nocan9")


@pytest.mark.filterwarnings("ignore")
def test_every_interface_of_python_can_opens_or_is_refused_in_one_line() -> None:
    opened = []
    for interface in sorted(can.VALID_INTERFACES - {"opc4local"}):
        try:
            open_bus(f"{interface}:0", bitrate=250_000).shutdown()
            opened.append(interface)
        except InputError as error:
            assert f"'{interface}:0'" in str(error) and "\n" not in str(error)
    assert "virtual" in opened


def test_a_node_on_an_interface_that_neither_filters_nor_knows_the_date() -> None:
    with open_bus("virtual:bench") as ours, open_bus("virtual:bench", receives=[2]) as theirs:
        unit = Every10ms()
        node = FreeNode(unit, theirs, catches_up=False, receives=[2])
        for can_id in (1, 2, 3, 2):
            ours.send(can.Message(arbitration_id=can_id))
        node.run(threading.Event(), 0.05)
        assert [can_id for _, received in unit.steps for can_id in received] == [2, 2]
        message = can.Message(timestamp=5.0)  # seconds since the adapter was plugged in
        assert epoch_s(message) > 1e9 and epoch_s(can.Message(timestamp=2e9)) < 2e9

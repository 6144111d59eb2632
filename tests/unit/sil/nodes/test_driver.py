"""The driver's frames: their schedule, their protection, the gear they carry."""

from __future__ import annotations

from can_dbc.e2e import E2eConfig, Receiver
from can_dbc.frame import Frame
from can_dbc.messages import E2eState, Gear, ShiftRequest
from sil.nodes.driver import DriverNode

MS = 1_000_000


def sent(driver: DriverNode, end_ms: int) -> list[tuple[int, Frame]]:
    at, frames = driver.start(), []
    while at <= end_ms * MS:
        released, at = driver.advance(at, [])
        frames += released
    return frames


def test_frames_go_out_on_schedule_and_carry_the_gear_asked_for() -> None:
    schedule = [(35 * MS, Gear.BACKWARD), (60 * MS, Gear.FORWARD)]
    frames = sent(DriverNode(Gear.NEUTRAL, schedule, 20 * MS, 5 * MS), 90)
    assert [at // MS for at, _ in frames] == [5, 25, 45, 65, 85]
    receiver = Receiver(ShiftRequest, E2eConfig(timeout_ns=100 * MS))
    gears = []
    for at, frame in frames:
        receiver.receive(at, frame)
        gears.append(receiver.message.target if receiver.message else None)
    assert receiver.state(85 * MS) is E2eState.VALID
    assert gears[-3:] == [Gear.BACKWARD, Gear.FORWARD, Gear.FORWARD]


def test_the_end_of_the_run_sends_nothing_between_two_frames() -> None:
    driver = DriverNode(Gear.NEUTRAL, [], 20 * MS)
    assert driver.start() == 0
    assert len(driver.advance(0, [])[0]) == 1
    assert driver.advance(7 * MS, []) == ([], 20 * MS)

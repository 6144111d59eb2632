"""What every strategy keeps towards the bus, with a toy of the actuator: order, numbering, rest, determinism."""

from __future__ import annotations

import inspect
from collections.abc import Sequence

import pytest

from can_dbc.codec import decode, spec_of
from can_dbc.e2e import E2eStatus, Protector, Receiver
from can_dbc.frame import Frame
from can_dbc.messages import (
    ControllerStatus,
    DrivelineSpeeds,
    E2eState,
    Etc1,
    Etc2,
    Gear,
    PositionPulse,
    SafetyBlow,
    ShiftRequest,
    ShiftState,
    ValveCommand,
)
from controller.config import FirmwareConfig
from controller.node import ControllerNode
from controller.strategies import NAMES
from tests.support.toy_actuator import GRID_NS, MS, STROKE_M, Stay, pulse_s

Sent = list[tuple[int, Frame]]
BUS_NS = 500_000
"""From release to arrival, in this toy."""


class Session:
    """Controller, toy actuator and driver, everything by frames."""

    def __init__(self, config: FirmwareConfig, requests: Sequence[tuple[int, Gear]]) -> None:
        self.node = ControllerNode(config)
        self.stay = Stay()
        self.requests = requests
        self.sent: Sent = []
        self.receivers = {
            spec_of(kind).can_id: Receiver(kind)
            for kind in (ValveCommand, SafetyBlow, ControllerStatus)
        }
        self._protect_pulse = Protector(PositionPulse)
        self._protect_request = Protector(ShiftRequest)
        self._protect_speeds = Protector(DrivelineSpeeds)

    def run(self, until_ms: int) -> Session:
        next_ns = self.node.start()
        waiting: Sent = []  # towards the controller
        outgoing: Sent = []  # towards the actuator
        samples = 0
        for now_ns in range(0, until_ms * MS, GRID_NS):
            if now_ns % (10 * MS) == 5 * MS:
                pulse = PositionPulse(pulse_s(self.stay.position_m), 293.15, samples % 256)
                waiting.append((now_ns + 2 * MS, self._protect_pulse.protect(pulse)))
                samples += 1
                speeds = DrivelineSpeeds(50.0, 50.0)
                waiting.append((now_ns + 2 * MS, self._protect_speeds.protect(speeds)))
            if now_ns % (20 * MS) == 3 * MS:
                gear = [g for at_ms, g in self.requests if now_ns >= at_ms * MS][-1]
                waiting.append((now_ns + MS, self._protect_request.protect(ShiftRequest(gear))))
            if now_ns == next_ns:
                due = sorted((d for d in waiting if d[0] <= now_ns), key=lambda d: d[0])
                waiting = [d for d in waiting if d[0] > now_ns]
                frames, next_ns = self.node.advance(now_ns, due)
                self.sent += frames
                outgoing += [(at_ns + BUS_NS, frame) for at_ns, frame in frames]
            self._drive(now_ns, outgoing)
            self.stay.advance(now_ns)
        self.node.close()
        return self

    def _drive(self, now_ns: int, outgoing: Sent) -> None:
        while outgoing and outgoing[0][0] <= now_ns:
            frame = outgoing.pop(0)[1]
            if frame.can_id in self.receivers:
                self.receivers[frame.can_id].receive(now_ns, frame)
        valves = self.receivers[spec_of(ValveCommand).can_id].message
        blow = self.receivers[spec_of(SafetyBlow).can_id].message
        if isinstance(valves, ValveCommand) and isinstance(blow, SafetyBlow):
            energised = [d >= 0.35 for d in (valves.duty_b, valves.duty_n, valves.duty_f)]
            if blow.active:
                energised[blow.chamber] = True
            self.stay.command(now_ns, energised)

    def messages(self, kind: type) -> list[object]:
        can_id = spec_of(kind).can_id
        return [decode(frame) for _, frame in self.sent if frame.can_id == can_id]


WISHES = [(0, Gear.NEUTRAL), (200, Gear.BACKWARD), (900, Gear.FORWARD)]


@pytest.fixture(scope="module", params=list(NAMES))
def session(request: pytest.FixtureRequest) -> Session:
    return Session(FirmwareConfig(strategy=request.param), WISHES).run(2500)


def test_it_shifts(session: Session) -> None:
    assert session.stay.position_m == -STROKE_M
    last = session.messages(ControllerStatus)[-1]
    assert (last.state, last.confirmed, last.faults) == (ShiftState.IDLE, Gear.FORWARD, 0)
    states = [m.state for m in session.messages(ControllerStatus)]  # type: ignore[attr-defined]
    assert set(ShiftState) - set(states) == {ShiftState.FAULT}


@pytest.mark.parametrize("kind", [ValveCommand, SafetyBlow, ControllerStatus, Etc1, Etc2])
def test_cycle_of_every_message_is_that_of_the_dbc(session: Session, kind: type) -> None:
    spec = spec_of(kind)
    times = [at_ns for at_ns, frame in session.sent if frame.can_id == spec.can_id]
    assert times == [100_000 + k * spec.cycle_ns for k in range(250)]


def test_every_protected_frame_is_good_to_its_receiver(session: Session) -> None:
    for receiver in session.receivers.values():
        assert receiver.counts == {E2eStatus.INITIAL: 1, E2eStatus.OK: 249}
        assert receiver.state(2500 * MS) is E2eState.VALID


def test_order_within_a_step_is_that_of_the_priorities(session: Session) -> None:
    """Safety first: the valve command is queued before the blow, the status after both."""
    for k in range(250):
        ids = [frame.can_id for _, frame in session.sent[5 * k : 5 * k + 5]]
        assert ids[:3] == [spec_of(t).can_id for t in (ValveCommand, SafetyBlow, ControllerStatus)]
        assert ids[0] < ids[1] < ids[2]


def test_never_both_gears_and_a_blow_takes_over_from_its_command(session: Session) -> None:
    pairs = zip(session.messages(ValveCommand), session.messages(SafetyBlow), strict=True)
    seen = set()
    lasting = False
    for valves, blow in pairs:
        assert isinstance(valves, ValveCommand) and isinstance(blow, SafetyBlow)
        duties = (valves.duty_b, valves.duty_n, valves.duty_f)
        assert valves.duty_b <= 0.33 or valves.duty_f <= 0.33
        if blow.active:
            others = [duty for i, duty in enumerate(duties) if lasting or i != blow.chamber]
            assert not any(others)  # in its first step the command still holds the coil
        lasting = blow.active
        seen.add(blow.active)
    assert seen == {False, True}


def test_same_frames_from_the_same_inputs(session: Session) -> None:
    assert Session(session.node.config, WISHES).run(2500).sent == session.sent


def test_the_node_is_a_participant() -> None:
    """Structure that the coordinator relies on."""
    node = ControllerNode(FirmwareConfig())
    assert isinstance(node.name, str) and isinstance(node.start(), int)
    assert list(inspect.signature(node.advance).parameters) == ["until_ns", "deliveries"]
    assert list(inspect.signature(node.close).parameters) == []

"""A control unit on frames answers as its program does on messages."""

from __future__ import annotations

import pytest

from can_dbc.codec import decode, encode
from can_dbc.messages import DrivelineSpeeds, E2eState, Gear, PositionPulse, ShiftRequest
from controller.config import FirmwareConfig
from controller.firmware import Firmware, Inputs
from controller.node import ControllerNode
from sil.firmware.frame_steps import FrameSteps

MS = 1_000_000


class Silent(ControllerNode):
    """A control unit that sends nothing."""

    def _step(self, now_ns: int) -> list:
        return []


def inputs(tick: int) -> Inputs:
    """What the sensor shows of a stay in neutral, and a request for backward from 0.2 s on."""
    state = E2eState.VALID if tick else E2eState.INIT
    pulse = decode(encode(PositionPulse(0.0009, 293.15, tick % 256)))
    target = Gear.BACKWARD if tick > 20 else Gear.NEUTRAL
    speeds = decode(encode(DrivelineSpeeds(100.0, 90.0)))
    return Inputs((pulse,) if tick else (), ShiftRequest(target), speeds, state, state, state)


def test_the_answers_are_those_of_the_program() -> None:
    program, unit = Firmware(FirmwareConfig()), FrameSteps(ControllerNode(FirmwareConfig()))
    unit.step(0, inputs(1)._replace(pulses=()))
    program.step(0, inputs(0))
    for tick in range(1, 60):
        expected = program.step(10 * MS * tick, inputs(tick))
        answer = unit.step(10 * MS * tick, inputs(tick))
        assert answer.valves.duty_b == pytest.approx(expected.valves.duty_b, abs=1e-4)
        assert answer.status.state == expected.status.state or tick < 8
    assert answer.valves.duty_b > 0.9


def test_a_unit_that_leaves_a_message_out_is_refused() -> None:
    with pytest.raises(ValueError, match="sent no ValveCommand"):
        FrameSteps(Silent(FirmwareConfig())).step(0, inputs(0))

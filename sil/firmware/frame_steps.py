"""A control unit on frames as a program on messages, for callers that have no bus."""

from __future__ import annotations

from typing import Any

from can_dbc.codec import decode
from can_dbc.e2e import Protector
from can_dbc.frame import Frame
from can_dbc.messages import (
    ControllerStatus,
    DrivelineSpeeds,
    Etc1,
    Etc2,
    PositionPulse,
    SafetyBlow,
    ShiftRequest,
    ValveCommand,
)
from controller.firmware import Inputs, Outputs
from sil.coupling.transports.channel import Participant


class FrameSteps:
    """Has `step` as `controller.firmware.Firmware`; the states of the inputs follow from the frames.

    A protected channel is valid from its second frame on, as on a bus.
    """

    def __init__(self, node: Participant) -> None:
        self._node = node
        self._protectors: dict[type, Protector[Any]] = {
            kind: Protector(kind) for kind in (PositionPulse, ShiftRequest, DrivelineSpeeds)
        }

    def step(self, now_ns: int, inputs: Inputs) -> Outputs:
        """Return the messages of a step, whose time is a tick of the control unit.

        Raises ParticipantLost when the firmware fails, ValueError when it leaves a message out.
        """
        messages = (*inputs.pulses, inputs.request, inputs.speeds)
        frames: list[tuple[int, Frame]] = [
            (now_ns, self._protectors[type(message)].protect(message))
            for message in messages
            if message is not None
        ]
        released, _ = self._node.advance(now_ns, frames)
        by_type: dict[type, Any] = {
            type(message): message for message in (decode(frame) for _, frame in released)
        }
        needed = (ValveCommand, SafetyBlow, ControllerStatus)
        for kind in needed:
            if kind not in by_type:
                raise ValueError(f"the firmware sent no {kind.__name__}; expected one in each step")
        valves, blow, status = (by_type[kind] for kind in needed)
        return Outputs(valves, blow, status, by_type.get(Etc1), by_type.get(Etc2))

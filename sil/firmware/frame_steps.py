"""A control unit on frames as a program on messages, for callers that have no bus."""

from __future__ import annotations

from typing import Any

from can_dbc.codec import decode
from can_dbc.e2e import Protector
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
        kinds = (PositionPulse, ShiftRequest, DrivelineSpeeds)
        self._protectors: dict[type, Protector[Any]] = {kind: Protector(kind) for kind in kinds}

    def step(self, now_ns: int, inputs: Inputs) -> Outputs:
        """Return the messages of a step. Raises ParticipantLost or ValueError when the firmware fails."""
        messages = filter(None, (*inputs.pulses, inputs.request, inputs.speeds))
        frames = [(now_ns, self._protectors[type(m)].protect(m)) for m in messages]
        released, _ = self._node.advance(now_ns, frames)
        sent = [decode(frame) for _, frame in released]
        by_type: dict[type, Any] = {type(message): message for message in sent}
        needed = (ValveCommand, SafetyBlow, ControllerStatus)
        for kind in needed:
            if kind not in by_type:
                raise ValueError(f"the firmware sent no {kind.__name__}; expected one in each step")
        valves, blow, status = (by_type[kind] for kind in needed)
        return Outputs(valves, blow, status, by_type.get(Etc1), by_type.get(Etc2))

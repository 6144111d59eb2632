"""The control unit as a participant on the bus: frames in, a step at every tick, frames out."""

from __future__ import annotations

import abc
from collections.abc import Sequence
from typing import Protocol

from can_dbc import messages
from can_dbc.codec import can_id_of, encode
from can_dbc.e2e import ACCEPTED, Protector, Receiver
from can_dbc.frame import Frame
from controller.config import FirmwareConfig
from controller.firmware import Firmware, Inputs, Outputs
from controller.settings import nanoseconds


class Steps(Protocol):
    """A control unit's program: one step a period."""

    def step(self, now_ns: int, inputs: Inputs) -> Outputs:
        """Take the inputs of one period and return the messages to send."""


class TickingNode(abc.ABC):
    """A control unit that steps at k times its period.

    A frame that arrives at a tick counts for it; all frames of a step are released together, the computation time
    later.
    """

    name = "controller"

    def __init__(self, config: FirmwareConfig) -> None:
        self.config = config
        self.computation_ns = config.computation_ns
        """From the start of the latest step until its frames wait for the bus."""
        self._tick_ns = 0
        self._has_begun = False

    def start(self) -> int:
        """Return the time of the first tick, ns."""
        return self._tick_ns

    def advance(
        self, until_ns: int, deliveries: Sequence[tuple[int, Frame]]
    ) -> tuple[list[tuple[int, Frame]], int]:
        """Take the frames that arrived up to `until_ns`, and step if that is a tick.

        Returns the frames to send with their release times, and the time of the next tick, ns. Ticks are missed after
        a later tick (the control unit stalled, or had not begun) and in a step longer than the period. Raises
        ValueError for another time beyond the next tick that is none itself.
        """
        period_ns = self.config.period_ns
        if until_ns > self._tick_ns:
            missed = -(-(until_ns - self._tick_ns) // period_ns)
            tick_ns = self._tick_ns + missed * period_ns
            if tick_ns != until_ns and self._has_begun:
                raise ValueError(f"advance to {until_ns} ns skips the tick at {self._tick_ns} ns")
            self._tick_ns = tick_ns
        for arrival_ns, frame in deliveries:
            self._receive(arrival_ns, frame)
        if until_ns < self._tick_ns:  # the run ends, or the control unit has just started
            return [], self._tick_ns
        self._has_begun = True
        frames = self._step(until_ns)
        self._tick_ns += max(1, -(-self.computation_ns // period_ns)) * period_ns
        released_ns = until_ns + self.computation_ns
        return [(released_ns, frame) for frame in frames], self._tick_ns

    def close(self) -> None:  # noqa: B027 - most have nothing to release
        """Nothing to release."""

    @abc.abstractmethod
    def _receive(self, arrival_ns: int, frame: Frame) -> None:
        """Take a frame that arrived."""

    @abc.abstractmethod
    def _step(self, now_ns: int) -> list[Frame]:
        """Run a step and return the frames to send."""


class ControllerNode(TickingNode):
    """The firmware with its protected channels.

    Its receivers count frames that are corrupt, too short or out of range; other frames are ignored.
    """

    def __init__(self, config: FirmwareConfig, firmware: Steps | None = None) -> None:
        """Use `firmware` as the program; by default our own."""
        super().__init__(config)
        self.firmware: Steps = Firmware(config) if firmware is None else firmware
        self.outputs: Outputs | None = None
        """Answer of the latest step."""
        e2e = config.e2e
        self.pulses = Receiver(messages.PositionPulse, nanoseconds(e2e.position_timeout_s))
        self.requests = Receiver(messages.ShiftRequest, nanoseconds(e2e.request_timeout_s))
        self.speeds = Receiver(messages.DrivelineSpeeds, nanoseconds(e2e.speeds_timeout_s))
        receivers = (self.pulses, self.requests, self.speeds)
        self._receivers = {can_id_of(receiver.message_type): receiver for receiver in receivers}
        self._protect_valves = Protector(messages.ValveCommand)
        self._protect_blow = Protector(messages.SafetyBlow)
        self._protect_status = Protector(messages.ControllerStatus)
        self._new_pulses: list[messages.PositionPulse] = []

    def _receive(self, arrival_ns: int, frame: Frame) -> None:
        receiver = self._receivers.get(frame.can_id)
        if receiver is None:
            return
        if self.outputs is None:
            receiver.wait_from(arrival_ns)
        status = receiver.receive(arrival_ns, frame)
        if receiver is self.pulses and status in ACCEPTED:
            pulse = self.pulses.message
            assert pulse is not None  # a good status comes with a message
            self._new_pulses.append(pulse)

    def _step(self, now_ns: int) -> list[Frame]:
        if self.outputs is None:  # the clock may have run before
            for receiver in self._receivers.values():
                receiver.wait_from(now_ns)
        inputs = Inputs(
            pulses=tuple(self._new_pulses),
            request=self.requests.message,
            speeds=self.speeds.message,
            position_state=self.pulses.state(now_ns),
            request_state=self.requests.state(now_ns),
            speeds_state=self.speeds.state(now_ns),
        )
        self._new_pulses.clear()
        self.outputs = out = self.firmware.step(now_ns, inputs)
        frames = [
            self._protect_valves.protect(out.valves),
            self._protect_blow.protect(out.blow),
            self._protect_status.protect(out.status),
        ]
        frames += [encode(message) for message in (out.etc1, out.etc2) if message is not None]
        return frames

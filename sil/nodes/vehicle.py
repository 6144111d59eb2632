"""The truck around the actuator: shift console, transmission management, engine, air supply.

A shift from torque to torque (thesis, figure 4.1): the engine's torque is taken out, the actuator
leaves the gear, the engine turns to the speed of the next gear, the actuator engages it, the
torque comes back. Layouts of the messages: `can_dbc` and `sil.j1939.management`.

Assumes: the transmission management and our firmware are one control unit, address 3; the truck
keeps its speed meanwhile; torque changes at a constant rate, and while the engine's speed is
controlled its torque is reported as 0. The speed of the engine is that of the plant's input shaft.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import Enum
from typing import Annotated, Any

import msgspec
from msgspec import Meta

from can_dbc.codec import can_id_of, encode
from can_dbc.e2e import Protector, Receiver
from can_dbc.frame import Frame
from can_dbc.messages import (
    Air1,
    ControllerStatus,
    DrivelineSpeeds,
    E2eState,
    Eec1,
    Eec2,
    Gear,
    OverrideMode,
    ShiftRequest,
    Tc1,
    Tsc1,
)
from sil.coupling.transports.channel import Received, Turn
from sil.j1939.management import ENGINE, NAME_FUNCTIONS, TRANSMISSION, FaultSender, address_claim
from sil.nodes.simulated import Node

TICK_NS = 10_000_000
PERIODS_NS = {
    "ShiftRequest": 20_000_000,
    "Tsc1": TICK_NS,
    "Eec1": TICK_NS,
    "Tc1": 50_000_000,
    "Eec2": 50_000_000,
    "Air1": 1_000_000_000,
}
"""Period of each message; TSC1 only while the transmission controls the engine."""


class VehicleConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A truck around the actuator: engine, shift console and air supply, with their J1939 messages.

    The gears and ratios given here are those of the plant's driveline and of the firmware, too.
    """

    gear_backward: Annotated[int, Meta(ge=-125, le=125)]
    """Number of the gear in the backward position; negative is reverse."""
    gear_forward: Annotated[int, Meta(ge=-125, le=125)]
    """Number of the gear in the forward position."""
    ratio_backward: Annotated[float, Meta(gt=0.0, le=64.0)]
    """Input by output speed in the backward gear."""
    ratio_forward: Annotated[float, Meta(gt=0.0, le=64.0)]
    """Input by output speed in the forward gear."""
    torque: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.6
    """Torque that the driver asks for, as a share of the engine's reference torque."""
    torque_rate_per_s: Annotated[float, Meta(gt=0.0, le=100.0)] = 2.4
    """Change of the torque in a second, in the same shares."""


class _Phase(Enum):
    DRIVE = "drive"
    TORQUE_OUT = "torque out"
    SHIFT = "shift"


class VehicleNode(Node):
    """The truck around the actuator, in the driver's place; a shift that fails leaves it without torque."""

    name = "driver"

    def __init__(
        self,
        config: VehicleConfig,
        initial: Gear,
        schedule: Sequence[tuple[int, Gear]],
        supply_pressure_pa: float,
    ) -> None:
        """`schedule`: instants in ns, ascending, and the gear that the driver asks for from then on."""
        self._config = config
        self._schedule = list(schedule)
        self._wanted = self._gear = initial
        self._phase = _Phase.DRIVE
        self._torque = 0.0 if initial is Gear.NEUTRAL else config.torque
        self._controls_engine = False
        self._numbers = {
            Gear.NEUTRAL: 0,
            Gear.BACKWARD: config.gear_backward,
            Gear.FORWARD: config.gear_forward,
        }
        self._ratios = {Gear.BACKWARD: config.ratio_backward, Gear.FORWARD: config.ratio_forward}
        self._air = Air1(max(0.0, supply_pressure_pa - 101_325.0))  # above the atmosphere
        stale_ns = 50_000_000
        self._status = Receiver(ControllerStatus, stale_ns)
        self._speeds = Receiver(DrivelineSpeeds, stale_ns)
        self._receivers: dict[int, Receiver[Any]] = {
            can_id_of(r.message_type): r for r in (self._status, self._speeds)
        }
        self._request = Protector(ShiftRequest)
        self._fault_sender = FaultSender()
        self._next_ns = 0

    def advance(self, until_ns: int, deliveries: Received) -> Turn:
        """Take the frames that arrived; at a tick, go on with the shift and send what is due."""
        for arrival_ns, frame in deliveries:
            if receiver := self._receivers.get(frame.can_id):
                receiver.receive(arrival_ns, frame)
        if until_ns < self._next_ns:  # the run ends between two ticks
            return [], self._next_ns
        self._next_ns = until_ns + TICK_NS
        while self._schedule and self._schedule[0][0] <= until_ns:
            self._wanted = self._schedule.pop(0)[1]
        status = self._status.message if self._status.state(until_ns) is E2eState.VALID else None
        speeds = self._speeds.message if self._speeds.state(until_ns) is E2eState.VALID else None
        confirmed = Gear.UNKNOWN if status is None else status.confirmed
        self._step(confirmed)
        frames = [] if until_ns else [(0, address_claim(source)) for source in NAME_FUNCTIONS]
        frames += [(until_ns, frame) for frame in self._due(until_ns, confirmed, speeds)]
        frames += self._fault_sender.due(until_ns, None if status is None else status.faults)
        return frames, self._next_ns

    def _step(self, confirmed: Gear) -> None:
        """Go on with the shift, and move the torque towards what is asked of the engine."""
        if self._phase is _Phase.DRIVE and self._wanted is not self._gear:
            self._phase = _Phase.TORQUE_OUT
        if self._phase is _Phase.TORQUE_OUT and self._torque == 0.0:
            self._phase = _Phase.SHIFT
        if self._phase is _Phase.SHIFT:
            self._gear = self._wanted
            if confirmed is self._gear:
                self._phase = _Phase.DRIVE
        reach = self._config.torque_rate_per_s * TICK_NS * 1e-9
        error = self._asked_torque() - self._torque
        self._torque += max(-reach, min(reach, error))

    def _asked_torque(self) -> float:
        drives = self._phase is _Phase.DRIVE and self._gear is not Gear.NEUTRAL
        return self._config.torque if drives else 0.0

    def _due(self, now_ns: int, confirmed: Gear, speeds: DrivelineSpeeds | None) -> list[Frame]:
        """Return the frames of the messages that are due."""
        overrides = self._phase is not _Phase.DRIVE
        controls, self._controls_engine = self._controls_engine, overrides
        messages: dict[str, Any] = {
            "Tc1": Tc1(self._numbers[self._wanted]),
            "Eec1": self._eec1(overrides, speeds),
            "Eec2": Eec2(self._config.torque, self._torque),
            "Air1": self._air,
        }
        frames = []
        if now_ns % PERIODS_NS["ShiftRequest"] == 0:
            frames.append(self._request.protect(ShiftRequest(self._gear)))
        if overrides or controls:  # the last one says that it no longer does
            frames.append(encode(self._tsc1(confirmed, speeds)))
        due = (message for name, message in messages.items() if now_ns % PERIODS_NS[name] == 0)
        frames += map(encode, due)
        return frames

    def _tsc1(self, confirmed: Gear, speeds: DrivelineSpeeds | None) -> Tsc1:
        """Ask for no torque in gear, for the speed of the next gear out of it."""
        if self._phase is _Phase.DRIVE:
            return Tsc1(OverrideMode.NONE)
        ratio, no_torque = self._ratios.get(self._gear), Tsc1(OverrideMode.TORQUE, torque=0.0)
        if self._phase is _Phase.TORQUE_OUT or ratio is None or speeds is None:
            return no_torque
        if confirmed is not Gear.NEUTRAL and speeds.referred is not self._gear:
            return no_torque
        return Tsc1(OverrideMode.SPEED, speed_rad_s=max(0.0, speeds.output_rad_s * ratio))

    def _eec1(self, overrides: bool, speeds: DrivelineSpeeds | None) -> Eec1:
        speed_rad_s = None
        if speeds is not None and speeds.referred in self._ratios:
            speed_rad_s = max(0.0, speeds.input_rad_s * self._ratios[speeds.referred])
        return Eec1(
            torque_mode=6 if overrides else 1,  # by the transmission, by the pedal
            driver_torque=self._config.torque,
            torque=self._torque,
            speed_rad_s=speed_rad_s,
            controlling_address=TRANSMISSION if overrides else ENGINE,
            demand_torque=self._asked_torque(),
        )

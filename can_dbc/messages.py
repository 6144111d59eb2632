"""One frozen dataclass per message of the simulated bus, in SI units, with the enums they use.

Values lie on the grid of the DBC after a round trip. Counter and CRC are not fields: `can_dbc.e2e` owns them.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum, IntEnum, IntFlag

GEAR_PARK = 126
"""Value of the J1939 gear fields that means park (raw 251)."""


class Code(IntEnum):
    """A coded value, with the hash of any other int that equals it."""

    __hash__ = int.__hash__


class Gear(Code):
    """Position of the length stroke; UNKNOWN while none is confirmed."""

    NEUTRAL = 0
    BACKWARD = 1
    FORWARD = 2
    UNKNOWN = 3


class Chamber(Code):
    """Air chamber of the actuator; NONE where no chamber is meant."""

    B = 0
    N = 1
    F = 2
    NONE = 3


class ShiftState(Code):
    """State of the firmware's shift sequence."""

    INIT = 0
    IDLE = 1
    PUSH = 2
    CONFIRM = 3
    BLOW = 4
    HOLD = 5
    VENT = 6
    FAULT = 7


class Fault(IntFlag):
    """Faults that the firmware detects, one bit each."""

    NONE = 0
    POSITION_LOST = 1
    POSITION_IMPLAUSIBLE = 2
    REQUEST_LOST = 4
    SPEEDS_LOST = 8
    SHIFT_TIMEOUT = 16
    SENSOR_STUCK = 32
    REQUEST_INVALID = 64
    INTERNAL = 128

    __hash__ = int.__hash__


class ParticipantId(IntEnum):
    """Numbers of the known participants in lockstep frames; others may use 4 to 254."""

    COORDINATOR = 0
    PLANT = 1
    CONTROLLER = 2
    DRIVER = 3


class StopReason(IntEnum):
    """Why the coordinator ends a lockstep run."""

    END = 0
    ABORTED = 1


class OverrideMode(Code):
    """What TSC1 asks of the engine (SPN 695)."""

    NONE = 0
    SPEED = 1
    TORQUE = 2
    LIMIT = 3


class E2eState(Enum):
    """Trust in a protected channel; INIT includes AUTOSAR's NODATA (nothing received yet)."""

    INIT = "init"
    VALID = "valid"
    INVALID = "invalid"

    __hash__ = object.__hash__


class Message:
    """Any message of the simulated bus."""

    __slots__ = ()


@dataclass(frozen=True, slots=True)
class ShiftRequest(Message):
    """The driver's or vehicle's request for a gear; shift console to OPC4, every 20 ms."""

    target: Gear


@dataclass(frozen=True, slots=True)
class ValveCommand(Message):
    """Duty cycles 0..1 of the three solenoid valves and the gear they serve; OPC4, every tick."""

    duty_b: float
    duty_n: float
    duty_f: float
    target: Gear


@dataclass(frozen=True, slots=True)
class SafetyBlow(Message):
    """The blow into a chamber after confirmation, and how long it still lasts; OPC4, every tick."""

    chamber: Chamber
    active: bool
    remaining_s: float


@dataclass(frozen=True, slots=True)
class PositionPulse(Message):
    """One measurement of the inductive sensor: time to 8 V, coil temperature, number mod 256."""

    pulse_s: float
    coil_temperature_k: float
    sample_index: int


@dataclass(frozen=True, slots=True)
class DrivelineSpeeds(Message):
    """Shaft speeds referred to the synchronizer: equal means synchronized; every 10 ms.

    referred: the gear with whose ratio the input speed is referred; UNKNOWN if not stated.
    """

    input_rad_s: float
    output_rad_s: float
    referred: Gear = Gear.UNKNOWN


@dataclass(frozen=True, slots=True)
class ControllerStatus(Message):
    """The firmware's state, confirmed gear, position estimate and faults; OPC4, every tick."""

    state: ShiftState
    confirmed: Gear
    estimate_m: float
    faults: Fault


@dataclass(frozen=True, slots=True)
class Etc1(Message):
    """J1939 Electronic Transmission Controller 1 (PGN 61442), source address 3, every 10 ms.

    None: the sender has no valid value (sent as not available; received as that or as error).
    SPN: driveline engaged 560, lockup 573, shift in process 574, lockup transition 4816, output
    shaft speed 191, clutch slip (0..1) 522, momentary overspeed 606, progressive shift disabled
    607, momentary maximum power 5015, input shaft speed 161, controlling address 1482.
    """

    driveline_engaged: bool | None = None
    torque_converter_lockup: bool | None = None
    shift_in_process: bool | None = None
    lockup_transition: bool | None = None
    output_shaft_rad_s: float | None = None
    clutch_slip: float | None = None
    momentary_overspeed: bool | None = None
    progressive_shift_disabled: bool | None = None
    momentary_maximum_power: bool | None = None
    input_shaft_rad_s: float | None = None
    controlling_address: int | None = None


@dataclass(frozen=True, slots=True)
class Etc2(Message):
    """J1939 Electronic Transmission Controller 2 (PGN 61445), source address 3, every 10 ms.

    Gears: negative reverse, 0 neutral, positive forward, `GEAR_PARK` park. Ranges: the two
    characters as shown to the driver, the second one used first (" N"). None: no valid value.
    SPN: selected gear 524, actual ratio 526, current gear 523, requested range 162, current 163.
    """

    selected_gear: int | None = None
    gear_ratio: float | None = None
    current_gear: int | None = None
    requested_range: str | None = None
    current_range: str | None = None


@dataclass(frozen=True, slots=True)
class Tsc1(Message):
    """J1939 Torque/Speed Control 1 (PGN 0), from the transmission to the engine, every 10 ms.

    SPN: override mode 695, requested speed 898, requested torque (of the reference torque) 518.
    """

    mode: OverrideMode
    speed_rad_s: float | None = None
    torque: float | None = None


@dataclass(frozen=True, slots=True)
class Tc1(Message):
    """J1939 Transmission Control 1 (PGN 256), shift console, every 50 ms; requested gear (SPN 525) as in `Etc2`."""

    requested_gear: int | None


@dataclass(frozen=True, slots=True)
class Eec1(Message):
    """J1939 Electronic Engine Controller 1 (PGN 61444), every 10 ms.

    Torques as shares of the reference torque. SPN: torque mode 899 (1 pedal, 6 transmission),
    driver's demand 512, actual torque 513, speed 190, controlling address 1483, demand 2432.
    """

    torque_mode: int
    driver_torque: float | None = None
    torque: float | None = None
    speed_rad_s: float | None = None
    controlling_address: int | None = None
    demand_torque: float | None = None


@dataclass(frozen=True, slots=True)
class Eec2(Message):
    """J1939 Electronic Engine Controller 2 (PGN 61443), every 50 ms.

    SPN: accelerator pedal (0..1) 91, load at the present speed (0..1.25) 92.
    """

    pedal: float | None = None
    load: float | None = None


@dataclass(frozen=True, slots=True)
class Air1(Message):
    """J1939 Air Supply Pressure (PGN 65198), every second; supply (SPN 46) above atmosphere."""

    supply_gauge_pa: float | None


@dataclass(frozen=True, slots=True)
class PlantMotion(Message):
    """True motion for recorders: stay position and velocity, positions of the two pistons."""

    position_m: float
    velocity_m_s: float
    piston_1_m: float
    piston_2_m: float


@dataclass(frozen=True, slots=True)
class PlantPressures(Message):
    """True absolute pressures for recorders: chambers B, N, F and supply."""

    pressure_b_pa: float
    pressure_n_pa: float
    pressure_f_pa: float
    supply_pa: float


SIGNALS: dict[type, tuple[str, ...]] = {
    ShiftRequest: ("TargetGear",),
    ValveCommand: ("DutyB", "DutyN", "DutyF", "TargetGear"),
    SafetyBlow: ("BlowChamber", "BlowActive", "BlowRemaining"),
    PositionPulse: ("PulseDuration", "CoilTemperature", "SampleIndex"),
    DrivelineSpeeds: ("InputSpeed", "OutputSpeed", "ReferredGear"),
    ControllerStatus: ("State", "ConfirmedGear", "PositionEstimate", "Faults"),
    Etc1: (
        "DrivelineEngaged",
        "TorqueConverterLockup",
        "ShiftInProcess",
        "LockupTransition",
        "OutputShaftSpeed",
        "ClutchSlip",
        "MomentaryOverspeed",
        "ProgressiveShiftDisable",
        "MomentaryMaximumPower",
        "InputShaftSpeed",
        "ControllingAddress",
    ),
    Etc2: ("SelectedGear", "GearRatio", "CurrentGear", "RequestedRange", "CurrentRange"),
    Tsc1: ("OverrideMode", "RequestedSpeed", "RequestedTorque"),
    Tc1: ("RequestedGear",),
    Eec1: (
        "TorqueMode",
        "DriverTorque",
        "ActualTorque",
        "EngineSpeed",
        "ControllingAddress",
        "DemandTorque",
    ),
    Eec2: ("AcceleratorPedal", "EngineLoad"),
    Air1: ("SupplyPressure",),
    PlantMotion: ("Position", "Velocity", "Piston1", "Piston2"),
    PlantPressures: ("PressureB", "PressureN", "PressureF", "PressureSupply"),
}
"""Signals of each message in the order of its fields."""

TRUCK = (Tsc1, Tc1, Eec1, Eec2, Air1)
"""Messages that are on the bus only around a truck."""

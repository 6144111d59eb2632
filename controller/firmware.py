"""The control unit's program: one step from inputs to outputs, without clock, input or output."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

from can_dbc.messages import (
    Chamber,
    ControllerStatus,
    DrivelineSpeeds,
    E2eState,
    Etc1,
    Etc2,
    Fault,
    Gear,
    PositionPulse,
    SafetyBlow,
    ShiftRequest,
    ShiftState,
    ValveCommand,
)
from controller.broadcast import Broadcast
from controller.config import FirmwareConfig, create_strategy
from controller.position import Estimate, GearWindows, PositionEstimator
from controller.settings import ControlConfig, nanoseconds
from controller.shift import Event, Observation, ShiftMachine
from controller.strategies import OFF, Duties, ShiftContext, one_chamber


class Interlock:
    """Refuses to fill backward and forward together, or too soon one after the other."""

    def __init__(self, config: ControlConfig) -> None:
        self._duty_closed = config.duty_closed
        # a command acts for its whole period
        self._apart_ns = nanoseconds(config.shift.interlock_s) + config.period_ns
        self._energised_ns: list[int | None] = [None, None, None]

    def clear(self, now_ns: int, chamber: Chamber) -> bool:
        """Return whether a chamber has been off for the interlock time, closing valve included."""
        last_ns = self._energised_ns[chamber]
        return last_ns is None or now_ns - last_ns >= self._apart_ns

    def allows(self, now_ns: int, duties: Duties) -> bool:
        """Return whether the duties are duties and respect the interlock."""
        closed = self._duty_closed
        b, n, f = duties
        if not (0.0 <= b <= 1.0 and 0.0 <= n <= 1.0 and 0.0 <= f <= 1.0):
            return False
        if b > closed:
            return f <= closed and self.clear(now_ns, Chamber.F)
        return f <= closed or self.clear(now_ns, Chamber.B)

    def note(self, now_ns: int, duties: Duties, blown: Chamber) -> None:
        """Note which chambers are filled in this step: by a command, or blown."""
        for chamber, duty in zip((Chamber.B, Chamber.N, Chamber.F), duties, strict=True):
            if duty > self._duty_closed or chamber is blown:
                self._energised_ns[chamber] = now_ns


CHAMBER_OF = {
    Gear.BACKWARD: Chamber.B,
    Gear.NEUTRAL: Chamber.N,
    Gear.FORWARD: Chamber.F,
    Gear.UNKNOWN: Chamber.NONE,
}
"""Chamber whose filling leads to a gear."""


_valve_command = lru_cache(ValveCommand)
_status = lru_cache(ControllerStatus)
"""Most messages repeat the one before, which is then encoded once."""


class Inputs(NamedTuple):
    """Messages since the last step: all new pulses, and the latest good one of the others."""

    pulses: tuple[PositionPulse, ...] = ()
    request: ShiftRequest | None = None
    speeds: DrivelineSpeeds | None = None
    position_state: E2eState = E2eState.INIT
    request_state: E2eState = E2eState.INIT
    speeds_state: E2eState = E2eState.INIT


class Outputs(NamedTuple):
    """The messages of one step; ETC1 and ETC2 are None where they are not due."""

    valves: ValveCommand
    blow: SafetyBlow
    status: ControllerStatus
    etc1: Etc1 | None
    etc2: Etc2 | None


class Firmware:
    """Today's control unit, with the strategy of the settings.

    No input or output, no clock, bounded work per step: the same calls give the same results. It never energises
    backward and forward together, nor a valve in FAULT, and confirms a gear only while the position estimate is in
    that gear's window.
    """

    def __init__(self, config: FirmwareConfig) -> None:
        self.config = config
        self._estimator = PositionEstimator(config)
        self._windows = GearWindows(config.windows)
        self._strategy = create_strategy(config)
        self._machine = ShiftMachine(config, self._strategy.blow_s)
        self._broadcast = Broadcast(config.broadcast, self._machine)
        self._startup_ns = nanoseconds(config.e2e.startup_s)
        self._interlock = Interlock(config)
        self._sync_tolerance_rad_s = config.shift.sync_tolerance_rad_s
        self._start_ns: int | None = None  # until the first step
        self._now_ns = 0
        self._latched = Fault.NONE
        self._valid_before = dict.fromkeys(("position", "request", "speeds"), False)
        self._position_timeout_ns = nanoseconds(config.e2e.position_timeout_s)
        self._sampled_ns = 0
        self._speeds: DrivelineSpeeds | None = None
        self._speeds_ns = 0
        self._duties = OFF  # of the latest step

    def step(self, now_ns: int, inputs: Inputs) -> Outputs:
        """Take the inputs of one period and return the messages to send. Raises ValueError unless time increases."""
        if self._start_ns is None:
            self._start_ns = self._sampled_ns = now_ns
            self._broadcast.start(now_ns)
        elif now_ns <= self._now_ns:
            raise ValueError(f"step at {now_ns} ns after one at {self._now_ns} ns")
        self._now_ns = now_ns
        waking = now_ns - self._start_ns < self._startup_ns

        estimate, position_faults = self._sense(now_ns, inputs, waking)
        live, requested = self._judge_inputs(inputs, waking)
        if position_faults:  # a union of flags takes longer than most of a step
            live |= position_faults
        speeds = inputs.speeds if inputs.speeds_state is E2eState.VALID else None
        self._run_machine(now_ns, estimate, requested, speeds)
        if speeds is not self._speeds:
            self._speeds, self._speeds_ns = speeds, now_ns
        duties = self._drive(now_ns, estimate)

        machine = self._machine
        if machine.raised == Fault.SENSOR_STUCK:
            self._estimator.distrust()
        if machine.state is ShiftState.FAULT and not self._latched:
            self._latched = machine.raised | position_faults
        elif machine.event is Event.RECOVERED:
            self._latched = Fault.NONE
        if self._estimator.stuck:
            live |= Fault.SENSOR_STUCK
        if self._latched:
            live |= self._latched
        self._duties = duties
        return self._report(now_ns, estimate, duties, live, speeds)

    def _lost(self, channel: str, state: E2eState, waking: bool) -> bool:
        """Whether a channel is lost: no longer valid, or never valid when it should be by now."""
        if state is E2eState.VALID:
            self._valid_before[channel] = True
            return False
        return state is E2eState.INVALID or self._valid_before[channel] or not waking

    def _sense(self, now_ns: int, inputs: Inputs, waking: bool) -> tuple[Estimate, Fault]:
        """Return estimate and faults of the position; a valid channel without a usable sample for its timeout is lost."""
        lost = self._lost("position", inputs.position_state, waking)
        valid = inputs.position_state is E2eState.VALID
        if not valid:
            self._sampled_ns = now_ns
        estimate = self._estimator.update(inputs.pulses, not valid)
        if estimate.samples:
            self._sampled_ns = now_ns
        elif now_ns - self._sampled_ns > self._position_timeout_ns:
            lost = True
            estimate = self._estimator.update((), True)
        faults = Fault.POSITION_LOST if lost else Fault.NONE
        if self._estimator.implausible:
            faults |= Fault.POSITION_IMPLAUSIBLE
        return estimate, faults

    def _judge_inputs(self, inputs: Inputs, waking: bool) -> tuple[Fault, Gear | None]:
        """Return the faults of request and speeds, and the driver's request if it is valid."""
        lost = self._lost("speeds", inputs.speeds_state, waking)
        live = Fault.SPEEDS_LOST if lost else Fault.NONE
        if self._lost("request", inputs.request_state, waking):
            live |= Fault.REQUEST_LOST
        if inputs.request_state is not E2eState.VALID or inputs.request is None:
            return live, None
        if inputs.request.target is Gear.UNKNOWN:
            return live | Fault.REQUEST_INVALID, None
        return live, inputs.request.target

    def _run_machine(
        self,
        now_ns: int,
        estimate: Estimate,
        requested: Gear | None,
        speeds: DrivelineSpeeds | None,
    ) -> None:
        windows = self._windows
        windows.update(estimate)
        trusted = not self._estimator.stuck
        agree = None
        if speeds is not None:
            apart_rad_s = abs(speeds.input_rad_s - speeds.output_rad_s)
            agree = apart_rad_s <= self._sync_tolerance_rad_s
        machine = self._machine
        observed = Observation(
            position_valid=estimate.valid,
            gear=windows.gear if trusted else Gear.UNKNOWN,
            run=windows.run,
            moved=self._estimator.moved,
            requested=requested,
            synchronized=agree,
            clear_b=self._interlock.clear(now_ns, Chamber.F),
            clear_f=self._interlock.clear(now_ns, Chamber.B),
            recoverable=not (self._latched and self._latched & Fault.INTERNAL),
        )
        machine.step(now_ns, observed)
        if machine.event is Event.LEG_STARTED:
            self._estimator.mark()
        if machine.event is Event.LEG_STARTED or machine.event is Event.PAUSE_OVER:
            self._strategy.reset()

    def _drive(self, now_ns: int, estimate: Estimate) -> Duties:
        """Ask the strategy while a push is under way, check its answer, and note what is filled."""
        machine = self._machine
        duties = OFF
        if machine.driving:
            speeds = self._speeds
            shift = ShiftContext(
                leg=machine.leg,
                charged=CHAMBER_OF[machine.leg],
                start_ns=machine.attempt_ns,
                attempt=machine.attempt,
                apart_rad_s=None if speeds is None else speeds.input_rad_s - speeds.output_rad_s,
                apart_ns=self._speeds_ns,
            )
            duties = self._strategy.command(now_ns, estimate, shift)
            if not self._interlock.allows(now_ns, duties):
                machine.fail(Fault.INTERNAL)
                duties = OFF
        blown = self._blown()
        if machine.event is Event.CONFIRMED:  # SafetyBlow arrives later: hold the coil until then
            duties = one_chamber(blown, self._duties[blown])
        self._interlock.note(now_ns, duties, blown)
        return duties

    def _blown(self) -> Chamber:
        machine = self._machine
        return CHAMBER_OF[machine.leg] if machine.state is ShiftState.BLOW else Chamber.NONE

    def _report(
        self,
        now_ns: int,
        estimate: Estimate,
        duties: Duties,
        faults: Fault,
        speeds: DrivelineSpeeds | None,
    ) -> Outputs:
        machine = self._machine
        blown = self._blown()
        target = machine.leg if machine.driving else machine.confirmed
        valves = _valve_command(*duties, target)
        status = _status(machine.state, machine.confirmed, estimate.position_m, faults)
        blow = SafetyBlow(Chamber.NONE, False, 0.0)
        if blown is not Chamber.NONE:
            blow = SafetyBlow(blown, True, machine.blow_remaining_ns(now_ns) / 1e9)
        broadcast = self._broadcast
        return Outputs(valves, blow, status, broadcast.etc1(now_ns, speeds), broadcast.etc2(now_ns))

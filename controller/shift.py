"""The shift state machine: request, push, confirm, safety blow, hold, vent, faults."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from enum import Enum
from typing import NamedTuple

from can_dbc.messages import Fault, Gear, ShiftState
from controller.settings import ControlConfig, nanoseconds

BlowLength = Callable[[float, Gear, bool], float]


class Event(Enum):
    """What makes the machine change its state; the value describes it."""

    GEAR_FOUND = "the stay is in a gear long enough"
    INIT_TIMEOUT = "no gear found in time"
    LEG_STARTED = "a leg begins"
    LEG_WAITS = "a leg must wait for the opposite chamber or the shaft speeds"
    WINDOW_ENTERED = "the stay enters the window of the leg's gear"
    WINDOW_LEFT = "the stay leaves the window again"
    CONFIRMED = "the gear is confirmed and its blow begins"
    SLIPPED = "the stay leaves the gear during the blow"
    SHIFT_DONE = "the last leg is confirmed and its blow over"
    WAIT_CANCELLED = "neutral is requested while a leg waits"
    HOLD_OVER = "the hold time is over"
    VENT_OVER = "the vent time is over"
    RETRY = "the push timed out, a retry is left"
    PAUSE_OVER = "the pause before the retry is over"
    FAILED = "the push failed for good"
    POSITION_LOST = "the position is not valid"
    RECOVERED = "a new request after a fault that is gone"


S = ShiftState
DRIVING = (S.PUSH, S.CONFIRM)
UNDER_WAY = (*DRIVING, S.BLOW, S.HOLD, S.VENT)
"""States of a shift in process, its after-treatment included."""

TRANSITIONS: Mapping[tuple[ShiftState, Event], ShiftState] = {
    (state, event): target
    for states, event, target in (
        ((S.INIT,), Event.GEAR_FOUND, S.IDLE),
        ((S.INIT,), Event.INIT_TIMEOUT, S.IDLE),
        ((S.IDLE, *UNDER_WAY), Event.LEG_STARTED, S.PUSH),
        ((S.IDLE, *UNDER_WAY), Event.LEG_WAITS, S.HOLD),
        ((S.PUSH,), Event.WINDOW_ENTERED, S.CONFIRM),
        ((S.CONFIRM,), Event.WINDOW_LEFT, S.PUSH),
        (DRIVING, Event.CONFIRMED, S.BLOW),
        ((S.BLOW,), Event.SLIPPED, S.PUSH),
        ((*DRIVING, S.BLOW), Event.SHIFT_DONE, S.HOLD),
        ((S.HOLD,), Event.WAIT_CANCELLED, S.VENT),
        ((S.HOLD,), Event.HOLD_OVER, S.VENT),
        ((S.VENT,), Event.VENT_OVER, S.IDLE),
        (DRIVING, Event.RETRY, S.VENT),
        ((S.VENT,), Event.PAUSE_OVER, S.PUSH),
        (DRIVING, Event.FAILED, S.FAULT),
        ((S.INIT, S.IDLE), Event.POSITION_LOST, S.INIT),
        ((*UNDER_WAY, S.FAULT), Event.POSITION_LOST, S.FAULT),
        ((S.FAULT,), Event.RECOVERED, S.INIT),
    )
    for state in states
}
"""The next state by state and event; the machine changes its state by this table alone."""


class Observation(NamedTuple):
    """What the machine observes in one step.

    `gear`, `run`: whose window the position is in, for how many samples in a row; `moved`: since this leg began;
    `requested`, `synchronized`: None without a valid request, or speeds; `clear_b`, `clear_f`: the chamber *opposite*
    to that gear has been off long enough; `recoverable`: the fault state may be left.
    """

    position_valid: bool
    gear: Gear
    run: int
    moved: bool
    requested: Gear | None
    synchronized: bool | None
    clear_b: bool
    clear_f: bool
    recoverable: bool


class ShiftMachine:
    """Sequence of a gear shift, one transition of `TRANSITIONS` per step at most.

    From gear to gear the way leads through neutral: after the blow into N the next PUSH follows at once. A request
    counts when it differs from the confirmed gear and from the last one served (or failed): nothing is tried again by
    itself. A push ends the confirmation of the gear it leaves.

    A request that changes: on the way to neutral only what follows changes; a push into, or a blow on, a gear is given
    up and neutral pushed; in HOLD and VENT the new shift starts at once. One that is lost: the leg under way is
    finished, none follows. A lost position, or a push that fails, ends in FAULT, left by a request other than the
    failed one once the faults are gone.
    """

    def __init__(self, config: ControlConfig, blow_s: BlowLength) -> None:
        self._shift = shift = config.shift
        self._blow = config.blow
        self._blow_s = blow_s
        self._samples = config.windows.samples
        sensor_ns = nanoseconds(config.sensor.period_s)
        settle = -(-nanoseconds(shift.init_settle_s) // sensor_ns)  # rounded up
        self._init_samples = max(self._samples, settle)

        self.state = ShiftState.INIT
        self.event: Event | None = None  # of the latest step
        self.confirmed = Gear.UNKNOWN
        self.leg = Gear.UNKNOWN  # gear of the present push, or of the next one
        self.final = Gear.UNKNOWN  # gear at the end of the shift
        self.attempt = 0
        self.attempt_ns = 0
        self.raised = Fault.NONE
        self._served: Gear | None = None
        self._pending = False  # HOLD or VENT before a push, rather than after a shift
        self._leg_ns = 0
        self._earliest_ns = 0
        self._until_ns = 0
        self._init_ns: int | None = None

    @property
    def driving(self) -> bool:
        """Whether the strategy has the valves."""
        return self.state is S.PUSH or self.state is S.CONFIRM

    @property
    def in_process(self) -> bool:
        """Whether a requested gear is still to be reached."""
        if self.state is S.BLOW:
            return self.final != self.leg
        return self.driving or self._pending

    def blow_remaining_ns(self, now_ns: int) -> int:
        """Return the rest of the blow, ns; 0 without one."""
        return self._until_ns - now_ns if self.state is S.BLOW else 0

    def step(self, now_ns: int, observed: Observation) -> None:
        """Make at most one transition; the attributes hold until the next step."""
        self.event = None
        self.raised = Fault.NONE
        if not observed.position_valid:
            self._lose_position()
            return
        if self.confirmed != observed.gear:
            self.confirmed = Gear.UNKNOWN
        match self.state:
            case S.INIT:
                self._init(now_ns, observed)
            case S.IDLE:
                self._confirm_again(observed, observed.gear)
                self._serve(now_ns, observed)
            case S.PUSH | S.CONFIRM:
                self._push(now_ns, observed)
            case S.BLOW:
                self._blowing(now_ns, observed)
            case S.HOLD:
                self._hold(now_ns, observed)
            case S.VENT:
                self._vent(now_ns, observed)
            case _:  # FAULT
                self._recover(observed)

    def fail(self, fault: Fault) -> None:
        """Give up a push and enter FAULT; the request that led here counts as served."""
        self._change(Event.FAILED)
        self._give_up(fault)

    def _change(self, event: Event) -> None:
        self.event = event
        self.state = TRANSITIONS[self.state, event]

    def _give_up(self, fault: Fault) -> None:
        self.confirmed = Gear.UNKNOWN
        self.raised = fault
        self._served = self.final
        self._pending = False

    def _lose_position(self) -> None:
        self.confirmed = Gear.UNKNOWN
        if self.state in UNDER_WAY:
            self._give_up(Fault.NONE)
        self._change(Event.POSITION_LOST)
        self._init_ns = None

    def _init(self, now_ns: int, observed: Observation) -> None:
        if self._init_ns is None:
            self._init_ns = now_ns
        if observed.gear != Gear.UNKNOWN and observed.run >= self._init_samples:
            self.confirmed = observed.gear
            self._change(Event.GEAR_FOUND)
        elif now_ns - self._init_ns >= nanoseconds(self._shift.init_timeout_s):
            self._change(Event.INIT_TIMEOUT)

    def _recover(self, observed: Observation) -> None:
        if (
            observed.recoverable
            and observed.requested is not None
            and observed.requested != self._served
        ):
            self._init_ns = None
            self._served = None  # the failed request is a new one if it comes back
            self._change(Event.RECOVERED)

    def _confirm_again(self, observed: Observation, gear: Gear) -> None:
        """Confirm a gear in whose window the stay has been long enough."""
        if observed.gear == gear and observed.run >= self._samples:
            self.confirmed = gear

    def _serve(self, now_ns: int, observed: Observation) -> bool:
        """Begin a shift if there is a new request; return whether one began."""
        final = observed.requested
        if final is None:
            return False
        if final == self.confirmed:
            self._served = final
        if final == self._served:
            return False
        self.final = final
        straight = final == Gear.NEUTRAL or self.confirmed == Gear.NEUTRAL
        self._start_leg(now_ns, observed, final if straight else Gear.NEUTRAL)
        return True

    def _start_leg(self, now_ns: int, observed: Observation, leg: Gear) -> None:
        self.leg = leg
        self.attempt = 0
        self._until_ns = now_ns + nanoseconds(self._shift.sync_wait_s)
        if self._held_back(now_ns, observed):
            self._pending = True
            self._change(Event.LEG_WAITS)
        else:
            self._push_now(now_ns, observed)

    def _held_back(self, now_ns: int, observed: Observation) -> bool:
        """Whether the push must wait: for the opposite chamber, or for the shaft speeds."""
        if self.leg == Gear.NEUTRAL:
            return False
        clear = observed.clear_b if self.leg == Gear.BACKWARD else observed.clear_f
        waits = self._shift.wait_for_sync and observed.synchronized is False
        return (waits and now_ns < self._until_ns) or not clear

    def _push_now(self, now_ns: int, observed: Observation) -> None:
        self.confirmed = Gear.UNKNOWN  # from here on the sensor reports the position late or never
        self._pending = False
        self._leg_ns = self.attempt_ns = now_ns
        settle_s = self._shift.reversal_settle_s if observed.gear == self.leg else 0.0
        self._earliest_ns = now_ns + nanoseconds(settle_s)
        self._change(Event.LEG_STARTED)

    def _follow_request(self, now_ns: int, observed: Observation) -> bool:
        """Act on a changed or lost request during a leg; return whether the leg was given up."""
        if self.leg == Gear.NEUTRAL:
            self.final = Gear.NEUTRAL if observed.requested is None else observed.requested
        elif observed.requested is not None and observed.requested != self.leg:
            self.final = observed.requested
            self._start_leg(now_ns, observed, Gear.NEUTRAL)
            return True
        return False

    def _push(self, now_ns: int, observed: Observation) -> None:
        if self._follow_request(now_ns, observed):
            return
        there = observed.gear == self.leg
        if there and observed.run >= self._samples and now_ns >= self._earliest_ns:
            self.confirmed = self.leg
            self._begin_blow(now_ns, observed)
        elif not (there or observed.moved) and now_ns - self._leg_ns >= nanoseconds(
            self._shift.no_motion_s
        ):
            self.fail(Fault.SENSOR_STUCK)
        elif now_ns - self.attempt_ns < nanoseconds(self._shift.push_timeout_s):
            if there is not (self.state is S.CONFIRM):
                self._change(Event.WINDOW_ENTERED if there else Event.WINDOW_LEFT)
        elif self.attempt < self._shift.retries:
            self.attempt += 1
            self._pending = True
            self._until_ns = now_ns + nanoseconds(self._shift.retry_pause_s)
            self._change(Event.RETRY)
        else:
            self.fail(Fault.SHIFT_TIMEOUT)

    def _begin_blow(self, now_ns: int, observed: Observation) -> None:
        configured_s = 0.0 if self._blow.cut == "confirmation" else self._blow.duration_s
        chosen_s = self._blow_s(configured_s, self.leg, self.final != self.leg)
        self._until_ns = now_ns + nanoseconds(min(max(chosen_s, 0.0), configured_s))
        if self._blow_over(now_ns, observed):
            self._after_blow(now_ns, observed)
        else:
            self._change(Event.CONFIRMED)

    def _blow_over(self, now_ns: int, observed: Observation) -> bool:
        if self._blow.cut == "sync" and self.final != self.leg and observed.synchronized:
            return True
        return now_ns >= self._until_ns

    def _after_blow(self, now_ns: int, observed: Observation) -> None:
        if self.final != self.leg:
            self._start_leg(now_ns, observed, self.final)
        else:
            self._served = self.final
            self._until_ns = now_ns + nanoseconds(self._shift.hold_s)
            self._change(Event.SHIFT_DONE)

    def _blowing(self, now_ns: int, observed: Observation) -> None:
        if self._follow_request(now_ns, observed):
            return
        self._confirm_again(observed, self.leg)
        over = self._blow_over(now_ns, observed)
        if (observed.gear != self.leg and observed.run >= self._samples) or (
            over and self.confirmed != self.leg
        ):
            self._change(Event.SLIPPED)  # the same push goes on
        elif over:
            self._after_blow(now_ns, observed)

    def _hold(self, now_ns: int, observed: Observation) -> None:
        if self._pending:
            self._wait_in_neutral(now_ns, observed)
            return
        self._confirm_again(observed, self.leg)
        if not self._serve(now_ns, observed) and now_ns >= self._until_ns:
            self._enter_vent(now_ns, Event.HOLD_OVER)

    def _enter_vent(self, now_ns: int, event: Event) -> None:
        self._until_ns = now_ns + nanoseconds(self._shift.vent_s)
        self._change(event)

    def _wait_in_neutral(self, now_ns: int, observed: Observation) -> None:
        """Hold before a push into gear, until nothing holds it back or the request changes."""
        self.final = Gear.NEUTRAL if observed.requested is None else observed.requested
        if self.confirmed != Gear.NEUTRAL:
            self._start_leg(now_ns, observed, Gear.NEUTRAL)
        elif self.final == Gear.NEUTRAL:
            self.leg = Gear.NEUTRAL
            self._served = Gear.NEUTRAL
            self._pending = False
            self._enter_vent(now_ns, Event.WAIT_CANCELLED)
        else:
            self.leg = self.final
            if not self._held_back(now_ns, observed):
                self._push_now(now_ns, observed)

    def _vent(self, now_ns: int, observed: Observation) -> None:
        if self._pending:  # between two attempts of a leg
            if not self._follow_request(now_ns, observed) and now_ns >= self._until_ns:
                self._pending = False
                self.attempt_ns = now_ns
                self._change(Event.PAUSE_OVER)
            return
        self._confirm_again(observed, self.leg)
        if not self._serve(now_ns, observed) and now_ns >= self._until_ns:
            self._change(Event.VENT_OVER)

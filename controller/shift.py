"""The shift state machine: request, push, confirm, safety blow, hold, vent, faults."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from can_dbc.messages import Fault, Gear, ShiftState
from controller.settings import ControlConfig, nanoseconds

BlowLength = Callable[[float, Gear, bool], float]

UNDER_WAY = frozenset(
    {ShiftState.PUSH, ShiftState.CONFIRM, ShiftState.BLOW, ShiftState.HOLD, ShiftState.VENT}
)
"""States of a shift in process, its after-treatment included."""


class View(NamedTuple):
    """What the machine sees in one step.

    `gear` is where the stay is believed to be and `run` for how many samples in a row; `moved`
    tells whether it has moved since this leg began. `wanted` is the driver's wish, None without a
    valid one. `synchronized` is None without valid speeds. `clear_b` and `clear_f` tell that the
    chamber *opposite* to backward and forward has been off long enough. `recoverable` tells that
    nothing stands in the way of leaving the fault state.
    """

    position_valid: bool
    gear: Gear
    run: int
    moved: bool
    wanted: Gear | None
    synchronized: bool | None
    clear_b: bool
    clear_f: bool
    recoverable: bool


class ShiftMachine:
    """Sequence of a gear shift, one transition per step at most.

    INIT (which gear is it?) - IDLE - PUSH - CONFIRM - BLOW - HOLD - VENT - IDLE. From gear to gear
    the way leads through neutral: after the blow into N the next PUSH follows at once. A request
    counts when it differs from both the confirmed gear and the last request that was served (or
    failed), so that a gear that drops out, or a failed shift, is not tried again by itself. A push
    ends the confirmation of the gear it leaves.

    A request that changes during a shift: on the way to neutral only what follows changes; a push
    into, or a blow on, a gear is given up and neutral pushed; in HOLD and VENT the new shift starts
    at once. A request that is lost: the leg under way is finished, none follows.
    A lost position ends a shift in FAULT; so does a push that fails. FAULT is left by a request
    that differs from the failed one, once the faults are gone.
    Checked by test_shift, test_shift_blow and test_shift_requests.
    """

    def __init__(self, config: ControlConfig, blow_s: BlowLength) -> None:
        shift = config.shift
        self._blow = config.blow
        self._blow_s = blow_s
        self._samples = config.windows.samples
        sensor_ns = nanoseconds(config.sensor.period_s)
        settle = -(-nanoseconds(shift.init_settle_s) // sensor_ns)  # rounded up
        self._init_samples = max(self._samples, settle)
        self._init_timeout_ns = nanoseconds(shift.init_timeout_s)
        self._push_timeout_ns = nanoseconds(shift.push_timeout_s)
        self._retries = shift.retries
        self._retry_pause_ns = nanoseconds(shift.retry_pause_s)
        self._no_motion_ns = nanoseconds(shift.no_motion_s)
        self._settle_ns = nanoseconds(shift.reversal_settle_s)
        self._hold_ns = nanoseconds(shift.hold_s)
        self._vent_ns = nanoseconds(shift.vent_s)
        self._wait_for_sync = shift.wait_for_sync
        self._sync_wait_ns = nanoseconds(shift.sync_wait_s)

        self.state = ShiftState.INIT
        self.confirmed = Gear.UNKNOWN
        self.leg = Gear.UNKNOWN  # pushed for, or about to be
        self.final = Gear.UNKNOWN  # where the shift is to end
        self.attempt = 0
        self.attempt_ns = 0
        self.new_leg = False
        self.new_attempt = False
        self.raised = Fault.NONE
        self.recovered = False
        self._served: Gear | None = None
        self._pending = False  # HOLD or VENT before a push, rather than after a shift
        self._leg_ns = 0
        self._earliest_ns = 0
        self._until_ns = 0
        self._init_ns: int | None = None

    @property
    def driving(self) -> bool:
        """Whether the strategy has the valves."""
        return self.state is ShiftState.PUSH or self.state is ShiftState.CONFIRM

    @property
    def in_process(self) -> bool:
        """Whether a wanted gear is still to be reached."""
        if self.state is ShiftState.BLOW:
            return self.final != self.leg
        return self.driving or self._pending

    def blow_remaining_ns(self, now_ns: int) -> int:
        """Return how long the blow still lasts, ns; 0 without one."""
        return self._until_ns - now_ns if self.state is ShiftState.BLOW else 0

    def step(self, now_ns: int, view: View) -> None:
        """Make at most one transition. The attributes tell what to do until the next step."""
        self.new_leg = self.new_attempt = self.recovered = False
        self.raised = Fault.NONE
        if not view.position_valid:
            self._lose_position()
            return
        if self.confirmed != view.gear:
            self.confirmed = Gear.UNKNOWN
        match self.state:
            case ShiftState.INIT:
                self._init(now_ns, view)
            case ShiftState.IDLE:
                self._idle(now_ns, view)
            case ShiftState.PUSH | ShiftState.CONFIRM:
                self._push(now_ns, view)
            case ShiftState.BLOW:
                self._blowing(now_ns, view)
            case ShiftState.HOLD:
                self._hold(now_ns, view)
            case ShiftState.VENT:
                self._vent(now_ns, view)
            case _:  # FAULT
                self._recover(view)

    def fail(self, fault: Fault) -> None:
        """Enter FAULT; the request that led here counts as served."""
        self.state = ShiftState.FAULT
        self.confirmed = Gear.UNKNOWN
        self.raised |= fault
        self._served = self.final
        self._pending = False

    def _lose_position(self) -> None:
        self.confirmed = Gear.UNKNOWN
        if self.state in UNDER_WAY:
            self.fail(Fault.NONE)
        elif self.state is not ShiftState.FAULT:
            self.state = ShiftState.INIT
            self._init_ns = None

    def _init(self, now_ns: int, view: View) -> None:
        if self._init_ns is None:
            self._init_ns = now_ns
        found = view.gear != Gear.UNKNOWN and view.run >= self._init_samples
        if found:
            self.confirmed = view.gear
        if found or now_ns - self._init_ns >= self._init_timeout_ns:
            self.state = ShiftState.IDLE

    def _recover(self, view: View) -> None:
        if view.recoverable and view.wanted is not None and view.wanted != self._served:
            self.state = ShiftState.INIT
            self._init_ns = None
            self.recovered = True

    def _idle(self, now_ns: int, view: View) -> None:
        self._see_again(view, view.gear)
        self._serve(now_ns, view)

    def _see_again(self, view: View, gear: Gear) -> None:
        """Confirm a gear that the stay has been seen in for long enough."""
        if view.gear == gear and view.run >= self._samples:
            self.confirmed = gear

    def _serve(self, now_ns: int, view: View) -> bool:
        """Begin a shift if there is a new wish; return whether one began."""
        if view.wanted is None:
            return False
        if view.wanted == self.confirmed:
            self._served = view.wanted
        if view.wanted == self._served:
            return False
        self._begin(now_ns, view, view.wanted)
        return True

    def _begin(self, now_ns: int, view: View, final: Gear) -> None:
        self.final = final
        straight = final == Gear.NEUTRAL or self.confirmed == Gear.NEUTRAL
        self._start_leg(now_ns, view, final if straight else Gear.NEUTRAL)

    def _start_leg(self, now_ns: int, view: View, leg: Gear) -> None:
        self.leg = leg
        self.attempt = 0
        self._until_ns = now_ns + self._sync_wait_ns
        if self._held_back(now_ns, view):
            self.state = ShiftState.HOLD
            self._pending = True
        else:
            self._push_now(now_ns, view)

    def _held_back(self, now_ns: int, view: View) -> bool:
        """Whether the push must wait: for the opposite chamber, or for the shaft speeds."""
        if self.leg == Gear.NEUTRAL:
            return False
        clear = view.clear_b if self.leg == Gear.BACKWARD else view.clear_f
        waits = self._wait_for_sync and view.synchronized is False and now_ns < self._until_ns
        return waits or not clear

    def _push_now(self, now_ns: int, view: View) -> None:
        self.state = ShiftState.PUSH
        self.confirmed = Gear.UNKNOWN  # from here on the sensor tells late, or never, where it is
        self._pending = False
        self._leg_ns = self.attempt_ns = now_ns
        self._earliest_ns = now_ns + self._settle_ns if view.gear == self.leg else now_ns
        self.new_leg = self.new_attempt = True

    def _follow_request(self, now_ns: int, view: View) -> bool:
        """Act on a changed or lost request during a leg; return whether the leg was given up."""
        if self.leg == Gear.NEUTRAL:
            self.final = Gear.NEUTRAL if view.wanted is None else view.wanted
        elif view.wanted is not None and view.wanted != self.leg:
            self.final = view.wanted
            self._start_leg(now_ns, view, Gear.NEUTRAL)
            return True
        return False

    def _push(self, now_ns: int, view: View) -> None:
        if self._follow_request(now_ns, view):
            return
        there = view.gear == self.leg
        if there and view.run >= self._samples and now_ns >= self._earliest_ns:
            self.confirmed = self.leg
            self._begin_blow(now_ns, view)
        elif not (there or view.moved) and now_ns - self._leg_ns >= self._no_motion_ns:
            self.fail(Fault.SENSOR_STUCK)
        elif now_ns - self.attempt_ns < self._push_timeout_ns:
            self.state = ShiftState.CONFIRM if there else ShiftState.PUSH
        elif self.attempt < self._retries:
            self.attempt += 1
            self.state = ShiftState.VENT
            self._pending = True
            self._until_ns = now_ns + self._retry_pause_ns
        else:
            self.fail(Fault.SHIFT_TIMEOUT)

    def _begin_blow(self, now_ns: int, view: View) -> None:
        configured_s = 0.0 if self._blow.cut == "confirmation" else self._blow.duration_s
        wished_s = self._blow_s(configured_s, self.leg, self.final != self.leg)
        self._until_ns = now_ns + nanoseconds(min(max(wished_s, 0.0), configured_s))
        if self._blow_over(now_ns, view):
            self._after_blow(now_ns, view)
        else:
            self.state = ShiftState.BLOW

    def _blow_over(self, now_ns: int, view: View) -> bool:
        if self._blow.cut == "sync" and self.final != self.leg and view.synchronized:
            return True
        return now_ns >= self._until_ns

    def _after_blow(self, now_ns: int, view: View) -> None:
        if self.confirmed != self.leg:
            self.state = ShiftState.PUSH  # it has slipped out: the same push goes on
        elif self.final != self.leg:
            self._start_leg(now_ns, view, self.final)
        else:
            self._served = self.final
            self.state = ShiftState.HOLD
            self._until_ns = now_ns + self._hold_ns

    def _blowing(self, now_ns: int, view: View) -> None:
        if self._follow_request(now_ns, view):
            return
        self._see_again(view, self.leg)
        if view.gear != self.leg and view.run >= self._samples:
            self.state = ShiftState.PUSH
        elif self._blow_over(now_ns, view):
            self._after_blow(now_ns, view)

    def _hold(self, now_ns: int, view: View) -> None:
        if self._pending:
            self._wait_in_neutral(now_ns, view)
            return
        self._see_again(view, self.leg)
        if not self._serve(now_ns, view) and now_ns >= self._until_ns:
            self._enter_vent(now_ns)

    def _enter_vent(self, now_ns: int) -> None:
        self.state = ShiftState.VENT
        self._until_ns = now_ns + self._vent_ns

    def _wait_in_neutral(self, now_ns: int, view: View) -> None:
        """Hold before a push into gear: leave when nothing holds it back, or the wish changes."""
        self.final = Gear.NEUTRAL if view.wanted is None else view.wanted
        if self.confirmed != Gear.NEUTRAL:
            self._start_leg(now_ns, view, Gear.NEUTRAL)
        elif self.final == Gear.NEUTRAL:
            self.leg = Gear.NEUTRAL
            self._served = Gear.NEUTRAL
            self._pending = False
            self._enter_vent(now_ns)
        else:
            self.leg = self.final
            if not self._held_back(now_ns, view):
                self._push_now(now_ns, view)

    def _vent(self, now_ns: int, view: View) -> None:
        if self._pending:
            self._pause(now_ns, view)
            return
        self._see_again(view, self.leg)
        if not self._serve(now_ns, view) and now_ns >= self._until_ns:
            self.state = ShiftState.IDLE

    def _pause(self, now_ns: int, view: View) -> None:
        """Vent between two attempts of a leg."""
        if self._follow_request(now_ns, view) or now_ns < self._until_ns:
            return
        self.state = ShiftState.PUSH
        self._pending = False
        self.attempt_ns = now_ns
        self.new_attempt = True

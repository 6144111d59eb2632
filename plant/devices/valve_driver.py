"""Output stage of the three valves: protected commands in, coil duties out."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Generic, TypeVar

import msgspec

from can_dbc import codec
from can_dbc.e2e import ACCEPTED, Receiver
from can_dbc.frame import Frame
from can_dbc.messages import Chamber, E2eState, Gear, SafetyBlow, ValveCommand
from plant.devices.valve import NEVER_NS, seconds_to_ns

Duties = tuple[float, float, float]

DE_ENERGISED: Duties = (0.0, 0.0, 0.0)
Input = TypeVar("Input", ValveCommand, SafetyBlow)


class ValveDriverConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How long the output stage holds the valves energised without a good frame.

    timeout_s: after this long without a good ValveCommand, or without a good SafetyBlow, every
    valve is de-energised; D_fall later it is closed.
    blow_limit_s: no blow lasts longer than this, whatever its frame says.
    blow_duty: duty of a blow. hold_duty: peak and hold; `peak_s` after a coil was energised its
    duty is at most this.
    """

    timeout_s: Annotated[float, msgspec.Meta(ge=0.001, le=1.0)] = 0.05
    blow_limit_s: Annotated[float, msgspec.Meta(ge=0.0, le=4.0)] = 0.5
    blow_duty: Annotated[float, msgspec.Meta(ge=0.0, le=1.0)] | None = None
    """Duty of a safety blow; if left out, that of the command that it follows, and the model's
    valve.duty_nominal where that did not energise the coil."""
    hold_duty: Annotated[float, msgspec.Meta(ge=0.0, le=1.0)] | None = None
    """Largest duty once the peak is over; if left out, the commanded duty stays."""
    peak_s: Annotated[float, msgspec.Meta(ge=0.0, le=1.0)] = 0.02
    """How long the commanded duty acts before hold_duty limits it."""


class _Channel(Generic[Input]):
    """A receiver whose last accepted message, and not only its counter, must be younger than the timeout."""

    def __init__(self, message_type: type[Input], timeout_ns: int) -> None:
        self.can_id = codec.can_id_of(message_type)
        self._timeout_ns = timeout_ns
        self.receiver: Receiver[Input] = Receiver(message_type, timeout_ns)

    @property
    def end_ns(self) -> int | None:
        """Instant [ns] at which the latest message is too old; None before the first."""
        if self.receiver.message is None:
            return None
        return self.receiver.message_ns + self._timeout_ns

    def receive(self, now_ns: int, frame: Frame) -> Input | None:
        """Return the message of a frame that passed every check, otherwise None."""
        accepted = self.receiver.receive(now_ns, frame) in ACCEPTED
        return self.receiver.message if accepted else None

    def message(self, now_ns: int) -> Input | None:
        """Return the message in force at `now_ns`; None while the channel is not valid."""
        end_ns = self.end_ns
        if end_ns is None or now_ns >= end_ns:
            return None
        return self.receiver.message if self.receiver.state(now_ns) is E2eState.VALID else None


class ValveDriver:
    """Receivers of ValveCommand and SafetyBlow, and the duties that they lead to.

    A coil gets the larger of its commanded duty and, while an active blow for its chamber has time left on the
    driver's own clock, the blow's: the one configured, else the one commanded when it began, else (below `duty_open`)
    `blow_duty`. A command from before the blow ends with it. While either channel is not valid every coil gets 0: a
    dead controller de-energises the valves exactly `timeout_s` after its last good frame. Only frames with right
    checksum and counter, within the contract, change a duty. A timer that ends at the very instant at which a frame
    arrives is overtaken by the frame.
    """

    def __init__(
        self, config: ValveDriverConfig, blow_duty: float, duty_open: float = 0.35
    ) -> None:
        """Start at time 0 with nothing received; the duties are 0..1."""
        self._configured_duty = config.blow_duty
        self._default_duty = blow_duty
        self._duty_open = duty_open
        self._blow_duty = blow_duty
        self._hold_duty = config.hold_duty
        self._peak_ns = seconds_to_ns(config.peak_s)
        self._hold_from_ns: list[int | None] = [None, None, None]
        timeout_ns = seconds_to_ns(config.timeout_s)
        self._commands = _Channel(ValveCommand, timeout_ns)
        self._blows = _Channel(SafetyBlow, timeout_ns)
        self._wanted_ids = (self._commands.can_id, self._blows.can_id)
        self._blow_limit_s = config.blow_limit_s
        self._blow_start_ns = -1  # first active frame of the latest blow
        self._blow_end_ns: int | None = None
        self._blown = Chamber.NONE
        self._now_ns = 0
        self._timer_ns = NEVER_NS
        self.duties = DE_ENERGISED
        self.target = Gear.UNKNOWN

    def advance(
        self, until_ns: int, deliveries: Sequence[tuple[int, Frame]]
    ) -> list[tuple[int, Duties]]:
        """Return the changes of the duties up to `until_ns` by `deliveries` (arrival in ns, frame), other messages ignored.

        Raises ValueError when an instant lies before the one reached.
        """
        changes: list[tuple[int, Duties]] = []
        for arrival_ns, frame in deliveries:
            if frame.can_id not in self._wanted_ids:
                continue
            if not self._now_ns <= arrival_ns <= until_ns:
                raise ValueError(f"frame of {arrival_ns} ns outside {self._now_ns}..{until_ns} ns")
            self._run_timers(arrival_ns, changes)
            self._receive(arrival_ns, frame)
            self._settle(arrival_ns, changes)
        if until_ns < self._now_ns:
            raise ValueError(f"cannot go back from {self._now_ns} ns to {until_ns} ns")
        self._run_timers(until_ns + 1, changes)
        self._now_ns = until_ns
        return changes

    def _receive(self, now_ns: int, frame: Frame) -> None:
        if frame.can_id == self._commands.can_id:
            self._commands.receive(now_ns, frame)
            return
        blow = self._blows.receive(now_ns, frame)
        if blow is None:
            return
        lasts_s = min(blow.remaining_s, self._blow_limit_s) if blow.active else 0.0
        if lasts_s <= 0.0 or blow.chamber is Chamber.NONE:
            self._blow_end_ns = None
            return
        if self._blow_end_ns is None or blow.chamber is not self._blown:
            self._blow_start_ns, self._blown = now_ns, blow.chamber
            self._blow_duty = self._duty_of_blow(now_ns, blow.chamber)
        self._blow_end_ns = now_ns + seconds_to_ns(lasts_s)

    def _duty_of_blow(self, now_ns: int, chamber: Chamber) -> float:
        if self._configured_duty is not None:
            return self._configured_duty
        command = self._commands.message(now_ns)
        if command is None:
            return self._default_duty
        duty = (command.duty_b, command.duty_n, command.duty_f)[chamber]
        return duty if duty >= self._duty_open else self._default_duty

    def _run_timers(self, before_ns: int, changes: list[tuple[int, Duties]]) -> None:
        """Let every timer act that ends before `before_ns`, in order."""
        while self._timer_ns < before_ns:
            self._settle(self._timer_ns, changes)

    def _next_timer_ns(self) -> int:
        """Return the first instant after now at which a timer ends."""
        now_ns, first_ns = self._now_ns, NEVER_NS
        ends = (self._commands.end_ns, self._blows.end_ns, self._blow_end_ns, *self._hold_from_ns)
        for end_ns in ends:
            if end_ns is not None and now_ns < end_ns < first_ns:
                first_ns = end_ns
        return first_ns

    def _settle(self, now_ns: int, changes: list[tuple[int, Duties]]) -> None:
        """Bring duties and target up to date at `now_ns`."""
        self._now_ns = now_ns
        if self._blow_end_ns is not None and now_ns >= self._blow_end_ns:
            self._blow_end_ns = None
        duties = self._wanted(now_ns)
        if self._hold_duty is not None:
            duties = self._after_peak(now_ns, duties, self._hold_duty)
        if duties != self.duties:
            self.duties = duties
            changes.append((now_ns, duties))
        self._timer_ns = self._next_timer_ns()

    def _wanted(self, now_ns: int) -> Duties:
        command, blow = self._commands.message(now_ns), self._blows.message(now_ns)
        if command is None or blow is None:
            self.target = Gear.UNKNOWN
            return DE_ENERGISED
        self.target = command.target
        duties = [command.duty_b, command.duty_n, command.duty_f]
        if self._blow_end_ns is not None:
            duties[self._blown] = max(duties[self._blown], self._blow_duty)
        elif self._commands.receiver.message_ns < self._blow_start_ns:
            duties[self._blown] = 0.0
        return (duties[0], duties[1], duties[2])

    def _after_peak(self, now_ns: int, duties: Duties, hold_duty: float) -> Duties:
        """Limit the duty of each coil that has been energised for the time of the peak."""
        limited = list(duties)
        for chamber, duty in enumerate(duties):
            hold_from_ns = self._hold_from_ns[chamber]
            if duty <= hold_duty:
                self._hold_from_ns[chamber] = None
            elif hold_from_ns is None:
                self._hold_from_ns[chamber] = now_ns + self._peak_ns
            elif now_ns >= hold_from_ns:
                limited[chamber] = hold_duty
        return (limited[0], limited[1], limited[2])

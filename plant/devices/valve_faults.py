"""The valves of the chambers B, N and F, and their faults: of the coil and its line, and of the plunger."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Annotated, Literal

from msgspec import Meta

from plant.devices.coil import CoilValve
from plant.devices.sensors import named_generator
from plant.devices.signal_faults import FaultWindow
from plant.devices.valve import NEVER_NS, Valve, seconds_to_ns
from plant.devices.valve_driver import Duties
from plant.errors import InputError

Command = tuple[int, float]  # instant in ns, duty 0..1


class ValveFault(FaultWindow, frozen=True, kw_only=True):
    """A failure of one valve from start_s on and before end_s (left out: for good).

    off: the coil gets no current. wrong: it gets full current, whatever is commanded (short to
    supply). garbage: its duty is drawn anew every 10 ms, uniform in 0..1. intermittent: its contact
    is open with `probability`, drawn anew every 10 ms. delayed: commands reach it delay_s late.
    stuck: the plunger does not move. slow: it takes `factor` times as long to open and close.
    """

    valve: Literal["B", "N", "F"]
    """Valve that fails."""
    kind: Literal["off", "stuck", "garbage", "wrong", "slow", "delayed", "intermittent"]
    factor: Annotated[float, Meta(ge=1.0, le=100.0)] = 3.0
    """How many times longer a slow valve takes."""
    delay_s: Annotated[float, Meta(gt=0.0, le=1.0)] = 0.02
    """Delay of the commands."""
    probability: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.5
    """Probability that the contact is open."""


class FaultyValve:
    """One valve behind its faults, in their order: takes the driver's duties and returns those at the coil.

    A command is taken before a fault of its instant. Raises InputError for a fault that ends before it starts, or two
    of a kind at once.
    """

    def __init__(
        self, valve: Valve, faults: Sequence[ValveFault], seed: int, duty: float = 0.0
    ) -> None:
        """`duty` (0..1): what the driver has commanded since long ago."""
        self.valve = valve
        self._commanded = duty
        self._timing = valve.timing
        self._faults = [_Window(fault, seed, i) for i, fault in enumerate(faults)]
        for i, one in enumerate(self._faults):
            for other in self._faults[:i]:
                if (
                    one.fault.kind == other.fault.kind
                    and one.start_ns < other.end_ns
                    and other.start_ns < one.end_ns
                ):
                    raise InputError(
                        f"valve_fault: {one.fault.kind} twice at one time on valve "
                        f"{one.fault.valve}; expected one after the other"
                    )
        for fault in faults:
            self._timing.slowed(fault.factor)  # refuse now what could not be taken later
        self._done_ns = -1
        self._coming: list[Command] = []
        self._late: list[Command] = []

    def hand_over(self, t_ns: int, duty: float) -> None:
        """Take a duty that the driver commands from `t_ns` on; instants must not decrease."""
        self._coming.append((t_ns, duty))

    def until(self, until_ns: int) -> Iterator[Command]:
        """Yield the changes of the duty at the coil up to `until_ns`; the valve takes each before the next is asked for."""
        while True:
            instants = [command[0] for command in self._coming[:1] + self._late[:1]]
            instants += [window.next_ns(self._done_ns) for window in self._faults]
            instant = min(instants)
            if instant > until_ns:
                break
            while self._coming and self._coming[0][0] <= instant:
                _, self._commanded = self._coming.pop(0)
            yield from self._act(instant)
            self._done_ns = instant
        self._done_ns = until_ns

    def _act(self, now_ns: int) -> Iterator[Command]:
        duty = self._commanded
        stuck = False
        factor = 1.0
        for window in self._faults:
            if not window.fault.holds(now_ns):
                if window.delayed_duty is not None:  # what was still on its way is overtaken
                    window.delayed_duty = None
                    self._late.clear()
                continue
            match window.fault.kind:
                case "off":
                    duty = 0.0
                case "wrong":
                    duty = 1.0
                case "garbage":
                    duty = window.drawn(now_ns)
                case "intermittent":
                    duty = 0.0 if window.drawn(now_ns) < window.fault.probability else duty
                case "delayed":
                    duty = self._delayed(now_ns, duty, window)
                case "stuck":
                    stuck = True
                case "slow":
                    factor = window.fault.factor
        self.valve.timing = self._timing if factor == 1.0 else self._timing.slowed(factor)
        if stuck:
            self.valve.block(now_ns)
        yield now_ns, duty
        if not stuck:
            self.valve.free(now_ns)

    def _delayed(self, now_ns: int, duty: float, window: _Window) -> float:
        """Return the duty of `delay_s` ago; until then the one at the fault's start."""
        if window.delayed_duty is None:
            window.delayed_duty = self.valve.duty
        if (self._late[-1][1] if self._late else window.delayed_duty) != duty:
            self._late.append((now_ns + seconds_to_ns(window.fault.delay_s), duty))
        while self._late and self._late[0][0] <= now_ns:
            window.delayed_duty = self._late.pop(0)[1]
        return window.delayed_duty


class _Window:
    """One fault with its times and its draws."""

    slot_ns = 10_000_000  # period of the draws of garbage and intermittent faults

    def __init__(self, fault: ValveFault, seed: int, index: int) -> None:
        self.fault = fault
        self.start_ns = seconds_to_ns(fault.start_s)
        self.end_ns = NEVER_NS if fault.end_s is None else seconds_to_ns(fault.end_s)
        if self.end_ns <= self.start_ns:
            raise InputError(
                f"valve_fault: {fault.kind} on valve {fault.valve} ends at {fault.end_s} s; "
                f"expected after its start, {fault.start_s} s"
            )
        self.delayed_duty: float | None = None
        self._generator = named_generator(seed, "valve", fault.valve, index)
        self._draws = fault.kind in ("garbage", "intermittent")
        self._slot = -1
        self._value = 0.0

    def next_ns(self, after_ns: int) -> int:
        """Return the first instant later than `after_ns` at which this fault changes something."""
        if after_ns < self.start_ns:
            return self.start_ns
        if after_ns >= self.end_ns:
            return NEVER_NS
        if not self._draws:
            return self.end_ns
        slots = (after_ns - self.start_ns) // self.slot_ns + 1
        return min(self.end_ns, self.start_ns + slots * self.slot_ns)

    def drawn(self, now_ns: int) -> float:
        """Return the number of the present slot, uniform in 0..1."""
        slot = (now_ns - self.start_ns) // self.slot_ns
        while self._slot < slot:
            self._slot += 1
            self._value = float(self._generator.random())
        return self._value


Switch = tuple[int, int, float]  # instant in ns, chamber, 1 on or open, 0 off or closed


class ValveGroup:
    """Valves, those with faults behind them; chambers are numbered in the order of the names."""

    def __init__(
        self, valves: Sequence[Valve], names: Sequence[str], faults: Sequence[ValveFault], seed: int
    ) -> None:
        """Combine valves and their faults. Raises InputError for faults that `FaultyValve` refuses."""
        self.valves = tuple(valves)
        self._faulty = {
            number: FaultyValve(valve, faults_of_valve, seed)
            for number, (valve, name) in enumerate(zip(valves, names, strict=True))
            if (faults_of_valve := [fault for fault in faults if fault.valve == name])
        }

    def drive(
        self, until_ns: int, commands: Sequence[tuple[int, Duties]]
    ) -> tuple[list[Switch], list[Switch]]:
        """Apply the driver's duties; return the switches of the coils and the plungers' moves, by time, then chamber."""
        coils: list[Switch] = []
        for instant, duties in commands:
            for chamber, duty in enumerate(duties):
                if chamber in self._faulty:
                    self._faulty[chamber].hand_over(instant, duty)
                else:
                    self._command(instant, chamber, duty, coils)
        for chamber, faulty in self._faulty.items():
            for instant, duty in faulty.until(until_ns):
                self._command(instant, chamber, duty, coils)
        moves = [
            (instant, chamber, u)
            for chamber, valve in enumerate(self.valves)
            for instant, u in valve.moves(until_ns)
        ]
        if len(moves) > 1:
            moves.sort()
        return coils, moves

    def currents(self) -> Iterator[tuple[int, int, float]]:
        """Yield (instant in ns, chamber, current in A) since the last call, each chamber's in order."""
        for chamber, valve in enumerate(self.valves):
            if isinstance(valve, CoilValve):
                yield from ((at, chamber, amps) for at, amps in valve.currents)
                valve.currents.clear()

    def _command(self, now_ns: int, chamber: int, duty: float, coils: list[Switch]) -> None:
        valve = self.valves[chamber]
        before = valve.is_energised
        valve.command(now_ns, duty)
        if valve.is_energised != before:
            coils.append((now_ns, chamber, float(valve.is_energised)))

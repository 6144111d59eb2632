"""On/off solenoid valves as time delays (thesis 3.1.3)."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from math import exp, log
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from can_dbc.instants import NS_PER_S
from plant.errors import InputError
from plant.parameters import ParameterSet
from plant.parameters.bounds import outside

NEVER_NS = 1 << 63

Drive = Literal["delays", "coil"]


def seconds_to_ns(seconds: float) -> int:
    """Return the whole nanoseconds nearest to a time in seconds. Raises InputError beyond 1e9 s, thirty years."""
    if abs(seconds) > 1e9:
        raise InputError(f"a time of {seconds:g} s; expected at most 1e+09 s")
    return round(seconds * NS_PER_S)


class SupplyDip(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A time in which the supply of all coils is lower (or higher).

    Raises ValueError unless it ends after its start.
    """

    start_s: Annotated[float, Meta(ge=0.0, le=86400.0)]
    """Time from which the supply is `supply_v`."""
    end_s: Annotated[float, Meta(ge=0.0, le=86400.0)]
    """Time at which it is again that of the coil."""
    supply_v: Annotated[float, Meta(ge=0.0, le=100.0)]
    """Voltage meanwhile."""

    def __post_init__(self) -> None:
        if self.end_s <= self.start_s:
            raise ValueError(f"end_s: {self.end_s:g}; expected after its start, {self.start_s:g} s")


class CoilConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The coil's supply, its driver, and its temperature.

    Source: inferred. The magnetic circuit, spring and plunger are chosen so that a duty of 98 %
    opens after 8 ms and closes 35 ms after it ends, 33 % does not open and 35 % does (3.1.3).
    """

    supply_v: Annotated[float, Meta(ge=1.0, le=100.0)] = 24.0
    """Voltage that the driver switches."""
    temperature_k: Annotated[float, Meta(ge=200.0, le=450.0)] = 293.15
    """Temperature of the windings; their resistance grows with it."""
    resistance_ohm: Annotated[float, Meta(ge=0.1, le=1000.0)] = 24.0
    """Resistance of the windings at 20 degrees Celsius."""
    decay_v: Annotated[float, Meta(ge=0.0, le=200.0)] = 1.8
    """Voltage against the current while the driver is off: a freewheel diode with its leads; some
    40 V with a zener diode."""
    carrier_hz: Annotated[float, Meta(ge=50.0, le=20_000.0)] = 1000.0
    """Frequency of the pulse width modulation."""
    carrier_phase: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.0
    """Part of a carrier period that has passed at time 0."""
    dip: list[SupplyDip] = []
    """Times in which the supply has another voltage, as while the engine is cranked."""


@dataclass(frozen=True)
class ValveTiming:
    """Thresholds and delays of a solenoid valve.

    The coil is energised from `duty_open` on, not up to `duty_closed`; between the two its state stays. The plunger
    follows `rise_ns` after the coil is energised and `fall_delay_ns` after it is not. With `closing_follows_duty` the
    coil current, by that of a duty of 1, follows the duty with the time constant `fall_tau_s`; the less there is, the
    sooner a valve closes. Raises InputError naming the parameter that is out of range. Source: thesis 3.1.3 (8 ms, 35
    ms, 33 %, 35 %); the closing that follows the duty is inferred from its remark on the freewheel diode.
    """

    rise_ns: int
    fall_ns: int
    duty_closed: float
    duty_open: float
    closing_follows_duty: bool = False
    fall_base_s: float = 0.0
    fall_tau_s: float = 0.0

    def __post_init__(self) -> None:
        delays_s = {
            "D_rise": self.rise_ns / NS_PER_S,
            "D_fall": self.fall_ns / NS_PER_S,
            "fall_base": self.fall_base_s,
            "fall_tau": self.fall_tau_s,
        }
        for name, delay_s in delays_s.items():
            if wrong := outside(f"valve.{name}", "s", (delay_s,)):
                raise InputError(f"valve.{name}: {wrong}")
        if not 0.0 <= self.duty_closed < self.duty_open <= 1.0:
            raise InputError(
                f"valve.duty_closed, valve.duty_open: {self.duty_closed:g}, {self.duty_open:g}; "
                "expected 0 <= duty_closed < duty_open <= 1"
            )

    @classmethod
    def from_parameters(
        cls, parameters: ParameterSet, closing_follows_duty: bool = False
    ) -> ValveTiming:
        """Return the timing from the section `valve` of a parameter set."""
        value = parameters.value
        return cls(
            rise_ns=seconds_to_ns(value("valve.D_rise")),
            fall_ns=seconds_to_ns(value("valve.D_fall")),
            duty_closed=value("valve.duty_closed"),
            duty_open=value("valve.duty_open"),
            closing_follows_duty=closing_follows_duty,
            fall_base_s=value("valve.fall_base"),
            fall_tau_s=value("valve.fall_tau"),
        )

    def slowed(self, factor: float) -> ValveTiming:
        """Return the valve with every delay times `factor`. Raises InputError for one that no plunger could have."""
        return replace(
            self,
            rise_ns=round(self.rise_ns * factor),
            fall_ns=round(self.fall_ns * factor),
            fall_base_s=self.fall_base_s * factor,
            fall_tau_s=self.fall_tau_s * factor,
        )

    def is_energised(self, duty: float, before: bool) -> bool:
        """Return whether a coil at `duty` is energised, by whether it was before. Raises ValueError outside 0..1."""
        if not 0.0 <= duty <= 1.0:
            raise ValueError(f"duty {duty!r} is not within 0..1")
        if duty >= self.duty_open:
            return True
        if duty <= self.duty_closed:
            return False
        return before

    def fall_delay_ns(self, current: float) -> int:
        """Return the closing delay [ns] of a coil with a current, by that of a duty of 1.

        With `closing_follows_duty` D_fall = fall_base + fall_tau ln(i / i_hold): decay through the freewheel diode to
        halfway between the thresholds.
        """
        if not self.closing_follows_duty:
            return self.fall_ns
        hold = 0.5 * (self.duty_closed + self.duty_open)
        decay_s = self.fall_tau_s * log(current / hold) if current > hold else 0.0
        return seconds_to_ns(self.fall_base_s + decay_s)

    def current(self, before: float, duty: float, time_ns: int) -> float:
        """Return the current after a time at a duty: i = d + (i_before - d) exp(-t / fall_tau).

        That of a duty of 1 is 1. Without `closing_follows_duty` it is the duty.
        """
        if not self.closing_follows_duty or self.fall_tau_s <= 0.0 or before == duty:
            return duty
        return duty + (before - duty) * exp(-time_ns / (self.fall_tau_s * NS_PER_S))


class Valve:
    """One 3/2 valve: open connects its chamber to supply, closed to atmosphere.

    A command reversed before the plunger moved leaves no trace; a move due at the very instant of a command happens
    first.
    """

    def __init__(self, timing: ValveTiming, is_open: bool = False, duty: float = 0.0) -> None:
        """Start at rest with the coil at `duty` since long ago. Raises ValueError when it contradicts `is_open`."""
        if timing.is_energised(duty, is_open) != is_open:
            raise ValueError(f"a valve at rest under duty {duty} cannot be open={is_open}")
        self.timing = timing
        self.is_open = is_open
        self.is_energised = is_open
        self.duty = duty
        self._current = duty
        self._command_ns: int | None = None
        # set exactly while is_energised != is_open, unless the plunger is blocked
        self._move_ns: int | None = None
        self._blocked = False
        self._moved: list[tuple[int, float]] = []

    def command(self, t_ns: int, duty: float) -> None:
        """Apply `duty` (0..1) from `t_ns` on. Raises ValueError for an instant before that of the last command."""
        if self._command_ns is not None and t_ns < self._command_ns:
            raise ValueError(f"command at {t_ns} ns after one at {self._command_ns} ns")
        self._settle(t_ns)
        self._current = self._current_at(t_ns)
        self._command_ns = t_ns
        energised = self.timing.is_energised(duty, self.is_energised)
        if energised != self.is_energised:
            self.is_energised = energised
            if self._move_ns is not None:
                self._move_ns = None
            elif not self._blocked:
                self._follow(t_ns)
        self.duty = duty

    def block(self, t_ns: int) -> None:
        """Hold the plunger where it is at `t_ns`, whatever the coil does, until `free`."""
        self._settle(t_ns)
        self._blocked = True
        self._move_ns = None

    def free(self, t_ns: int) -> None:
        """Let a blocked plunger follow its coil again from `t_ns` on."""
        if self._blocked:
            self._blocked = False
            if self.is_energised != self.is_open:
                self._follow(t_ns)

    def _follow(self, t_ns: int) -> None:
        """Move after the delay from the coil's change."""
        if self.is_energised:
            self._move_ns = t_ns + self.timing.rise_ns
        else:
            self._move_ns = t_ns + self.timing.fall_delay_ns(self._current_at(t_ns))

    def _current_at(self, t_ns: int) -> float:
        """Return the current of the coil; before the first command it has settled."""
        if self._command_ns is None:
            return self._current
        return self.timing.current(self._current, self.duty, t_ns - self._command_ns)

    def moves(self, until_ns: int) -> list[tuple[int, float]]:
        """Return the moves (ns, u = 1 open or 0 closed) up to `until_ns`, once each, when all commands until then are given."""
        self._settle(until_ns)
        moved = self._moved.copy()
        self._moved.clear()
        return moved

    def _settle(self, until_ns: int) -> None:
        if self._move_ns is not None and self._move_ns <= until_ns:
            self.is_open = self.is_energised
            self._moved.append((self._move_ns, 1.0 if self.is_open else 0.0))
            self._move_ns = None


def switch_schedule(
    commands: Iterable[tuple[float, int, float]],
    timing: ValveTiming,
    valves: int,
    charged: Sequence[int] = (),
    charged_duty: float = 0.98,
) -> list[tuple[int, int, float]]:
    """Return the switches (ns, chamber, u), ascending, of a list of commands (s, chamber, duty) to `valves` chambers.

    Those in `charged` start open under `charged_duty`. Raises ValueError for a chamber that does not exist.
    """
    bank = [
        Valve(timing, is_open=i in charged, duty=charged_duty if i in charged else 0.0)
        for i in range(valves)
    ]
    last_ns = 0
    for time_s, chamber, duty in sorted(commands, key=lambda command: command[0]):
        if not 0 <= chamber < valves:
            raise ValueError(f"no valve {chamber}: there are {valves}")
        last_ns = seconds_to_ns(time_s)
        bank[chamber].command(last_ns, duty)
    longest = max(timing.rise_ns, timing.fall_ns, timing.fall_delay_ns(1.0))
    end_ns = last_ns + longest
    return sorted(
        (t_ns, chamber, u) for chamber, valve in enumerate(bank) for t_ns, u in valve.moves(end_ns)
    )

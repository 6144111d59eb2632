"""A toy of the actuator, just true enough to exercise the firmware; no part of the project's plant."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from typing import Any

from can_dbc.messages import (
    Chamber,
    DrivelineSpeeds,
    E2eState,
    Fault,
    Gear,
    PositionPulse,
    ShiftRequest,
    ShiftState,
)
from controller.config import FirmwareConfig
from controller.firmware import Firmware, Inputs, Outputs

MS = 1_000_000
STROKE_M = 0.01285
GRID_NS = 250_000
T_K = 293.15

N, B, F, U = Gear.NEUTRAL, Gear.BACKWARD, Gear.FORWARD, Gear.UNKNOWN
S = ShiftState
AT = {N: 0.0, B: STROKE_M, F: -STROKE_M}


@dataclass
class Row:
    """One firmware step: when, what it answered, and what was true."""

    time_ns: int
    out: Outputs
    position_m: float

    @property
    def state(self) -> ShiftState:
        return self.out.status.state


@dataclass
class Stay:
    """Pressures 0..1 follow the valves, the stay follows the pressures."""

    position_m: float = 0.0
    velocity_m_s: float = 0.0
    pressures: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    commanded: list[bool] = field(default_factory=lambda: [False] * 3)
    is_open: list[bool] = field(default_factory=lambda: [False] * 3)
    due_ns: list[int] = field(default_factory=lambda: [0, 0, 0])
    block_m: float | None = None
    frozen: bool = False

    def command(self, now_ns: int, energised: list[bool]) -> None:
        for i, on in enumerate(energised):
            if on != self.commanded[i]:
                self.commanded[i] = on
                self.due_ns[i] = now_ns + (8 * MS if on else 35 * MS)

    def advance(self, now_ns: int) -> None:
        step_s = GRID_NS * 1e-9
        for i in range(3):
            if now_ns >= self.due_ns[i]:
                self.is_open[i] = self.commanded[i]
            goal, tau_s = (1.0, 0.03) if self.is_open[i] else (0.0, 0.04)
            self.pressures[i] += (goal - self.pressures[i]) * step_s / tau_s
        p_b, p_n, p_f = self.pressures
        side = (self.position_m > 0) - (self.position_m < 0)
        force = p_b - p_f - p_n * side
        if side == 0:
            force = max(p_b - 0.9 * p_n, 0.0) - max(p_f - 0.9 * p_n, 0.0)
        if self.frozen or (abs(force) < 0.3 and self.velocity_m_s == 0.0):
            self.velocity_m_s = 0.0
            return
        self.velocity_m_s += 200.0 * force * step_s
        was = self.position_m
        self.position_m += self.velocity_m_s * step_s
        low, high = -STROKE_M, STROKE_M
        if self.block_m is not None and abs(was) <= self.block_m:
            low, high = -self.block_m, self.block_m
        if was * self.position_m < 0 and p_n > 0.3:
            low = high = 0.0
        if not low <= self.position_m <= high:
            self.position_m = min(max(self.position_m, low), high)
            self.velocity_m_s = 0.0


@dataclass
class Rig:
    """Firmware and toy in a loop; every hook may be replaced by a test."""

    config: FirmwareConfig = field(default_factory=FirmwareConfig)
    stay: Stay = field(default_factory=Stay)
    sensor_phase_ns: int = 5 * MS
    request: Callable[[int], ShiftRequest | None] = lambda now_ns: None
    speeds: Callable[[int], DrivelineSpeeds | None] = lambda now_ns: None
    pulse: Callable[[int, PositionPulse], PositionPulse | None] = lambda now_ns, pulse: pulse
    position_state: Callable[[int], E2eState] = lambda now_ns: E2eState.VALID

    def __post_init__(self) -> None:
        self.firmware = Firmware(self.config)
        self.rows: list[Row] = []
        self._pulses: list[PositionPulse] = []
        self._now_ns = 0
        self._next_tick_ns = 0
        self._command_at: list[tuple[int, list[bool]]] = []
        self._sensor_ns = round(self.config.sensor.period_s * 1e9)

    def run(self, until_ms: float) -> Rig:
        while self._now_ns < until_ms * MS:
            if self._now_ns == self._next_tick_ns:
                self._tick()
            if self._command_at and self._command_at[0][0] <= self._now_ns:
                self.stay.command(*self._command_at.pop(0))
            self.stay.advance(self._now_ns)
            self._now_ns += GRID_NS
            sampled_ns = self._now_ns - 500_000 - self.sensor_phase_ns
            if sampled_ns >= 0 and sampled_ns % self._sensor_ns == 0:
                self._sample(sampled_ns // self._sensor_ns)
        return self

    def _sample(self, number: int) -> None:
        pulse = PositionPulse(pulse_s(self.stay.position_m), 293.15, number % 256)
        changed = self.pulse(self._now_ns, pulse)
        if changed is not None:
            self._pulses.append(changed)

    def _tick(self) -> None:
        now_ns = self._now_ns
        request, speeds = self.request(now_ns), self.speeds(now_ns)
        out = self.firmware.step(
            now_ns,
            Inputs(
                pulses=tuple(self._pulses),
                request=request,
                speeds=speeds,
                position_state=self.position_state(now_ns),
                request_state=E2eState.VALID if request else E2eState.INVALID,
                speeds_state=E2eState.VALID if speeds else E2eState.INVALID,
            ),
        )
        self._pulses.clear()
        self.rows.append(Row(now_ns, out, self.stay.position_m))
        valves = out.valves
        energised = [
            duty >= 0.35 or (out.blow.active and out.blow.chamber is chamber)
            for chamber, duty in zip(
                Chamber, (valves.duty_b, valves.duty_n, valves.duty_f), strict=False
            )
        ]
        self._command_at.append((now_ns + 500_000, energised))
        self._next_tick_ns += self.config.period_ns

    @property
    def last(self) -> Outputs:
        return self.rows[-1].out

    def states(self) -> list[str]:
        """The states in the order in which they were entered."""
        return [state.name for state, _ in groupby(row.state for row in self.rows)]

    def when(self, state: ShiftState, nth: int = 0) -> int:
        """Time at which a state was entered for the n-th time, ns."""
        entered = [
            row.time_ns
            for before, row in zip([None, *self.rows], self.rows, strict=False)
            if row.state is state and (before is None or before.state is not state)
        ]
        return entered[nth]

    def spent_ms(self, state: ShiftState) -> float:
        """Time of all steps in a state."""
        return sum(row.state is state for row in self.rows) * self.config.period_s * 1e3

    def faults(self) -> Fault:
        """All faults that were ever reported."""
        seen = Fault.NONE
        for row in self.rows:
            seen |= row.out.status.faults
        return seen


def pulse_s(position_m: float, temperature_k: float = 293.15, tick_s: float = 1e-6) -> float:
    """The pulse of the nominal sensor, counted in timer ticks."""
    warmth = 1.0 + 0.0012 * (temperature_k - 293.15)
    return round((0.0009 + 0.022 * position_m) * warmth / tick_s) * tick_s


def asks(*requests: tuple[float, Gear]) -> Callable[[int], ShiftRequest]:
    """A driver: from each time (ms) on, that gear."""

    def request(now_ns: int) -> ShiftRequest:
        gear = requests[0][1]
        for at_ms, asked_gear in requests:
            if now_ns >= at_ms * MS:
                gear = asked_gear
        return ShiftRequest(gear)

    return request


def shift(start: Gear, *requests: tuple[float, Gear], **more: Any) -> Rig:
    """A rig that stands in a gear, is asked for it, and later for what is given (ms, gear)."""
    return Rig(
        stay=more.pop("stay", Stay(position_m=AT[start])),
        request=asks((0.0, start), *requests),
        **more,
    )


def exact(position_m: float, index: int, temperature_k: float = T_K) -> PositionPulse:
    """An ideal pulse, not rounded to ticks."""
    warmth = 1.0 + 0.0012 * (temperature_k - T_K)
    return PositionPulse((0.0009 + 0.022 * position_m) * warmth, temperature_k, index % 256)


def duties(out: Outputs) -> tuple[float, float, float]:
    return out.valves.duty_b, out.valves.duty_n, out.valves.duty_f


def energised(out: Outputs) -> set[Chamber]:
    """Chambers that the valve driver keeps energised on these outputs."""
    chambers = (Chamber.B, Chamber.N, Chamber.F)
    on = {chamber for chamber, duty in zip(chambers, duties(out), strict=True) if duty > 0.33}
    if out.blow.active and out.blow.remaining_s > 0.0:
        on.add(out.blow.chamber)
    return on


def check_invariants(rows: Sequence[Row], config: FirmwareConfig | None = None) -> None:
    """Raise AssertionError at the first step that breaks a promise of the firmware."""
    config = config or FirmwareConfig()
    windows = config.windows
    engaged_m = windows.stroke_m - windows.gear_tolerance_m
    last_on_ns: dict[Chamber, int] = {}
    before: Outputs | None = None
    for row in rows:
        out, status = row.out, row.out.status
        state, confirmed = status.state, status.confirmed
        on = energised(out)

        # one chamber, and never backward and forward together or in quick succession
        assert len(on) <= 1
        for chamber, other in ((Chamber.B, Chamber.F), (Chamber.F, Chamber.B)):
            if chamber in on and other in last_on_ns:
                off_ns = row.time_ns - last_on_ns[other] - config.period_ns
                assert off_ns >= config.shift.interlock_s * 1e9
        last_on_ns.update(dict.fromkeys(on, row.time_ns))

        # valves only in the states that have them; a fault has none
        assert all(duty in (0.0, config.duty) for duty in duties(out))
        assert bool(on) == (state in (ShiftState.PUSH, ShiftState.CONFIRM, ShiftState.BLOW))
        assert out.blow.active == (state is ShiftState.BLOW)
        assert out.blow.active == (out.blow.chamber is not Chamber.NONE)
        if out.blow.active:
            # the command holds a coil until the blow has taken over: in the blow's first step only
            from_command = before is not None and not before.blow.active
            was_on = duties(before) if before is not None and from_command else (0.0, 0.0, 0.0)
            expected = [0.0, 0.0, 0.0]
            expected[out.blow.chamber] = was_on[out.blow.chamber]
            assert list(duties(out)) == expected
            assert 0.0 < out.blow.remaining_s <= config.blow.duration_s
        else:
            assert out.blow.remaining_s == 0.0
        before = out
        if state is ShiftState.FAULT:
            assert confirmed is Gear.UNKNOWN
            assert status.faults & ~(Fault.REQUEST_LOST | Fault.SPEEDS_LOST)

        # a gear is confirmed only while the estimate is there, and never during a push
        if state in (ShiftState.PUSH, ShiftState.CONFIRM, ShiftState.INIT):
            assert confirmed is Gear.UNKNOWN
        if status.faults & (Fault.POSITION_LOST | Fault.POSITION_IMPLAUSIBLE | Fault.SENSOR_STUCK):
            assert confirmed is Gear.UNKNOWN
        if confirmed is Gear.NEUTRAL:
            assert abs(status.estimate_m) <= windows.neutral_tolerance_m
        elif confirmed is Gear.BACKWARD:
            assert status.estimate_m >= engaged_m
        elif confirmed is Gear.FORWARD:
            assert status.estimate_m <= -engaged_m

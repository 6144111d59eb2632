"""Solenoid valve with the current of its coil and the motion of its plunger (thesis 3.1.3)."""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

from plant.devices.valve import NEVER_NS, CoilConfig, Drive, Valve, ValveTiming, seconds_to_ns
from plant.errors import InputError
from plant.kernel.compiled import kernel

STEP_NS = 2_000
"""Step of the integration; the opening is within 5 us of that of a solver with tolerance 1e-9."""


class Solenoid(NamedTuple):
    """A coil with its plunger, closed at 0: L(x) = L0 + L1 x + L2 x^2 / 2, spring preload_n + stiffness_n_m x."""

    supply_v: float
    decay_v: float
    resistance_ohm: float
    inductance_h: float = 0.432
    inductance_slope_h_m: float = 419.8
    inductance_curve_h_m2: float = 342_300.0
    travel_m: float = 0.0005
    mass_kg: float = 0.006
    preload_n: float = 18.153
    stiffness_n_m: float = 13_250.0
    damping_n_s_m: float = 0.01


class SolenoidState(NamedTuple):
    """Current, motion of the plunger, and energies since the start."""

    current_a: float = 0.0
    position_m: float = 0.0
    velocity_m_s: float = 0.0
    supplied_j: float = 0.0
    """Taken from the driver; what the freewheel path turns into heat counts as negative."""
    heat_j: float = 0.0
    """Lost in the windings."""
    friction_j: float = 0.0
    """Lost by damping and on the end stops."""


@kernel
def _step(
    state: SolenoidState, solenoid: Solenoid, on: float, step_s: float, blocked: bool
) -> SolenoidState:
    """Return the state a step later, the driver on for the share `on` of it (midpoint rule).

    u = R i + d(L i)/dt, m dv/dt = i^2/2 dL/dx - spring - damping.
    """
    current, position, velocity = state.current_a, state.position_m, state.velocity_m_s
    slope = solenoid.inductance_slope_h_m
    curve = solenoid.inductance_curve_h_m2
    inductance = solenoid.inductance_h + (slope + 0.5 * curve * position) * position
    flux = inductance * current
    voltage = on * solenoid.supply_v
    if current > 0.0 or on > 0.0:
        voltage -= (1.0 - on) * solenoid.decay_v
    middle_i, middle_x, middle_v = current, position, velocity
    flux_rate = acceleration = 0.0  # bound for numba before the loop
    for half in range(2):
        flux_rate = voltage - solenoid.resistance_ohm * middle_i
        force = 0.5 * middle_i * middle_i * (slope + curve * middle_x)
        force -= solenoid.preload_n + solenoid.stiffness_n_m * middle_x
        force -= solenoid.damping_n_s_m * middle_v
        at_rest = blocked or (
            (middle_x <= 0.0 and force < 0.0) or (middle_x >= solenoid.travel_m and force > 0.0)
        )
        acceleration = 0.0 if at_rest else force / solenoid.mass_kg
        if half == 0:
            middle_x = position + 0.5 * step_s * velocity
            middle_v = velocity + 0.5 * step_s * acceleration
            inductance = solenoid.inductance_h + (slope + 0.5 * curve * middle_x) * middle_x
            middle_i = max(0.0, flux + 0.5 * step_s * flux_rate) / inductance
    flux = max(0.0, flux + step_s * flux_rate)
    friction_j = solenoid.damping_n_s_m * middle_v * middle_v * step_s
    position += step_s * middle_v
    velocity += step_s * acceleration
    if blocked or position <= 0.0 or position >= solenoid.travel_m:
        friction_j += 0.5 * solenoid.mass_kg * velocity * velocity
        position = min(max(position, 0.0), solenoid.travel_m)
        velocity = 0.0
    inductance = solenoid.inductance_h + (slope + 0.5 * curve * position) * position
    return SolenoidState(
        flux / inductance,
        position,
        velocity,
        state.supplied_j + voltage * middle_i * step_s,
        state.heat_j + solenoid.resistance_ohm * middle_i * middle_i * step_s,
        state.friction_j + friction_j,
    )


@kernel
def _march(
    state: SolenoidState,
    solenoid: Solenoid,
    begin_ns: int,
    end_ns: int,
    carrier_ns: int,
    shift_ns: int,
    duty: float,
    blocked: bool,
    watch: float,
) -> tuple[SolenoidState, int, int]:
    """Advance in steps of at most STEP_NS; return state, instant reached, instant of a crossing (-1: none).

    Ends at `end_ns`, or when the plunger has passed `watch` (a position in m, positive on the way up, negative down).
    """
    now_ns = begin_ns
    while now_ns < end_ns:
        size_ns = min(STEP_NS, end_ns - now_ns)
        begin = (now_ns + shift_ns) % carrier_ns
        width = duty * carrier_ns
        covered = max(0.0, min(begin + size_ns, width) - begin)
        covered += max(0.0, min(begin + size_ns - carrier_ns, width))
        before = state.position_m
        state = _step(state, solenoid, covered / size_ns, size_ns * 1e-9, blocked)
        after = state.position_m
        if (watch > 0.0 and before < watch <= after) or (watch < 0.0 and before > -watch >= after):
            share = (abs(watch) - before) / (after - before)
            return state, now_ns + size_ns, now_ns + int(share * size_ns)
        now_ns += size_ns
    return state, now_ns, -1


class CoilValve(Valve):
    """One 3/2 valve whose plunger is moved by the force of its coil; it switches near the middle of its travel.

    `state` is the coil's at the last whole step; it `is_energised` by the duty, as in `Valve`. Every `sample_ns` (0:
    never) the current is noted in `currents` (ns, A). Raises ValueError when `duty` contradicts `is_open`, InputError
    for dips that overlap.
    """

    def __init__(
        self,
        timing: ValveTiming,
        config: CoilConfig,
        is_open: bool = False,
        duty: float = 0.0,
        sample_ns: int = 0,
    ) -> None:
        super().__init__(timing, is_open, duty)
        warm = 1.0 + 0.00393 * (config.temperature_k - 293.15)  # copper
        self.solenoid = Solenoid(config.supply_v, config.decay_v, config.resistance_ohm * warm)
        mean_v = duty * (config.supply_v + config.decay_v) - config.decay_v
        current_a = max(0.0, mean_v / self.solenoid.resistance_ohm)
        self.state = SolenoidState(current_a, self.solenoid.travel_m if is_open else 0.0)
        self._carrier_ns = seconds_to_ns(1.0 / config.carrier_hz)
        self._shift_ns = round(config.carrier_phase * self._carrier_ns)
        self._reached_ns = 0
        self._supply = supply_changes(config)
        self.currents: list[tuple[int, float]] = []
        self._sample_ns = sample_ns
        self._next_sample_ns = 0 if sample_ns else NEVER_NS

    def command(self, t_ns: int, duty: float) -> None:
        """Apply `duty` (0..1) to the coil from `t_ns` on. Raises ValueError as `Valve.command` does."""
        self._change(t_ns)
        super().command(t_ns, duty)

    def block(self, t_ns: int) -> None:
        """Hold the plunger where it is at `t_ns`, whatever the coil does, until `free`."""
        self._change(t_ns)
        super().block(t_ns)

    def free(self, t_ns: int) -> None:
        """Let a blocked plunger move again from `t_ns` on."""
        self._change(t_ns)
        super().free(t_ns)

    def _follow(self, t_ns: int) -> None:
        """Do nothing: the plunger follows the force."""

    def _settle(self, until_ns: int) -> None:
        """Advance by whole steps, which no grant of time may split, and note the moves up to `until_ns`."""
        while min(self._next_sample_ns, self._supply[0][0]) <= until_ns:
            if self._next_sample_ns <= self._supply[0][0]:
                self._march_whole(self._next_sample_ns)
                self.currents.append((self._next_sample_ns, self.state.current_a))
                self._next_sample_ns += self._sample_ns
            else:
                change_ns, supply_v = self._supply.pop(0)
                self._march(change_ns)
                self.solenoid = self.solenoid._replace(supply_v=supply_v)
        self._march_whole(until_ns)
        *_, crossed_ns = self._marched(self.state, self._reached_ns + STEP_NS)
        if 0 <= crossed_ns <= until_ns:  # within the step that is not whole yet
            self._switch(crossed_ns)

    def _change(self, t_ns: int) -> None:
        """Advance to the very instant at which something changes."""
        self._settle(t_ns)
        self._march(t_ns)

    def _march_whole(self, until_ns: int) -> None:
        self._march(self._reached_ns + (until_ns - self._reached_ns) // STEP_NS * STEP_NS)

    def _march(self, end_ns: int) -> None:
        while self._reached_ns < end_ns:
            self.state, self._reached_ns, crossed_ns = self._marched(self.state, end_ns)
            if crossed_ns >= 0:
                self._switch(crossed_ns)

    def _marched(self, state: SolenoidState, end_ns: int) -> tuple[SolenoidState, int, int]:
        if self.duty == 0.0 and state.current_a == 0.0 and state.position_m == 0.0:
            return state, max(end_ns, self._reached_ns), -1  # at rest
        # of the plunger's travel, beyond which the valve counts as closed, and as open
        share = -0.45 if self.is_open else 0.55
        marched: tuple[SolenoidState, int, int] = _march(
            state,
            self.solenoid,
            self._reached_ns,
            end_ns,
            self._carrier_ns,
            self._shift_ns,
            self.duty,
            self._blocked,
            share * self.solenoid.travel_m,
        )
        return marched

    def _switch(self, t_ns: int) -> None:
        self.is_open = not self.is_open
        self._moved.append((t_ns, 1.0 if self.is_open else 0.0))


def supply_changes(config: CoilConfig) -> list[tuple[int, float]]:
    """Return when the supply changes and to what [ns, V], in order. Raises InputError for dips that overlap."""
    dips = sorted(config.dip, key=lambda dip: dip.start_s)
    for dip, following in pairwise(dips):
        if following.start_s < dip.end_s:
            raise InputError(
                f"coil.dip: one from {following.start_s:g} s within that to {dip.end_s:g} s; "
                "expected one after the other"
            )
    changes = []
    for dip in dips:
        changes.append((seconds_to_ns(dip.start_s), dip.supply_v))
        changes.append((seconds_to_ns(dip.end_s), config.supply_v))
    return [*changes, (NEVER_NS, config.supply_v)]


def make_valve(
    drive: Drive,
    timing: ValveTiming,
    coil: CoilConfig,
    is_open: bool,
    duty: float,
    sample_ns: int = 0,
) -> Valve:
    """Return a valve at rest, as time delays or with its coil, its current noted every `sample_ns`."""
    if drive == "coil":
        return CoilValve(timing, coil, is_open, duty, sample_ns)
    return Valve(timing, is_open, duty)

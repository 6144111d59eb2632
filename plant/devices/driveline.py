"""Shafts on both sides of the synchronizer: engine synchronisation, cone, agreement, and how their speeds are measured."""

from __future__ import annotations

from math import floor, pi
from typing import Annotated

import msgspec
from msgspec import Meta
from numpy.random import Generator

from can_dbc.instants import NS_PER_S
from plant.devices.sensors import named_generator
from plant.devices.valve import seconds_to_ns
from plant.errors import InputError

BACKWARD, NO_GEAR, FORWARD = 1, 0, -1  # direction of a gear, as the sign of the stay's position

# in any unit below far beyond every drivetrain
Limited = Annotated[float, Meta(ge=-1e6, le=1e6)]
NotNegative = Annotated[float, Meta(ge=0.0, le=1e6)]
Positive = Annotated[float, Meta(gt=0.0, le=1e6)]


class DrivelineConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Shaft speeds and the cone, all referred to the synchronizer.

    output_rad_s: speed of the output shaft; constant, the vehicle's inertia being much larger.
    gear_step_rad_s: input minus output speed that shows as soon as a gear is left, because the
    speeds are from then on referred to the gear that comes next.
    engine_delay_s, engine_ramp_rad_s2: the engine begins to synchronise that long after, and
    changes its speed at that rate.
    residual_rad_s: input minus output speed that the engine leaves to the synchronizer.
    inertia_kg_m2: inertia of the input side. cone_gain_m: torque of the cone per axial force.
    impulse_backward_n_s, impulse_forward_n_s: impulse of the cone for that gear, instead of the one
    that follows from the speed difference; the residual then follows from it.
    ratio_backward, ratio_forward: input by output speed in that gear, 0 if not stated; if both are,
    the step on leaving a gear follows from them instead of gear_step_rad_s.
    follows_requests: the engine synchronises while it is asked to (TSC1 on the bus), otherwise by itself.
    teeth: of the wheels at which the shaft speeds are measured; 0: exact.
    timer_s: resolution of the timer that measures the teeth.
    noise_rad_s: standard deviation of what each measured speed is off.
    Source: thesis 4.1 in words; numbers inferred (with them 5 to 28 rad/s need 14 to 78 N s).
    """

    output_rad_s: Limited = 80.0
    gear_step_rad_s: Limited = 30.0
    engine_delay_s: NotNegative = 0.02
    engine_ramp_rad_s2: Positive = 150.0
    residual_rad_s: Limited = 0.0
    inertia_kg_m2: Positive = 0.25
    cone_gain_m: Positive = 0.09
    impulse_backward_n_s: NotNegative | None = None
    impulse_forward_n_s: NotNegative | None = None
    ratio_backward: NotNegative = 0.0
    ratio_forward: NotNegative = 0.0
    follows_requests: bool = False
    teeth: Annotated[int, Meta(ge=0, le=1000)] = 0
    timer_s: Annotated[float, Meta(ge=1e-9, le=1e-3)] = 1e-6
    noise_rad_s: Annotated[float, Meta(ge=0.0, le=100.0)] = 0.0


class Driveline:
    """Speeds of the two shafts, advanced at given instants with the state of the stay.

    Out of gear the input speed ramps to what the engine leaves over. The cone needs the impulse J = I |w_in - w_out| /
    k of its axial force to take the difference away, in proportion: w_in - w_out = (w_in - w_out)_0 (1 - spent/J). In
    gear they are equal. Assumptions: no torque of the engine while the stay is away from neutral; the output shaft
    keeps its speed.
    """

    def __init__(
        self,
        config: DrivelineConfig,
        x_block_m: float,
        position_m: float,
        has_synchronizer: bool = True,
    ) -> None:
        """Start at rest at `position_m`, in gear beyond `x_block_m` from neutral; there the engine has synchronised.

        Raises InputError unless `x_block_m` is positive. Without a synchronizer (on a rig) only a stated impulse
        blocks.
        """
        if not x_block_m > 0.0:
            raise InputError(f"synchronizer.x_block: {x_block_m:g}; expected above 0 m")
        self.config = config
        self.has_synchronizer = has_synchronizer
        self.x_block_m = x_block_m
        self.neutral_band_m = 0.5 * x_block_m
        self.is_engaged = abs(position_m) > x_block_m
        self.difference_rad_s = 0.0 if self.is_engaged else self.residual_rad_s(NO_GEAR)
        self.armed_n_s = 0.0
        self._open_difference_rad_s = self.difference_rad_s  # before the cone took any of it
        self._now_ns = 0
        self._engine_from_ns = 0
        self._ratios = {BACKWARD: config.ratio_backward, FORWARD: config.ratio_forward}
        self.referred = NO_GEAR
        """The gear with whose ratio the input speed is referred; NO_GEAR without ratios."""
        if all(self._ratios.values()):
            self.referred = BACKWARD if position_m > 0.0 else FORWARD
        self._request: tuple[int, float] | None = None  # instant in ns, input speed in rad/s

    @property
    def input_rad_s(self) -> float:
        """Speed of the input side [rad/s]."""
        return self.config.output_rad_s + self.difference_rad_s

    @property
    def output_rad_s(self) -> float:
        """Speed of the output side [rad/s]."""
        return self.config.output_rad_s

    @property
    def ratio(self) -> float:
        """Speed of the input shaft itself by `input_rad_s`; 1 without ratios."""
        return self._ratios.get(self.referred, 1.0)

    def residual_rad_s(self, direction: int) -> float:
        """Speed difference [rad/s] that the engine leaves to the synchronizer of that gear."""
        config = self.config
        impulse = self._stated_impulse_n_s(direction)
        if impulse is None:
            return config.residual_rad_s
        size = impulse * config.cone_gain_m / config.inertia_kg_m2
        return -size if config.residual_rad_s < 0.0 else size

    def required_impulse_n_s(self, direction: int) -> float:
        """Impulse [N s] that the cone needs at the present speeds for that gear."""
        stated = self._stated_impulse_n_s(direction)
        if stated is not None:
            return stated
        if not self.has_synchronizer:
            return 0.0
        config = self.config
        return config.inertia_kg_m2 * abs(self.difference_rad_s) / config.cone_gain_m

    def request(self, now_ns: int, input_rad_s: float | None) -> None:
        """Ask the engine for a speed of the input shaft [rad/s], not referred, or for none."""
        if input_rad_s is None:
            self._request = None
            return
        if self._request is None:
            self._engine_from_ns = now_ns + seconds_to_ns(self.config.engine_delay_s)
        self._request = now_ns, input_rad_s

    def advance(
        self, now_ns: int, position_m: float, spent_impulse_n_s: float, direction: int
    ) -> float | None:
        """Advance to `now_ns`; return the impulse [N s] to arm the synchronizer with, or None.

        Position and spent impulse are the stay's at `now_ns`, `direction` the gear that is asked for (BACKWARD,
        NO_GEAR, FORWARD). Raises ValueError when time runs backwards.
        """
        if now_ns < self._now_ns:
            raise ValueError(f"driveline at {self._now_ns} ns asked for {now_ns} ns")
        since_ns, self._now_ns = self._now_ns, now_ns
        distance = abs(position_m)
        if self.is_engaged:
            if distance < self.x_block_m:
                self.is_engaged = False
                self._leave_gear(now_ns, direction)
            return None
        if distance > self.x_block_m:
            self.is_engaged = True
            self.difference_rad_s = 0.0
            self.armed_n_s = 0.0  # used up: what was spent belongs to this engagement
            return None
        if distance > self.neutral_band_m:
            self._spend(spent_impulse_n_s)
            return None
        if spent_impulse_n_s > 0.0:
            self._spend(spent_impulse_n_s)
        self._refer(direction)
        goal_rad_s = self._engine_goal_rad_s(now_ns, direction)
        run_ns = now_ns - max(since_ns, self._engine_from_ns)
        if run_ns > 0 and goal_rad_s is not None:
            reach = self.config.engine_ramp_rad_s2 * run_ns / NS_PER_S
            error = goal_rad_s - self.difference_rad_s
            self._set_open(self.difference_rad_s + max(-reach, min(reach, error)))
        else:
            self._set_open(self.difference_rad_s)
        required = self.required_impulse_n_s(direction)
        if required == self.armed_n_s and spent_impulse_n_s == 0.0:
            return None
        self.armed_n_s = required
        return required

    def _leave_gear(self, now_ns: int, direction: int) -> None:
        if self.referred == NO_GEAR:
            self._set_open(self.config.gear_step_rad_s)
        else:
            self._refer(direction or -self.referred)
        if not self.config.follows_requests:
            self._engine_from_ns = now_ns + seconds_to_ns(self.config.engine_delay_s)

    def _refer(self, direction: int) -> None:
        """Refer the input speed with the ratio of another gear."""
        if NO_GEAR not in (self.referred, direction) and direction != self.referred:
            input_rad_s = self.input_rad_s * self._ratios[self.referred] / self._ratios[direction]
            self.referred = direction
            self._set_open(input_rad_s - self.config.output_rad_s)

    def _engine_goal_rad_s(self, now_ns: int, direction: int) -> float | None:
        """Return the speed difference that the engine aims at; None while nothing asks it to."""
        residual = self.residual_rad_s(direction)
        if not self.config.follows_requests:
            return residual
        if self._request is None or now_ns - self._request[0] > 100_000_000:
            return None  # no request, or none for 0.1 s
        return self._request[1] / self.ratio - self.config.output_rad_s + residual

    def _stated_impulse_n_s(self, direction: int) -> float | None:
        config = self.config
        stated = {BACKWARD: config.impulse_backward_n_s, FORWARD: config.impulse_forward_n_s}
        if direction in stated:
            return stated[direction]
        return max((impulse for impulse in stated.values() if impulse is not None), default=None)

    def _set_open(self, difference_rad_s: float) -> None:
        self.difference_rad_s = difference_rad_s
        self._open_difference_rad_s = difference_rad_s

    def _spend(self, spent_impulse_n_s: float) -> None:
        if self.armed_n_s > 0.0:
            left = max(0.0, 1.0 - spent_impulse_n_s / self.armed_n_s)
            self.difference_rad_s = self._open_difference_rad_s * left


class ToothedWheel:
    """A shaft speed as a toothed wheel and a timer measure it.

    Whole teeth since the last report / time between their edges, in whole ticks; without a new tooth the last value
    stays. Assumes: even teeth, and a speed that is constant between two reports.
    """

    def __init__(
        self, teeth: int, timer_s: float, noise_rad_s: float, generator: Generator
    ) -> None:
        """`teeth`: 0 for an exact measurement with the noise alone."""
        self._pitch_rad = 2.0 * pi / teeth if teeth else 0.0
        self._timer_s = timer_s
        self._noise_rad_s = noise_rad_s
        self._generator = generator
        self._angle_rad = 0.0
        self._now_ns = 0
        self._edge: tuple[int, int] | None = None  # number of the last tooth, its edge in ticks
        self._speed_rad_s = 0.0

    def measure(self, now_ns: int, speed_rad_s: float) -> float:
        """Return the measured speed [rad/s] at the instant of a report."""
        if self._pitch_rad:
            self._count(now_ns, speed_rad_s)
        else:
            self._speed_rad_s = speed_rad_s
        if self._noise_rad_s:
            return self._speed_rad_s + self._noise_rad_s * float(self._generator.standard_normal())
        return self._speed_rad_s

    def _count(self, now_ns: int, speed_rad_s: float) -> None:
        self._angle_rad += speed_rad_s * (now_ns - self._now_ns) / NS_PER_S
        self._now_ns = now_ns
        tooth = floor(self._angle_rad / self._pitch_rad)
        if speed_rad_s == 0.0 or (self._edge is not None and tooth == self._edge[0]):
            return
        since_s = (self._angle_rad - tooth * self._pitch_rad) / speed_rad_s
        edge = tooth, round((now_ns / NS_PER_S - since_s) / self._timer_s)
        if self._edge is not None and edge[1] > self._edge[1]:
            turned_rad = (tooth - self._edge[0]) * self._pitch_rad
            self._speed_rad_s = turned_rad / ((edge[1] - self._edge[1]) * self._timer_s)
        self._edge = edge


def toothed_wheels(config: DrivelineConfig, seed: int) -> list[ToothedWheel]:
    """Return the wheels of input and output shaft, none if the speeds are exact."""
    if not (config.teeth or config.noise_rad_s):
        return []
    return [
        ToothedWheel(
            config.teeth,
            config.timer_s,
            config.noise_rad_s,
            named_generator(seed, "toothed wheel", shaft),
        )
        for shaft in ("input", "output")
    ]

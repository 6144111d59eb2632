"""Shafts on both sides of the synchronizer: engine synchronisation in neutral, cone, agreement."""

from __future__ import annotations

from typing import Annotated

import msgspec
from msgspec import Meta

from plant.devices.valve import NS_PER_S, seconds_to_ns
from plant.errors import InputError

BACKWARD, NO_GEAR, FORWARD = 1, 0, -1  # direction of a gear, as the sign of the stay's position

LARGEST = 1e6  # of any value below, in its unit: far beyond every drivetrain
Limited = Annotated[float, Meta(ge=-LARGEST, le=LARGEST)]
NotNegative = Annotated[float, Meta(ge=0.0, le=LARGEST)]
Positive = Annotated[float, Meta(gt=0.0, le=LARGEST)]


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


class Driveline:
    """Speeds of the two shafts, advanced at given instants with the state of the stay.

    Out of gear the input speed ramps to what the engine leaves over. The cone needs the impulse
    J = I |w_in - w_out| / k of its axial force to take the difference away, which falls in
    proportion: w_in - w_out = (w_in - w_out)_0 (1 - spent/J). In gear the speeds are equal.
    Assumptions: the engine gives no torque while the stay is away from neutral; the output shaft
    keeps its speed.
    """

    def __init__(
        self,
        config: DrivelineConfig,
        x_block_m: float,
        position_m: float,
        has_synchronizer: bool = True,
    ) -> None:
        """Start at rest with the stay at `position_m`, in gear beyond `x_block_m` from neutral.

        In neutral the engine has already synchronised. Raises InputError unless `x_block_m` is
        positive. Without a synchronizer (on a rig) only a
        stated impulse blocks.
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

    @property
    def input_rad_s(self) -> float:
        """Speed of the input side [rad/s]."""
        return self.config.output_rad_s + self.difference_rad_s

    @property
    def output_rad_s(self) -> float:
        """Speed of the output side [rad/s]."""
        return self.config.output_rad_s

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

    def advance(
        self, now_ns: int, position_m: float, spent_impulse_n_s: float, direction: int
    ) -> float | None:
        """Advance to `now_ns`; return the impulse [N s] to arm the synchronizer with, or None.

        `position_m` and `spent_impulse_n_s` are those of the stay at `now_ns`, `direction` the gear
        that is being asked for (BACKWARD, NO_GEAR, FORWARD).
        Raises ValueError when time runs backwards.
        """
        if now_ns < self._now_ns:
            raise ValueError(f"driveline at {self._now_ns} ns asked for {now_ns} ns")
        since_ns, self._now_ns = self._now_ns, now_ns
        distance = abs(position_m)
        if self.is_engaged:
            if distance < self.x_block_m:
                self.is_engaged = False
                self._set_open(self.config.gear_step_rad_s)
                self._engine_from_ns = now_ns + seconds_to_ns(self.config.engine_delay_s)
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
        run_ns = now_ns - max(since_ns, self._engine_from_ns)
        if run_ns > 0:
            reach = self.config.engine_ramp_rad_s2 * run_ns / NS_PER_S
            error = self.residual_rad_s(direction) - self.difference_rad_s
            self._set_open(self.difference_rad_s + max(-reach, min(reach, error)))
        else:
            self._set_open(self.difference_rad_s)
        required = self.required_impulse_n_s(direction)
        if required == self.armed_n_s and spent_impulse_n_s == 0.0:
            return None
        self.armed_n_s = required
        return required

    def _stated_impulse_n_s(self, direction: int) -> float | None:
        config = self.config
        if direction == BACKWARD:
            return config.impulse_backward_n_s
        if direction == FORWARD:
            return config.impulse_forward_n_s
        stated = [
            impulse
            for impulse in (config.impulse_backward_n_s, config.impulse_forward_n_s)
            if impulse is not None
        ]
        return max(stated) if stated else None

    def _set_open(self, difference_rad_s: float) -> None:
        self.difference_rad_s = difference_rad_s
        self._open_difference_rad_s = difference_rad_s

    def _spend(self, spent_impulse_n_s: float) -> None:
        if self.armed_n_s > 0.0:
            left = max(0.0, 1.0 - spent_impulse_n_s / self.armed_n_s)
            self.difference_rad_s = self._open_difference_rad_s * left

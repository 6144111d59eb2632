"""Estimate speed and pressures of an engagement from the late position and past commands."""

from __future__ import annotations

from typing import Annotated

from controller.light_model import LightModel, LightModelState, ModelSettings, Valve
from controller.position import position_filter
from controller.settings import ControlConfig, Settings, bounded

STEP_S = 0.0005
"""Step of the light model."""


class ObserverSettings(Settings, frozen=True):
    """How strongly the model follows the measurements."""

    sensor_age_s: Annotated[float, bounded(0.0, 0.05, "s")] = 0.00455
    """Age of the newest sample at a step, without the filter (pulse, capture, bus, waiting)."""
    position_gain: Annotated[float, bounded(0.0, 2.0, "")] = 0.5
    speed_gain_per_s: Annotated[float, bounded(0.0, 1000.0, "1/s")] = 20.0
    load_gain_n_m: Annotated[float, bounded(0.0, 1e6, "N/m")] = 3e4
    most_load_n: Annotated[float, bounded(0.0, 5000.0, "N")] = 2200.0


class Observer:
    """The light model run in parallel with the actuator and corrected by late measurements.

    The model's past position goes through the same filter as the sensor's, so that the two
    differ only by what the model does not know; the difference moves position, speed and load.
    Bounded work: period/0.5 ms model steps and one filter step a sample.
    """

    def __init__(
        self, config: ControlConfig, model: ModelSettings, settings: ObserverSettings
    ) -> None:
        self._settings = settings
        self.model = LightModel(model, config.windows.stroke_m)
        self._past = round(settings.sensor_age_s / STEP_S)
        self.motion = LightModelState(model.atmosphere_pa, model.atmosphere_pa)
        self.driving = Valve(model.valve_open_s, model.valve_close_s)
        self.braking = Valve(model.valve_open_s, model.valve_close_s)
        self._ring = [0.0] * (self._past + 1)
        self._filter = position_filter(config)
        self.reset()

    def reset(self) -> None:
        """Start in neutral, at rest, both chambers vented, valves closed."""
        self.motion.rest(self.model.settings.atmosphere_pa)
        self.driving.close()
        self.braking.close()
        self.steps = 0  # of the model, since the push began
        self._ring[:] = [0.0] * len(self._ring)
        if self._filter is not None:
            self._filter.settle(0.0)

    @property
    def time_s(self) -> float:
        """Time since the push began up to which the model has run."""
        return self.steps * STEP_S

    @property
    def travelled_m(self) -> float:
        """Estimated position of the stay now, m from neutral."""
        return self.motion.stay_m

    def advance(self, until_s: float, measured_m: float, new_samples: int) -> None:
        """Run the model up to now and correct it with a measured position, if it is new."""
        goal = round(until_s / STEP_S)
        while self.steps < goal:
            now_s = self.time_s
            self.model.step(self.motion, self.driving.at(now_s), self.braking.at(now_s), STEP_S)
            self.steps += 1
            self._ring[self.steps % len(self._ring)] = self.travelled_m
        if new_samples:
            self._correct(measured_m, new_samples)

    def _correct(self, measured_m: float, new_samples: int) -> None:
        expected_m = self._ring[(self.steps - self._past) % len(self._ring)]
        if self._filter is not None:
            sampled_m = expected_m
            for _ in range(new_samples):
                expected_m = self._filter.update(sampled_m)
        settings, motion = self._settings, self.motion
        error_m = measured_m - expected_m
        touching = motion.piston_m >= self.model.settings.gap_m + motion.stay_m - 1e-9
        if not touching and motion.stay_m <= 0.0 and error_m <= 1e-4:  # two ticks of the sensor
            return  # the piston moves alone, the stay rests: nothing to correct
        stroke_m = self.model.stroke_m
        moved_m = motion.stay_m + settings.position_gain * error_m
        motion.stay_m = min(max(moved_m, 0.0), stroke_m)
        limit_m = self.model.settings.gap_m + motion.stay_m
        motion.piston_m = limit_m if touching else min(motion.piston_m, limit_m)
        motion.stay_m_s += settings.speed_gain_per_s * error_m
        if touching:
            motion.piston_m_s = motion.stay_m_s
        motion.load_n = min(
            max(motion.load_n - settings.load_gain_n_m * error_m, 0.0), settings.most_load_n
        )

    def command(self, charge: bool, brake: bool) -> None:
        """Note the command of this step."""
        at_s = self.time_s + self.model.settings.transport_s
        self.driving.command(at_s, charge)
        self.braking.command(at_s, brake)

"""Base of the strategies with a model: an observer, and trials of the next commands."""

from __future__ import annotations

import abc
from copy import copy
from typing import Annotated, NamedTuple

from msgspec import Struct

from controller.light_model import STEP_S, ModelSettings, Observer, ObserverSettings
from controller.settings import ControlConfig, bounded
from controller.strategies.into_gear import Command, IntoGear, IntoGearParameters, PushProgress


class ForesightParameters(IntoGearParameters, frozen=True):
    """Settings of a strategy that carries the light model."""

    model: ModelSettings = ModelSettings()
    observer: ObserverSettings = ObserverSettings()
    horizon_s: Annotated[float, bounded(0.005, 0.2, "s")] = 0.06
    """How far a trial looks ahead."""


class Outcome(NamedTuple):
    """End of a trial: impact speed, and the time it took; no arrival counts the rest of the way."""

    speed_m_s: float
    time_s: float
    left_m: float


class Foresight(IntoGear):
    """A push into gear planned with the light model."""

    parameters: ForesightParameters

    def __init__(self, config: ControlConfig, parameters: Struct) -> None:
        super().__init__(config, parameters)
        self.observer = Observer(config, self.parameters.model, self.parameters.observer)
        self._steps = round(self.parameters.horizon_s / STEP_S)

    def reset(self) -> None:
        """Start the observer afresh."""
        self.observer.reset()

    def decide(self, progress: PushProgress) -> Command:
        """Bring the observer up to now, plan, and pass the choice to the observer."""
        observer = self.observer
        observer.advance(progress.spent_s, progress.travelled_m, progress.new_samples)
        command = self.plan(progress.spent_s)
        observer.command(command.charge, command.brake)
        return command

    @abc.abstractmethod
    def plan(self, spent_s: float) -> Command:
        """Choose the valves for the coming period from the observer's state."""

    def trial(
        self, brake_on_s: float, brake_off_s: float, charge_off_s: float, charge_on_s: float
    ) -> Outcome:
        """Run the model on with commands at delays from now; beyond the horizon: never. Horizon/0.5 ms model steps."""
        observer = self.observer
        motion = copy(observer.motion)
        driving, braking = copy(observer.driving), copy(observer.braking)
        model, start_s = observer.model, observer.time_s
        transport_s, stroke_m, advance = model.settings.transport_s, model.stroke_m, model.step
        for step in range(self._steps):
            ahead_s = step * STEP_S
            now_s = start_s + ahead_s
            given_s = ahead_s - transport_s
            if given_s >= 0.0:
                driving.command(now_s, not charge_off_s <= given_s < charge_on_s)
                braking.command(now_s, brake_on_s <= given_s < brake_off_s)
            speed_m_s = motion.stay_m_s
            advance(motion, driving.at(now_s), braking.at(now_s), STEP_S)
            if motion.stay_m >= stroke_m:
                return Outcome(max(speed_m_s, 0.0), ahead_s, 0.0)
        return Outcome(0.0, self.parameters.horizon_s, model.stroke_m - motion.stay_m)

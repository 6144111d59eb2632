"""One programme for every shift: what can be done without knowing anything of it."""

from __future__ import annotations

from typing import Annotated

from controller.settings import bounded
from controller.strategies import into_gear


class FixedProgrammeParameters(into_gear.IntoGearParameters, frozen=True):
    """Begins and lengths, in seconds since the push began; the nearest steps act for them."""

    rest_begin_s: Annotated[float, bounded(0.0, 0.5, "s")] = 0.0
    rest_s: Annotated[float, bounded(0.0, 0.3, "s")] = 0.0
    brake_begin_s: Annotated[float, bounded(0.0, 0.5, "s")] = 0.0
    brake_s: Annotated[float, bounded(0.0, 0.3, "s")] = 0.0


class FixedProgramme(into_gear.IntoGear):
    """Leave the driving chamber and fill the neutral one at fixed times of the push; at most 20 operations a step."""

    Parameters = FixedProgrammeParameters
    parameters: FixedProgrammeParameters

    def reset(self) -> None:
        """Nothing is remembered."""

    def decide(self, progress: into_gear.PushProgress) -> into_gear.Command:
        """Push but for the two intervals."""
        parameters, now_s = self.parameters, progress.spent_s + 0.5 * self.config.period_s
        rest = now_s >= parameters.rest_begin_s and into_gear.within(
            parameters.rest_begin_s, now_s, parameters.rest_s
        )
        brake = now_s >= parameters.brake_begin_s and into_gear.within(
            parameters.brake_begin_s, now_s, parameters.brake_s
        )
        return into_gear.Command(not rest, brake)

"""A cushion of air made by a burst into the chamber that the stay compresses."""

from __future__ import annotations

from typing import Annotated

from controller.settings import bounded
from controller.strategies import into_gear


class AirCushionParameters(into_gear.IntoGearParameters, frozen=True):
    """When the burst begins and how long it lasts."""

    trigger_m: Annotated[float, bounded(0.0, 0.1, "m")] = 0.006
    """Travel from neutral at which the braking is to begin."""
    lead_s: Annotated[float, bounded(0.0, 0.1, "s")] = 0.012
    """How far ahead the position is extrapolated."""
    burst_s: Annotated[float, bounded(0.0, 0.2, "s")] = 0.015
    """Time for which the neutral chamber is filled."""
    keep_charging: bool = False
    """Whether the driving chamber goes on being filled during the burst."""


class AirCushion(into_gear.IntoGear):
    """Fill the neutral chamber for a moment just before the end (thesis 6.3).

    The burst begins when x + v lead >= trigger; the lead covers sensor and valve. Some 4 operations a step.
    """

    Parameters = AirCushionParameters
    parameters: AirCushionParameters

    _begun_s: float | None = None

    def reset(self) -> None:
        """Forget the burst."""
        self._begun_s = None

    def decide(self, progress: into_gear.PushProgress) -> into_gear.Command:
        """Push until the burst, brake during it, push again."""
        parameters = self.parameters
        if (
            self._begun_s is None
            and progress.travelled_m + parameters.lead_s * progress.speed_m_s
            >= parameters.trigger_m
        ):
            self._begun_s = progress.spent_s
        burst = into_gear.within(self._begun_s, progress.spent_s, parameters.burst_s)
        return into_gear.Command(parameters.keep_charging or not burst, burst)

"""Sliding mode of reduced order on the position alone, with on/off valves."""

from __future__ import annotations

from typing import Annotated

from controller.settings import bounded
from controller.strategies import into_gear


class SlidingModeParameters(into_gear.IntoGearParameters, frozen=True):
    """Surface and band."""

    slope_per_s: Annotated[float, bounded(1.0, 1000.0, "1/s")] = 60.0
    band_m_s: Annotated[float, bounded(0.0, 5.0, "m/s")] = 0.1
    beyond_m: Annotated[float, bounded(0.0, 0.02, "m")] = 0.003
    """The goal lies this far beyond the stop, so that the stay is pressed on at the end."""


class SlidingMode(into_gear.IntoGear):
    """Keep s = slope (goal - x) - v at zero: fill when above the band, brake when below.

    On s = 0 the remaining way decays with 1/slope, whatever mass and load; the pressures, which nobody measures, are
    left out (the reduction of order). Within the band both chambers vent. Some 5 operations a step. Source: Paul,
    Mishra and Radke, Reduced order sliding mode control for pneumatic actuator, IEEE Trans. Control Systems Technology
    2 (1994).
    """

    Parameters = SlidingModeParameters
    parameters: SlidingModeParameters

    def reset(self) -> None:
        """Nothing to forget: the surface has no memory."""

    def decide(self, progress: into_gear.PushProgress) -> into_gear.Command:
        """Choose by the side of the surface."""
        parameters = self.parameters
        goal_m = self.config.windows.stroke_m + parameters.beyond_m
        side_m_s = parameters.slope_per_s * (goal_m - progress.travelled_m) - progress.speed_m_s
        if side_m_s > parameters.band_m_s:
            return into_gear.PUSH
        return into_gear.BRAKE if side_m_s < -parameters.band_m_s else into_gear.REST

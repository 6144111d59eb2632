"""Shaft speeds as toothed wheels and a timer measure them."""

from __future__ import annotations

from math import floor, pi

from numpy.random import Generator

from plant.devices.driveline import DrivelineConfig
from plant.devices.sensors import named_generator
from plant.devices.valve import NS_PER_S


class ToothedWheel:
    """A shaft speed as a toothed wheel and a timer measure it.

    Whole teeth since the last report / time between their edges, in whole ticks; without a new tooth the last value stays.
    Assumes: even teeth, and a speed that is constant between two reports.
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

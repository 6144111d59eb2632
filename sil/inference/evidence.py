"""How large residuals are when nothing is wrong: the floor that a fit is compared with.

Checked by: tests/unit/sil/inference/test_fit.py, test_verdict.py
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtri

from plant.errors import IntegrationError
from sil.inference.fit import FitResult
from sil.inference.problem import ChannelPart, Problem
from sil.inference.thresholds import LIMITS


@dataclass(frozen=True)
class ChannelMisfit:
    """One channel over some strokes: rms over its floor (the mean square when nothing is wrong), count, and the band's edge."""

    rms: float
    count: int
    band: float
    floor: float = 1.0

    @property
    def excess(self) -> float:
        """Sum of the squared standardised residuals beyond the floor, at least 0."""
        return max(0.0, (self.rms**2 - 1.0) * self.floor * self.count)

    @property
    def beyond(self) -> float:
        """Mean square of the standardised residuals beyond the band."""
        return max(0.0, (self.rms**2 - self.band**2) * self.floor)


@dataclass(frozen=True)
class Misfit:
    """A fit against the floor: chi squared beyond it; band: three standard deviations of a clean campaign's excess."""

    channels: dict[str, ChannelMisfit]
    excess: float
    band: float
    count: int

    @property
    def per_number(self) -> float:
        """Excess per compared number."""
        return self.excess / max(1, self.count)

    @property
    def beyond(self) -> float:
        """Excess that is surely not noise."""
        return max(0.0, self.excess - self.band)

    @property
    def is_noise(self) -> bool:
        """Whether every channel, and all together, are within the band of clean campaigns."""
        return self.beyond == 0.0 and all(item.beyond == 0.0 for item in self.channels.values())

    @property
    def detail(self) -> float:
        """Excess beyond the band that is a detail: none if a channel by itself is far off."""
        is_local = any(item.beyond > LIMITS.max_channel_excess for item in self.channels.values())
        return 0.0 if is_local else LIMITS.max_detail_per_number * self.count

    @property
    def rms(self) -> float:
        """Rms of all residuals over their expected scatter; 1 = explained."""
        total = sum(item.rms**2 * item.count for item in self.channels.values())
        return float(np.sqrt(total / max(1, self.count)))


def misfit(problem: Problem, fit: FitResult) -> Misfit:
    """Compare a fit's residuals with the floor, channel by channel and in all."""
    parts: dict[str, list[ChannelPart]] = {}
    for k, block in fit.blocks.items():
        for part in problem.parts(k, block.residual):
            parts.setdefault(part.name, []).append(part)
    channels = {}
    excess = variance = 0.0
    for name, strokes in parts.items():
        n = sum(len(part.residual) for part in strokes)
        total = sum(float(part.residual @ part.residual) for part in strokes)
        floor = sum(part.floor for part in strokes)
        share = float(np.hypot(strokes[0].spread / (floor / n) ** 0.5, np.sqrt(0.5 / n)))
        rms = float(np.sqrt(total / floor))
        channels[name] = ChannelMisfit(rms, n, 1.0 + 3.0 * share, floor / n)
        excess += total - floor
        variance += (2.0 * share * floor) ** 2
    count = sum(channel.count for channel in channels.values())
    return Misfit(channels, excess, 3.0 * float(np.sqrt(variance)), count)


def strained(fit: FitResult) -> bool:
    """Return whether a fit agrees with the data only because tolerances or scatter are implausibly wide.

    Their sums of squares are held against chi squared; each kind of scatter by itself.
    """
    scatter = np.sum(fit.stroke[list(fit.use)] ** 2, axis=0)
    unit = float(np.sum(fit.shared[: fit.layout.healthy] ** 2))
    return bool(
        np.any(scatter > chdtri(len(fit.use), LIMITS.min_strain_probability))
        or unit > chdtri(fit.layout.healthy, LIMITS.min_strain_probability)
    )


def inexact_squares(problem: Problem, fit: FitResult) -> dict[str, float]:
    """Return by channel the squared residuals that errors of its causes' forms may leave (95 %), where a form is a guess.

    Of each cause the share, squared, of all that it changes in the predictions; 0 if that cannot be simulated.
    """
    squares: dict[str, float] = {}
    for index, item in enumerate(fit.candidates):
        if item.effect.form_error == 0.0:
            continue
        without = list(fit.values)
        without[index] = {p.name: p.neutral for p in item.parameters}
        with suppress(IntegrationError):
            for k in fit.blocks:
                spot = k, fit.shared, fit.stroke[k], fit.candidates
                change = problem.changed(*spot, fit.values) - problem.changed(*spot, without)
                for part in problem.parts(k, 1.96 * item.effect.form_error * change):
                    square = float(part.residual @ part.residual)
                    squares[part.name] = squares.get(part.name, 0.0) + square
    return squares

"""How large residuals are when nothing is wrong: the floor that a fit is compared with.

Pressures: their standardised residuals have mean square one.  Potentiometer and reported position
are standardised conservatively (a resting wiper says one thing, not hundreds; a reported value
depends on the recorder's step in time), so theirs are smaller, by factors found on clean simulated
campaigns.
Checked by: tests/unit/sil/fitting/test_fit.py
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import chdtri

from sil.fitting.fit import FitResult
from sil.fitting.model import CampaignModel, channel_parts

FLOOR_RMS = {"position": 0.385, "pressure": 1.0, "oil": 1.0, "internal": 0.17}
"""Root mean square of standardised residuals of a clean campaign, by kind of channel."""

FLOOR_SPREAD = {"position": 0.03, "pressure": 0.004, "oil": 0.008, "internal": 0.05}
"""Its spread between clean campaigns, in addition to the one that counting gives."""


EXPLAINED = 1.25
"""Residual over expected noise up to which noise explains it: the noise is an estimate itself."""

STRAIN_LEVEL = 1e-6
"""How rarely the scatter of healthy strokes, or a unit's tolerances, may come out so wide."""


@dataclass(frozen=True)
class ChannelMisfit:
    """One channel over some strokes: rms over its floor, how many numbers, and the band's edge."""

    rms: float
    count: int
    band: float
    kind: str


@dataclass(frozen=True)
class Misfit:
    """A fit against the floor.

    excess: chi squared beyond it; band: three standard deviations of a clean campaign's excess.
    """

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
    def rms(self) -> float:
        """Rms of all residuals over their expected scatter; 1 = explained."""
        total = sum(item.rms**2 * item.count for item in self.channels.values())
        return float(np.sqrt(total / max(1, self.count)))


def _channel_squares(model: CampaignModel, fit: FitResult) -> dict[str, tuple[str, float, int]]:
    """Return kind, sum of squared standardised residuals and count of every channel."""
    sums: dict[str, tuple[str, float, int]] = {}

    def add(name: str, kind: str, part: np.ndarray) -> None:
        _kind, total, count = sums.get(name, (kind, 0.0, 0))
        sums[name] = (kind, total + float(part @ part), count + len(part))

    for k, block in fit.blocks.items():
        stroke = model.strokes[k]
        for channel, part in channel_parts(stroke, block.residual):
            add(channel.name, channel.kind, part)
        if stroke.internal is not None:
            add("position_internal_m", "internal", block.residual[stroke.size :])
    return sums


def misfit(model: CampaignModel, fit: FitResult) -> Misfit:
    """Compare a fit's residuals with the floor, channel by channel and in all."""
    channels = {}
    excess = 0.0
    variance = 0.0
    count = 0
    for name, (kind, total, n) in _channel_squares(model, fit).items():
        floor = FLOOR_RMS[kind] ** 2
        share = float(np.hypot(FLOOR_SPREAD[kind] / FLOOR_RMS[kind], np.sqrt(0.5 / max(1, n))))
        channels[name] = ChannelMisfit(
            float(np.sqrt(total / max(1, n) / floor)), n, 1.0 + 3.0 * share, kind
        )
        excess += total - floor * n
        variance += (2.0 * share * floor * n) ** 2
        count += n
    return Misfit(channels, excess, 3.0 * float(np.sqrt(variance)), count)


def strained(fit: FitResult) -> bool:
    """Return whether a fit agrees with the data only because tolerances or scatter are implausibly wide.

    Their sums of squares are held against chi squared (they have standard normal priors, and what
    is estimated is drawn towards zero); each kind of scatter by itself.
    """
    scatter = np.sum(fit.stroke[list(fit.use)] ** 2, axis=0)
    unit = float(np.sum(fit.shared[: fit.layout.healthy] ** 2))
    return bool(
        np.any(scatter > chdtri(len(fit.use), STRAIN_LEVEL))
        or unit > chdtri(fit.layout.healthy, STRAIN_LEVEL)
    )

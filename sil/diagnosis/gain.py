"""What the extended model gains on strokes that were not used to fit it.

Checked by: tests/unit/sil/diagnosis/test_diagnose.py
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from sil.diagnosis.verdict import Verdict
from sil.fitting.fit import FitResult
from sil.fitting.internal import INTERNAL_SD_M
from sil.fitting.model import CampaignModel, Floats, channel_parts


@dataclass(frozen=True)
class Gain:
    """Rms of residuals before and after by channel (in the channel's unit) and standardised."""

    files: tuple[str, ...]
    channels: dict[str, tuple[float, float]]
    before: float
    after: float

    def as_json(self) -> dict[str, Any]:
        """Return the object `gain` of diagnosis.json."""
        return {
            "heldout_strokes": list(self.files),
            "channels": {
                name: {"before": before, "after": after, "unit": "rms"}
                for name, (before, after) in self.channels.items()
            },
            "standardised": {"before": self.before, "after": self.after},
        }


def channel_rms(model: CampaignModel, fit: FitResult) -> dict[str, float]:
    """Return rms of residuals in each channel's own unit, over the strokes of a fit."""
    squares: dict[str, list[Floats]] = {}
    for k, block in fit.blocks.items():
        stroke = model.strokes[k]
        for channel, part in channel_parts(stroke, block.residual):
            squares.setdefault(channel.name, []).append(part * channel.sd)
        if stroke.internal is not None:
            part = block.residual[stroke.size :] * INTERNAL_SD_M
            squares.setdefault("position_internal_m", []).append(part)
    return {
        name: float(np.sqrt(sum(float(p @ p) for p in parts) / max(1, sum(map(len, parts)))))
        for name, parts in squares.items()
    }


def gain_between(model: CampaignModel, verdict: Verdict, held_out: tuple[int, ...]) -> Gain:
    """Gain of the verdict's leader over the healthy model, each fitted to the training strokes."""
    before = verdict.healthy.held or verdict.healthy.training
    after = verdict.leader.held or verdict.leader.training
    first, second = channel_rms(model, before), channel_rms(model, after)
    return Gain(
        tuple(model.strokes[k].entry.file for k in held_out),
        {name: (first[name], second[name]) for name in first},
        verdict.healthy.misfit.rms,
        verdict.leader.misfit.rms,
    )

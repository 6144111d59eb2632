"""Residuals in figures: relative errors, and the gain on held-out strokes.

Checked by: tests/unit/sil/inference/test_diagnose.py
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sil.campaign.campaign import Floats
from sil.inference.campaign.model import CampaignModel, channel_parts
from sil.inference.fit import FitResult
from sil.inference.report import Gain
from sil.inference.verdict import Judged, Verdict


@dataclass(frozen=True)
class Relative:
    """|measured - simulated| over the largest measured value (3.69, 3.70): mean of all strokes, and largest."""

    mean: float
    largest: float


def relative_errors(model: CampaignModel, fit: FitResult) -> dict[str, Relative]:
    """Return the relative errors of each channel over whole records."""
    errors: dict[str, list[tuple[float, float]]] = {}
    for k, block in fit.blocks.items():
        for channel, r in channel_parts(model.strokes[k], block.residual):
            share = np.abs(r * channel.sd) / float(np.abs(channel.measured).max())
            errors.setdefault(channel.name, []).append((share.mean(), share.max()))
    return {
        name: Relative(float(np.mean(means)), float(np.max(largest)))
        for name, (means, largest) in ((n, zip(*v, strict=True)) for n, v in errors.items())
    }


def _channel_rms(model: CampaignModel, fit: FitResult) -> dict[str, float]:
    parts: dict[str, list[Floats]] = {}
    for k, block in fit.blocks.items():
        stroke = model.strokes[k]
        for channel, part in channel_parts(stroke, block.residual):
            parts.setdefault(channel.name, []).append(part * channel.sd)
        if stroke.internal is not None:
            part = block.residual[stroke.size :] * stroke.internal.sd_m
            parts.setdefault("position_internal_m", []).append(part)
    columns = {name: np.concatenate(residuals) for name, residuals in parts.items()}
    return {name: float(np.sqrt(np.mean(r**2))) if len(r) else 0.0 for name, r in columns.items()}


def gain_between(model: CampaignModel, verdict: Verdict[Judged], held_out: tuple[int, ...]) -> Gain:
    """Gain of the verdict's leader over the healthy model, each fitted to the training strokes."""
    before = verdict.healthy.held_out_fit or verdict.healthy.training
    after = verdict.leader.held_out_fit or verdict.leader.training
    first, second = _channel_rms(model, before), _channel_rms(model, after)
    over_noise = verdict.leader.misfit.channels
    return Gain(
        tuple(model.strokes[k].entry.file for k in held_out),
        {name: (first[name], rms, rms / over_noise[name].rms) for name, rms in second.items()},
        verdict.healthy.misfit.rms,
        verdict.leader.misfit.rms,
    )

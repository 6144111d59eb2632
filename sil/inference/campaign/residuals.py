"""Figures of residuals: by channel and phase, relative errors, dependence, gain on held-out strokes.

Relative errors after thesis 3.69/3.70: mean and maximum of |measured - simulated| over the largest
measured value; the window is the whole record.
Checked by: tests/unit/sil/inference/test_diagnose.py
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from plant.effects.stroke_conditions import StrokeConditions
from sil.campaign.campaign import Floats
from sil.inference.campaign.model import CampaignModel, channel_parts
from sil.inference.campaign.phases import PHASES, phases
from sil.inference.fit import FitResult
from sil.inference.report import Gain
from sil.inference.verdict import Judged, Verdict


@dataclass(frozen=True)
class Relative:
    """Relative errors of a channel (3.69, 3.70): mean and largest, shares of the maximum."""

    mean: float
    largest: float


@dataclass(frozen=True)
class Shown:
    """Residuals of a fit in figures.

    by_phase: channel -> phase -> standardised rms; relative: by channel; dependence: condition ->
    level -> rms; strokes: rms by file.
    """

    by_phase: dict[str, dict[str, float]]
    relative: dict[str, Relative]
    dependence: dict[str, dict[str, float]]
    strokes: dict[str, float]


CONDITIONS: dict[str, Callable[[StrokeConditions], str]] = {
    "supply": lambda c: f"{c.supply_pressure_pa / 1e5:.3g} bar",
    "stroke": lambda c: c.kind,
    "load": lambda c: c.load,
    "rest": lambda c: f"{c.rest_s:g} s",
    "charged": lambda c: "yes" if c.charged_before else "no",
}


def show(model: CampaignModel, fit: FitResult) -> Shown:
    """All figures of a fit's residuals."""
    by_phase: dict[str, dict[str, list[Floats]]] = {}
    errors: dict[str, list[tuple[float, float]]] = {}
    levels: dict[str, dict[str, list[Floats]]] = {name: {} for name in CONDITIONS}
    strokes: dict[str, float] = {}
    for k, block in fit.blocks.items():
        stroke = model.strokes[k]
        setup, states = model.here(k, fit.shared, fit.stroke[k], fit.candidates)
        phase = phases(stroke.time_s, states, setup)
        for channel, r in channel_parts(stroke, block.residual):
            table = by_phase.setdefault(channel.name, {})
            phase_of_row = phase[channel.rows]
            for index in np.unique(phase_of_row):
                table.setdefault(PHASES[index], []).append(r[phase_of_row == index])
            share = np.abs(r * channel.sd) / float(np.abs(channel.measured).max())
            errors.setdefault(channel.name, []).append((share.mean(), share.max()))
        residual = block.residual[: stroke.size]
        strokes[stroke.entry.file] = _rms([residual])
        for name, level in CONDITIONS.items():
            levels[name].setdefault(level(stroke.conditions), []).append(residual)
    return Shown(
        {
            name: {phase: _rms(table[phase]) for phase in PHASES if phase in table}
            for name, table in by_phase.items()
        },
        {
            name: Relative(float(np.mean(means)), float(np.max(largest)))
            for name, (means, largest) in ((n, zip(*v, strict=True)) for n, v in errors.items())
        },
        {
            name: {level: _rms(parts) for level, parts in sorted(table.items())}
            for name, table in levels.items()
            if len(table) > 1
        },
        strokes,
    )


def _rms(parts: Sequence[Floats]) -> float:
    values = np.concatenate(parts)
    return float(np.sqrt(np.mean(values**2))) if len(values) else 0.0


def _channel_rms(model: CampaignModel, fit: FitResult) -> dict[str, float]:
    parts: dict[str, list[Floats]] = {}
    for k, block in fit.blocks.items():
        stroke = model.strokes[k]
        for channel, part in channel_parts(stroke, block.residual):
            parts.setdefault(channel.name, []).append(part * channel.sd)
        if stroke.internal is not None:
            part = block.residual[stroke.size :] * stroke.internal.sd_m
            parts.setdefault("position_internal_m", []).append(part)
    return {name: _rms(residuals) for name, residuals in parts.items()}


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

"""Figures of residuals: by channel and phase, relative errors, dependence, gain on held-out strokes.

Relative errors after thesis 3.69/3.70: mean and maximum of |measured - simulated| over the largest
measured value; the window is the whole record.
Checked by: tests/unit/sil/inference/test_diagnose.py
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from plant.effects.stroke_conditions import StrokeConditions
from sil.campaign.campaign import Floats
from sil.inference.campaign.model import CampaignModel, channel_parts
from sil.inference.campaign.phases import PHASES, phases
from sil.inference.fit import FitResult
from sil.inference.verdict import Judged, Verdict


@dataclass(frozen=True)
class Relative:
    """Relative errors of a channel (3.69, 3.70): mean and largest, shares of the maximum."""

    mean: float
    largest: float


@dataclass(frozen=True)
class Shown:
    """Residuals of a fit in figures.

    by_phase: channel -> phase -> standardised rms; relative; whiteness: lag-one correlation of
    neighbouring samples; cross: correlation between channels; drift: change of a stroke's rms over
    the campaign, per stroke; dependence: condition -> level -> rms.
    """

    by_phase: dict[str, dict[str, float]]
    relative: dict[str, Relative]
    whiteness: dict[str, float]
    cross: dict[tuple[str, str], float]
    drift: float
    dependence: dict[str, dict[str, float]]
    strokes: dict[str, float]

    def largest_correlation(self) -> str:
        """Return the pair of channels with the largest correlation, in words."""
        if not self.cross:
            return ""
        one, two = max(self.cross, key=lambda pair: abs(self.cross[pair]))
        return f"{one} with {two} {self.cross[one, two]:+.2f}"


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
    cross: dict[tuple[str, str], list[tuple[float, int]]] = {}
    white: dict[str, list[float]] = {}
    errors: dict[str, list[tuple[float, float]]] = {}
    levels: dict[str, dict[str, list[Floats]]] = {name: {} for name in CONDITIONS}
    strokes: list[tuple[str, float]] = []
    for k, block in fit.blocks.items():
        stroke = model.strokes[k]
        setup, states = model.here(k, fit.shared, fit.stroke[k], fit.candidates)
        phase = phases(stroke.time_s, states, setup)
        observed: dict[str, Floats] = {}
        for channel, r in channel_parts(stroke, block.residual):
            name, phase_of_row = channel.name, phase[channel.rows]
            for index in np.unique(phase_of_row):
                table = by_phase.setdefault(name, {})
                table.setdefault(PHASES[index], []).append(r[phase_of_row == index])
            raw = np.abs(r * channel.sd)
            top = float(np.abs(channel.measured).max())
            errors.setdefault(name, []).append((raw.mean() / top, raw.max() / top))
            if len(r) > 10 and np.std(r) > 0.0:
                white.setdefault(name, []).append(_correlation(r[1:], r[:-1]))
            observed[name] = r
        for pair in itertools.combinations(observed, 2):
            one, two = (observed[name] for name in pair)
            if len(one) == len(two) > 10 and np.std(one) > 0.0:
                cross.setdefault(pair, []).append((_correlation(one, two), len(one)))
        joined = np.concatenate(list(observed.values())) if observed else np.zeros(0)
        strokes.append((stroke.entry.file, _rms(joined)))
        for name, level in CONDITIONS.items():
            levels[name].setdefault(level(stroke.conditions), []).append(joined)
    rows = [value for _file, value in strokes]
    return Shown(
        by_phase={
            name: {phase: _rms(np.concatenate(table[phase])) for phase in PHASES if phase in table}
            for name, table in by_phase.items()
        },
        relative={
            name: Relative(float(np.mean(means)), float(np.max(largest)))
            for name, (means, largest) in ((n, zip(*v, strict=True)) for n, v in errors.items())
        },
        whiteness={name: float(np.mean(values)) for name, values in white.items()},
        cross={
            pair: float(np.average([c for c, _n in values], weights=[n for _c, n in values]))
            for pair, values in cross.items()
        },
        drift=float(np.polyfit(np.arange(len(rows)), rows, 1)[0]) if len(rows) > 2 else 0.0,
        dependence={
            name: {level: _rms(np.concatenate(parts)) for level, parts in sorted(table.items())}
            for name, table in levels.items()
            if len(table) > 1
        },
        strokes=dict(strokes),
    )


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(values**2))) if len(values) else 0.0


def _correlation(one: Floats, two: Floats) -> float:
    return float(np.corrcoef(one, two)[0, 1])


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


def _channel_rms(model: CampaignModel, fit: FitResult) -> dict[str, float]:
    parts: dict[str, list[Floats]] = {}
    for k, block in fit.blocks.items():
        stroke = model.strokes[k]
        for channel, part in channel_parts(stroke, block.residual):
            parts.setdefault(channel.name, []).append(part * channel.sd)
        if stroke.internal is not None:
            part = block.residual[stroke.size :] * stroke.internal.sd_m
            parts.setdefault("position_internal_m", []).append(part)
    return {
        name: float(
            np.sqrt(sum(float(p @ p) for p in residuals) / max(1, sum(map(len, residuals))))
        )
        for name, residuals in parts.items()
    }


def gain_between(model: CampaignModel, verdict: Verdict[Judged], held_out: tuple[int, ...]) -> Gain:
    """Gain of the verdict's leader over the healthy model, each fitted to the training strokes."""
    before = verdict.healthy.held_out_fit or verdict.healthy.training
    after = verdict.leader.held_out_fit or verdict.leader.training
    first, second = _channel_rms(model, before), _channel_rms(model, after)
    return Gain(
        tuple(model.strokes[k].entry.file for k in held_out),
        {name: (first[name], second[name]) for name in first},
        verdict.healthy.misfit.rms,
        verdict.leader.misfit.rms,
    )

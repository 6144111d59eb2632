"""Figures of residuals: by channel and phase, relative errors, dependence, gain on held-out strokes.

Relative errors after thesis 3.69/3.70: mean and maximum of |measured - simulated| over the largest
measured value; the window is the whole record.
Checked by: tests/unit/sil/diagnosis/test_diagnose.py
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plant.effects.stroke_conditions import StrokeConditions
from sil.diagnosis.phases import PHASES, phases
from sil.diagnosis.verdict import Verdict
from sil.fitting.fit import FitResult
from sil.fitting.internal import INTERNAL_SD_M
from sil.fitting.model import CampaignModel, channel_parts

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Relative:
    """Relative errors of a channel (3.69, 3.70): mean and largest, shares of the maximum."""

    mean: float
    largest: float


@dataclass
class Shown:
    """Residuals of a fit in figures.

    by_phase: channel -> phase -> standardised rms; relative; whiteness: lag-one correlation of
    neighbouring samples; cross: correlation between channels; drift: change of a stroke's rms over
    the campaign, per stroke; dependence: condition -> level -> rms.
    """

    by_phase: dict[str, dict[str, float]] = field(default_factory=dict)
    relative: dict[str, Relative] = field(default_factory=dict)
    whiteness: dict[str, float] = field(default_factory=dict)
    cross: dict[tuple[str, str], float] = field(default_factory=dict)
    drift: float = 0.0
    dependence: dict[str, dict[str, float]] = field(default_factory=dict)
    strokes: dict[str, float] = field(default_factory=dict)

    def largest_correlation(self) -> str:
        """Return the pair of channels with the largest correlation, in words."""
        if not self.cross:
            return ""
        one, two = max(self.cross, key=lambda pair: abs(self.cross[pair]))
        return f"{one} with {two} {self.cross[one, two]:+.2f}"


def rms(values: Floats) -> float:
    """Root mean square; 0 of nothing.

    values: [n] in any unit.
    """
    return float(np.sqrt(np.mean(values**2))) if len(values) else 0.0


CONDITIONS: dict[str, Callable[[StrokeConditions], str]] = {
    "supply": lambda c: f"{c.supply_pressure_pa / 1e5:.3g} bar",
    "stroke": lambda c: c.kind,
    "load": lambda c: c.load,
    "rest": lambda c: f"{c.rest_s:g} s",
    "charged": lambda c: "yes" if c.charged_before else "no",
}


def show(model: CampaignModel, fit: FitResult) -> Shown:
    """All figures of a fit's residuals."""
    shown = Shown()
    phase_parts: dict[str, dict[str, list[Floats]]] = {}
    pairs: dict[tuple[str, str], list[tuple[float, int]]] = {}
    white: dict[str, list[float]] = {}
    errors: dict[str, list[tuple[float, float]]] = {}
    levels: dict[str, dict[str, list[Floats]]] = {name: {} for name in CONDITIONS}
    per_stroke = []
    for k in fit.blocks:
        stroke = model.strokes[k]
        setup = model.setup(k, model.amounts(fit.shared, fit.stroke[k]), fit.candidates, fit.values)
        phase = phases(stroke.time_s, stroke.predictor.states(setup), setup)
        whole = []
        observed: dict[str, Floats] = {}
        for channel, r in channel_parts(stroke, fit.blocks[k].residual):
            table = phase_parts.setdefault(channel.name, {})
            for index in np.unique(phase[channel.rows]):
                table.setdefault(PHASES[index], []).append(r[phase[channel.rows] == index])
            raw = np.abs(r * channel.sd)
            top = float(np.abs(channel.measured).max())
            errors.setdefault(channel.name, []).append((raw.mean() / top, raw.max() / top))
            if len(r) > 10 and np.std(r) > 0.0:
                white.setdefault(channel.name, []).append(float(np.corrcoef(r[1:], r[:-1])[0, 1]))
            observed[channel.name] = r
            whole.append(r)
        names = list(observed)
        for i, one in enumerate(names):
            for two in names[i + 1 :]:
                if len(observed[one]) == len(observed[two]) > 10 and np.std(observed[one]) > 0.0:
                    pairs.setdefault((one, two), []).append(
                        (float(np.corrcoef(observed[one], observed[two])[0, 1]), len(observed[one]))
                    )
        joined = np.concatenate(whole) if whole else np.zeros(0)
        shown.strokes[stroke.entry.file] = rms(joined)
        per_stroke.append(rms(joined))
        for name, level in CONDITIONS.items():
            levels[name].setdefault(level(stroke.conditions), []).append(joined)
    for name, table in phase_parts.items():
        shown.by_phase[name] = {
            phase: rms(np.concatenate(table[phase])) for phase in PHASES if phase in table
        }
    for name, values in errors.items():
        shown.relative[name] = Relative(
            float(np.mean([v[0] for v in values])), float(np.max([v[1] for v in values]))
        )
    shown.whiteness = {name: float(np.mean(values)) for name, values in white.items()}
    shown.cross = {
        pair: float(np.average([c for c, _n in values], weights=[n for _c, n in values]))
        for pair, values in pairs.items()
    }
    if len(per_stroke) > 2:
        shown.drift = float(np.polyfit(np.arange(len(per_stroke)), per_stroke, 1)[0])
    shown.dependence = {
        name: {level: rms(np.concatenate(parts)) for level, parts in sorted(table.items())}
        for name, table in levels.items()
        if len(table) > 1
    }
    return shown


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
            part = block.residual[stroke.size :] * INTERNAL_SD_M
            parts.setdefault("position_internal_m", []).append(part)
    return {
        name: float(np.sqrt(sum(float(p @ p) for p in own) / max(1, sum(map(len, own)))))
        for name, own in parts.items()
    }


def gain_between(model: CampaignModel, verdict: Verdict, held_out: tuple[int, ...]) -> Gain:
    """Gain of the verdict's leader over the healthy model, each fitted to the training strokes."""
    before = verdict.healthy.held or verdict.healthy.training
    after = verdict.leader.held or verdict.leader.training
    first, second = _channel_rms(model, before), _channel_rms(model, after)
    return Gain(
        tuple(model.strokes[k].entry.file for k in held_out),
        {name: (first[name], second[name]) for name in first},
        verdict.healthy.misfit.rms,
        verdict.leader.misfit.rms,
    )

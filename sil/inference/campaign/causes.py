"""Causes and gains as they are reported, with evidence in figures, and the extended model.

Checked by: tests/unit/sil/inference/test_diagnose.py
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from plant.parameters import Number, Parameter, ParameterSet
from sil.campaign.campaign import Campaign, Floats
from sil.files.quantity import counted
from sil.inference.campaign.model import CampaignModel, channel_parts
from sil.inference.campaign.observations import kind_of
from sil.inference.candidate import Candidate, form_of
from sil.inference.fit import FitResult, Fitter
from sil.inference.intervals import intervals
from sil.inference.report import Gain, Interval, ReportedCause, model_file
from sil.inference.thresholds import UNNAMED
from sil.inference.verdict import Judged, Verdict


def causes_of(
    fitter: Fitter, verdict: Verdict[Judged], judged: list[Judged], final: FitResult, workers: int
) -> list[ReportedCause]:
    """Return the leading causes, their rivals and what has no name, most probable first."""
    leader, profiled = verdict.leader, {}
    if final.candidates:
        profiled = intervals(fitter, final, leader.whole, workers)
    rows = [
        (c, profiled[c.name], _evidence(c, verdict, profiled[c.name])) for c in final.candidates
    ]
    unnamed = []
    for name, probability in verdict.probabilities.items():
        if name in verdict.claimed:
            continue
        item = next((i for i in judged if name in i.ids and i.probability > 0.0), None)
        if item is None:
            unnamed.append(_without_a_name(verdict, judged, probability))
            continue
        candidate = item.training.candidates[item.ids.index(name)]
        parameters = intervals(fitter, item.training, item.whole, 1, profile=False)[candidate.name]
        text = f"{item.name} leaves {item.misfit.rms:.3g} times the noise on held-out strokes"
        rows.append(
            (candidate, parameters, f"{text}; {leader.name} leaves {leader.misfit.rms:.3g}")
        )
    causes = [
        ReportedCause(
            c.id, c.cause_class, verdict.probabilities[c.id], parameters, text, c.variant, _what(c)
        )
        for c, parameters, text in rows
    ]
    gains = verdict.gains
    return sorted(
        causes + unnamed, key=lambda cause: (-cause.probability, -gains.get(cause.id, 0.0))
    )


def _what(candidate: Candidate) -> str:
    """Return what a cause is, of a term with the quantity that it depends on."""
    on = f", depending on {form_of(candidate).on}" if candidate.is_term else ""
    return f"{candidate.effect.what}{on}"


def _without_a_name(
    verdict: Verdict[Judged], judged: Sequence[Judged], probability: float
) -> ReportedCause:
    """Return what no hypothesis describes: in the equation of the best term, else by channel."""
    leader = verdict.leader
    channels = leader.whole.channels
    name = max(channels, key=lambda item: channels[item].rms)
    terms = [c for item in judged for c in item.training.candidates if c.is_term]
    if terms:
        kind, what = terms[0].cause_class, _what(terms[0])
    else:
        classes = {"position": "mechanics", "oil": "damper", "pressure": "flow restriction"}
        kind = "internal sensor" if name == "position_internal_m" else classes[kind_of(name)]
        what = f"in {name.rpartition('_')[0].replace('_', ' ')}"
    text = (
        f"the best hypothesis, {leader.name}, leaves {leader.whole.rms:.3g} times the noise, most in "
        f"{name} ({channels[name].rms:.3g})"
    )
    return ReportedCause(UNNAMED, kind, probability, {}, text, "", what)


def includes_neutral(candidate: Candidate, parameters: Mapping[str, Interval]) -> bool:
    """Return whether the intervals of a cause contain that nothing is wrong."""
    if candidate.is_term or candidate.effect.sized_by == "none":
        return False
    sizes = candidate.parameters[: None if candidate.effect.sized_by == "any" else 1]
    intervals_of = [(item.neutral, parameters[item.name]) for item in sizes]
    return all(interval.low <= neutral <= interval.high for neutral, interval in intervals_of)


def _evidence(
    candidate: Candidate, verdict: Verdict[Judged], parameters: Mapping[str, Interval]
) -> str:
    """Return what supports a leading cause, in figures."""
    if candidate.is_term:
        form = form_of(candidate)
        largest = max(abs(item.value) for item in parameters.values())
        what = f"{form.what} depending on {form.on}, up to {largest:.3g} {form.unit}"
    else:
        main = candidate.parameters[0].name
        where = f" ({candidate.variant})" if candidate.variant else ""
        what = f"{candidate.effect.what}{where}: {main} {parameters[main]}"
    return (
        f"{what}; it gains {verdict.gains[candidate.id]:.4g} in log evidence, and on held-out "
        f"strokes the standardised residual falls from {verdict.healthy.misfit.rms:.3g} to "
        f"{verdict.leader.misfit.rms:.3g}"
    )


def extended_model(
    parameters: ParameterSet, final: FitResult, causes: Sequence[ReportedCause], campaign: Campaign
) -> str:
    """Return the text of extended_model.toml: [base] and one [effect.<id>] for each claimed cause."""
    source = f"diagnosed from campaign {campaign.name}, {counted(len(campaign.strokes), 'stroke')}"
    claimed = {item.id for item in final.candidates}
    tables = {f"effect.{n}": dict(t) for n, t in parameters.effects.items() if n not in claimed}
    reported = {(cause.id, cause.variant): cause.parameters for cause in causes}
    for candidate in final.candidates:
        items = reported[(candidate.id, candidate.variant)].items()
        if candidate.is_term:
            form = form_of(candidate)
            origin = f"{source}: {form.what} of {form.on} [{form.unit}], class {form.cause_class}"
            rows: dict[str, Number] = {
                "equation": float(form.slot),
                "variable": float(form.over),
                "low": form.low,
                "step": form.step,
                "nodes": tuple(item.value for _name, item in items),
            }
            table = {name: Parameter(value, "-", origin) for name, value in rows.items()}
        else:
            origin = f"{source}, 95 % interval"
            table = {n: Parameter(i.value, i.unit, origin, i.low, i.high) for n, i in items}
            units = {p.name: p.unit for p in candidate.effect.parameters}
            origin = f"variant {candidate.variant}"
            for name, value in candidate.fixed.items():
                table[name] = Parameter(float(value), units[name], origin)
        tables[f"effect.{candidate.id}"] = table
    comment = f"the model {parameters.name} extended by what campaign {campaign.name} shows"
    return model_file(comment, parameters.name, tables)


@dataclass(frozen=True)
class Relative:
    """|measured - simulated| over the largest measured value (3.69, 3.70): mean of all strokes, and largest."""

    mean: float
    largest: float


def relative_errors(model: CampaignModel, fit: FitResult) -> dict[str, Relative]:
    """Return the relative errors of each channel over whole records."""
    errors: dict[str, list[Floats]] = {}
    for k, block in fit.blocks.items():
        for channel, r in channel_parts(model.strokes[k], block.residual):
            share = np.abs(r * channel.sd) / float(np.abs(channel.measured).max())
            errors.setdefault(channel.name, []).append(share)
    return {
        name: Relative(float(np.mean([s.mean() for s in shares])), float(max(map(np.max, shares))))
        for name, shares in errors.items()
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

"""Causes as they are reported: parameters, one sentence of evidence, and the extended model.

Checked by: tests/unit/sil/inference/test_diagnose.py
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from plant.parameters import Number, Parameter, ParameterSet
from sil.campaign.campaign import Campaign
from sil.files.quantity import counted
from sil.inference.campaign.terms import form_of
from sil.inference.candidate import Candidate
from sil.inference.fit import FitResult, Fitter
from sil.inference.intervals import intervals
from sil.inference.model_file import model_file
from sil.inference.report import Cause, Interval
from sil.inference.verdict import Judged, Verdict


def causes_of(
    fitter: Fitter, verdict: Verdict[Judged], judged: list[Judged], final: FitResult, workers: int
) -> list[Cause]:
    """Return the claimed causes and their rivals with parameters, most probable first."""
    if not verdict.claimed:
        return []
    causes = []

    def add(candidate: Candidate, parameters: dict[str, Interval], evidence: str) -> None:
        probability = verdict.probabilities[candidate.id]
        kind = candidate.cause_class
        causes.append(
            Cause(
                candidate.id,
                kind,
                probability,
                parameters,
                evidence,
                candidate.variant,
                candidate.effect.what,
            )
        )

    intervals_by_name = intervals(fitter, final, verdict.leader.whole, workers)
    for candidate in final.candidates:
        parameters = intervals_by_name[candidate.name]
        add(candidate, parameters, sentence(candidate, verdict, judged, parameters))
    for name in verdict.probabilities:
        if name in verdict.claimed:
            continue
        item = next(i for i in judged if name in i.ids)
        candidate = item.training.candidates[item.ids.index(name)]
        parameters = intervals(fitter, item.training, item.whole, 1, profile=False)[candidate.name]
        behind = item.score - verdict.leader.score
        add(
            candidate,
            parameters,
            f"{item.name} is {behind:.1f} behind in log evidence",
        )
    gains = verdict.gains
    return sorted(causes, key=lambda cause: (-cause.probability, -gains.get(cause.id, 0.0)))


def sentence(
    candidate: Candidate,
    verdict: Verdict[Judged],
    judged: Sequence[Judged],
    parameters: Mapping[str, Interval],
) -> str:
    """Return what supports the cause, and how far the next best explanation is behind."""
    if candidate.is_term:
        form = form_of(candidate)
        largest = max(abs(item.value) for item in parameters.values())
        what = (
            f"{form.what} depending on {form.on}, up to {largest:.3g} {form.unit}, which no "
            f"named cause describes"
        )
    else:
        main = candidate.parameters[0].name
        where = f" ({candidate.variant})" if candidate.variant else ""
        what = f"{candidate.effect.what}{where}: {main} {parameters[main]}"
    text = (
        f"{what}; it gains {verdict.gains[candidate.id]:.4g} in log evidence, and on held-out "
        f"strokes the standardised residual falls from {verdict.healthy.misfit.rms:.3g} to "
        f"{verdict.leader.misfit.rms:.3g}"
    )
    others = [item for item in judged if candidate.id not in item.ids and item.ids]
    if others:
        best = min(others, key=lambda item: item.score)
        behind = best.score - verdict.leader.score
        text += f"; the next best explanation, {best.name}, is {behind:.0f} behind"
    return text


def extended_model(
    parameters: ParameterSet, final: FitResult, causes: Sequence[Cause], campaign: Campaign
) -> str:
    """Return the text of extended_model.toml: [base] and one [effect.<id>] for each claimed cause."""
    source = f"diagnosed from campaign {campaign.name}, {counted(len(campaign.strokes), 'stroke')}"
    claimed = {item.id for item in final.candidates}
    tables = {
        f"effect.{name}": dict(table)
        for name, table in parameters.effects.items()
        if name not in claimed
    }
    reported = {(cause.id, cause.variant): cause.parameters for cause in causes}
    for candidate in final.candidates:
        cause_parameters = reported[(candidate.id, candidate.variant)]
        if candidate.is_term:
            form = form_of(candidate)
            origin = f"{source}: {form.what} of {form.on} [{form.unit}], class {form.cause_class}"
            rows: dict[str, Number] = {
                "equation": float(form.slot),
                "variable": float(form.over),
                "low": form.low,
                "step": form.step,
                "nodes": tuple(item.value for item in cause_parameters.values()),
            }
            table = {name: Parameter(value, "-", origin) for name, value in rows.items()}
        else:
            origin = f"{source}, 95 % interval"
            table = {
                name: Parameter(item.value, item.unit, origin, item.low, item.high)
                for name, item in cause_parameters.items()
            }
            units = {p.name: p.unit for p in candidate.effect.parameters}
            origin = f"variant {candidate.variant}"
            for name, value in candidate.fixed.items():
                table[name] = Parameter(float(value), units[name], origin)
        tables[f"effect.{candidate.id}"] = table
    comment = f"the model {parameters.name} extended by what campaign {campaign.name} shows"
    return model_file(comment, parameters.name, tables)

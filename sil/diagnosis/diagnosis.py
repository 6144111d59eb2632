"""`diagnose`: from a campaign to what is wrong, why, what the extended model is and what it gains.

Checked by: tests/unit/sil/diagnosis/test_diagnose.py
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from can_dbc.errors import InputError
from plant.effects.effect import Need
from plant.errors import IntegrationError
from plant.kernel.layout import LENGTH
from plant.parameters import ParameterSet
from sil.campaign.campaign import Campaign, Record
from sil.diagnosis.checks import (
    SATURATED,
    SWAPPED,
    Finding,
    check_record,
    check_signals,
    check_strokes,
)
from sil.diagnosis.evidence import Cause, sentence
from sil.diagnosis.extend import extended_model
from sil.diagnosis.gain import Gain, gain_between
from sil.diagnosis.intervals import intervals
from sil.diagnosis.judge import Judged, judge, weigh
from sil.diagnosis.next_experiment import NextExperiment, next_experiment
from sil.diagnosis.search import Found, Search
from sil.diagnosis.split import odd_ones_in, split
from sil.diagnosis.structure import Structure, structure_of
from sil.diagnosis.terms import try_terms
from sil.diagnosis.verdict import Verdict, acceptable, decide
from sil.diagnosis.workers import Show, no_progress
from sil.fitting.fit import FitResult, Fitter
from sil.fitting.floor import misfit
from sil.fitting.hypotheses import Candidate, candidates
from sil.fitting.model import CampaignModel
from sil.fitting.nuisance import Spread
from sil.fitting.observations import StrokeObservation, observe

FALSE_ALARM_LEVEL = 0.01
FALSE_ALARM_BASIS = (
    "a cause must gain max(15, 1.5 a stroke) in log evidence and gain on held-out strokes too; how "
    "often clean campaigns of an independent implementation pass that is measured by "
    "python -m tests.bench hidden_effects"
)


@dataclass
class Diagnosis:
    """Everything found out about a campaign; `as_json` is what diagnosis.json holds."""

    campaign: Campaign
    parameters: ParameterSet
    verdict: Verdict
    causes: list[Cause]
    gain: Gain
    extended: str | None
    next_experiment: NextExperiment | None
    structure: Structure
    findings: list[Finding]
    model: CampaignModel
    training: tuple[int, ...]
    held_out: tuple[int, ...]
    judged: list[Judged]
    final: FitResult
    healthy: FitResult
    seconds: dict[str, float] = field(default_factory=dict)

    def as_json(self) -> dict[str, Any]:
        """Return the object written to diagnosis.json."""
        return {
            "format": 1,
            "campaign": self.campaign.name,
            "verdict": self.verdict.kind,
            "causes": [
                {
                    "id": cause.id,
                    "class": cause.cause_class,
                    "probability": round(cause.probability, 4),
                    "parameters": {
                        name: {
                            "value": item.value,
                            "low": item.low,
                            "high": item.high,
                            "unit": item.unit,
                        }
                        for name, item in cause.parameters.items()
                    },
                    "evidence": cause.evidence,
                }
                for cause in self.causes
            ],
            "rivals": [list(group) for group in self.verdict.rivals],
            "next_experiment": None
            if self.next_experiment is None
            else self.next_experiment.as_json(),
            "gain": self.gain.as_json(),
            "false_alarm": {"level": FALSE_ALARM_LEVEL, "basis": FALSE_ALARM_BASIS},
            "extended_model": None if self.extended is None else "extended_model.toml",
            "findings": [str(item) for item in self.findings],
            "detectability": self.structure.sentence(),
        }


def diagnose(
    campaign: Campaign,
    parameters: ParameterSet,
    *,
    workers: int = 2,
    progress: Show = no_progress,
) -> Diagnosis:
    """Diagnose a campaign of the project's own rigs.

    parameters: the model that is questioned. progress(done, size): called from time to time.
    Deterministic; the same with any number of workers.

    Raises
    ------
    InputError : a campaign that cannot be read or compared, named in one line
    """
    clock = Stopwatch()
    strokes, findings = observed(campaign, parameters)
    model = CampaignModel(strokes, Spread.of(parameters))
    structure = structure_of(strokes)
    clock.lap("read")
    training, held_out = placed(model)
    search = Search(model, available(strokes), training, workers, progress)
    try:
        found = search.run()
    except IntegrationError as error:
        raise InputError(
            f"{campaign.folder}: the nominal model cannot follow this campaign: {error}"
        ) from None
    clock.lap("search")
    search.stages.until(85.0)
    judged = judged_hypotheses(search, found, held_out, workers)
    verdict = decide(judged, len(strokes))
    clock.lap("judge")
    search.stages.until(95.0)
    if try_terms(search, found, verdict, judged):
        judged = judged_hypotheses(search, found, held_out, workers)
        verdict = decide(judged, len(strokes))
    clock.lap("terms")
    healthy = whole_fit(search.fitter, verdict.healthy)
    final = healthy if not verdict.claimed else whole_fit(search.fitter, verdict.leader)
    gain = gain_between(model, verdict, held_out)
    causes = reported(model, search.fitter, verdict, judged, final, gain, workers)
    extended = extended_model(parameters, final, causes, campaign) if verdict.claimed else None
    following = next_experiment(model, verdict, judged)
    findings += check_strokes(model, final)
    clock.lap("report")
    return Diagnosis(
        campaign,
        parameters,
        verdict,
        causes,
        gain,
        extended,
        following,
        structure,
        findings,
        model,
        training,
        held_out,
        judged,
        final,
        healthy,
        clock.laps,
    )


class Stopwatch:
    """Wall time by stage."""

    def __init__(self) -> None:
        self.laps: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, name: str) -> None:
        """Book the time since the last lap."""
        now = time.perf_counter()
        self.laps[name] = self.laps.get(name, 0.0) + now - self._last
        self._last = now


def observed(
    campaign: Campaign, parameters: ParameterSet
) -> tuple[list[StrokeObservation], list[Finding]]:
    """Strokes read and checked; what was odd about them but usable.

    Raises InputError if no stroke has a position or a pressure.
    """
    strokes = []
    findings: list[Finding] = []
    clipped: dict[str, set[str]] = {}
    for entry in campaign.strokes:
        record = campaign.record(entry)
        odd = check_record(entry, record, parameters)
        clipped[entry.file] = {item.channel for item in odd if item.text.startswith(SATURATED)}
        findings += odd
        strokes.append(observe(entry, record, parameters, clipped[entry.file]))
    odd, shifts = check_signals(strokes)
    findings += odd
    for k, entry in enumerate(campaign.strokes):
        dead = {
            name
            for item in odd
            if item.file == entry.file and SWAPPED in item.text
            for name in item.channel.split(", ")
        }
        if dead or k in shifts:
            record = moved(campaign.record(entry), shifts.get(k, 0.0))
            strokes[k] = observe(entry, record, parameters, clipped[entry.file], dead)
    if not any(stroke.channels or stroke.internal for stroke in strokes):
        raise InputError(f"{campaign.folder}: no position and no pressure in any stroke")
    return strokes, findings


def placed(model: CampaignModel) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Return training and held-out strokes, some that look odd among the training ones."""
    training, held_out = split(model.strokes)
    if not held_out:
        return training, held_out
    fitter = Fitter(model)
    try:
        healthy = fitter.fit(use=training, iterations=8)
    except IntegrationError:  # which the search reports
        return training, held_out
    if misfit(model, healthy).beyond > 0.0:
        return training, held_out
    judged = next(iter(judge(fitter, [healthy], held_out)), None)
    if judged is None or judged.held is None or judged.misfit.beyond == 0.0:
        return training, held_out
    blocks = {**healthy.blocks, **judged.held.blocks}
    squares = {k: float(np.mean(block.residual**2)) for k, block in blocks.items()}
    return odd_ones_in(training, held_out, squares, model.strokes)


def moved(record: Record, shift_s: float) -> Record:
    """Return a record with a shift of its time base taken off; at rest before it begins."""
    time_s = record.time_s
    k = round(shift_s / float(np.median(np.diff(time_s))))
    columns = dict(record.columns)
    for name, values in record.columns.items():
        if name == "time_s":
            columns[name] = values[: len(values) - max(k, 0)]
        elif k >= 0:
            columns[name] = values[k:]
        else:
            columns[name] = np.concatenate([np.full(-k, values[0]), values[:k]])
    return Record(record.path, columns)


def available(strokes: Sequence[StrokeObservation]) -> list[Candidate]:
    """Candidates that these strokes can show."""
    has: dict[Need, bool] = {
        "damper": any(stroke.conditions.load == "damper" for stroke in strokes),
        "internal position": any(stroke.internal is not None for stroke in strokes),
        "length stroke": any(stroke.conditions.system == LENGTH for stroke in strokes),
    }
    return candidates({need for need, present in has.items() if present})


def judged_hypotheses(
    search: Search, found: Found, held_out: tuple[int, ...], workers: int
) -> list[Judged]:
    """Held-out judgement of the healthy fit and of the best acceptable ones."""
    chosen = [found.healthy, *found.of_size(1)[:8], *found.of_size(2)[:8], *found.of_size(3)[:2]]
    judged = judge(search.fitter, chosen, held_out, workers)
    accepted = [item for item in judged if acceptable(item)]
    weigh(accepted)
    return accepted


def whole_fit(fitter: Fitter, item: Judged) -> FitResult:
    """Return the hypothesis fitted to all strokes, from where the training left it."""
    stroke = item.training.stroke.copy()
    if item.held is not None:
        indices = list(item.held.use)
        stroke[indices] = item.held.stroke[indices]
    return fitter.fit(
        item.training.candidates,
        start=item.training.shared,
        scatter=stroke,
        iterations=8,
        fine=True,
    )


def reported(
    model: CampaignModel,
    fitter: Fitter,
    verdict: Verdict,
    judged: list[Judged],
    final: FitResult,
    gain: Gain,
    workers: int,
) -> list[Cause]:
    """Claimed causes and their rivals with parameters, most probable first."""
    if not verdict.claimed:
        return []
    causes = []
    own = intervals(fitter, final, verdict.leader.whole, workers)
    for candidate in final.candidates:
        causes.append(
            Cause(
                candidate.id,
                candidate.cause_class,
                verdict.probabilities[candidate.id],
                own[candidate.name],
                sentence(candidate, verdict, judged, gain, own[candidate.name]),
                candidate.variant,
            )
        )
    for name, probability in verdict.probabilities.items():
        if name in verdict.claimed:
            continue
        item = next(i for i in judged if name in i.ids)
        index = item.ids.index(name)
        candidate = item.training.candidates[index]
        theirs = intervals(fitter, item.training, item.whole, 1, profile=False)[candidate.name]
        behind = item.score - verdict.leader.score
        causes.append(
            Cause(
                name,
                candidate.cause_class,
                probability,
                theirs,
                f"cannot be told apart: {item.name} is {behind:.1f} behind in log evidence",
                candidate.variant,
            )
        )
    gains = verdict.gains
    return sorted(causes, key=lambda cause: (-cause.probability, -gains.get(cause.id, 0.0)))

"""`diagnose`: from a campaign to what is wrong, why, what the extended model is and what it gains.

Checked by: tests/unit/sil/inference/test_diagnose.py
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from can_dbc.errors import InputError
from plant.effects.effect import Need
from plant.effects.term import FORMS
from plant.errors import IntegrationError
from plant.kernel.layout import LENGTH
from plant.parameters import ParameterSet
from sil.campaign.campaign import Campaign
from sil.files.quantity import html_table
from sil.inference.campaign.causes import causes_of, extended_model, gain_between, includes_neutral
from sil.inference.campaign.checks import Finding, check_strokes, observed
from sil.inference.campaign.model import CampaignModel, model_of
from sil.inference.campaign.next_experiment import NextExperiment, next_experiment
from sil.inference.campaign.observations import StrokeObservation
from sil.inference.campaign.split import odd_ones_in, split
from sil.inference.candidate import Candidate, candidates, term_candidate
from sil.inference.evidence import misfit
from sil.inference.fit import FitResult, Fitter, Refusals, Show, no_progress
from sil.inference.report import Gain, ReportedCause, diagnosis_json, headline, seen_sentence
from sil.inference.screening import DetectableSize, detectable, screen
from sil.inference.search import Search
from sil.inference.spread import Spread
from sil.inference.thresholds import LIMITS
from sil.inference.verdict import Conclusion, Judged, Verdict, decide, judge, kind_of
from sil.inference.workers import spread_out

FALSE_ALARM_BASIS = (
    "a cause must gain max(15, 1.5 a stroke) in log evidence and gain on held-out strokes too; how "
    "often clean campaigns of an independent implementation pass that is measured by "
    "python -m tests.bench hidden_effects"
)


@dataclass
class Diagnosis:
    """Everything found out about a campaign; `as_json` is what diagnosis.json holds."""

    campaign: Campaign
    verdict: Verdict[Judged]
    causes: list[ReportedCause]
    gain: Gain
    extended: str | None
    next_experiment: NextExperiment | None
    findings: list[Finding]
    model: CampaignModel
    held_out: tuple[int, ...]
    judged: list[Judged]
    final: FitResult
    healthy: FitResult
    detectable: list[DetectableSize]
    unable: str
    refusals: Refusals

    @property
    def headline(self) -> str:
        """The one sentence that a reader needs first."""
        parameters = [(item, item.candidate.parameters[0]) for item in self.detectable]
        sizes = [(i.candidate.id, i.value, p.neutral, p.unit) for i, p in parameters]
        return headline(self.verdict.kind, self.causes, seen_sentence(sizes), self.unable)

    def as_json(self) -> dict[str, Any]:
        """Return the object written to diagnosis.json."""
        return diagnosis_json(
            self.campaign.name,
            self.verdict.kind,
            self.causes,
            self.findings,
            FALSE_ALARM_BASIS,
            headline=self.headline,
            explains=str(self.gain),
            hypotheses=[
                {"causes": list(ids), "probability": p} for ids, p in self.verdict.hypotheses
            ],
            rivals=[list(group) for group in self.verdict.rivals],
            next_experiment=self.next_experiment and self.next_experiment.as_json(),
            gain=self.gain.as_json(),
            extended_model=None if self.extended is None else "extended_model.toml",
            detectable=[item.as_json() for item in self.detectable],
        )

    def _repr_html_(self) -> str:
        rows = ((c.id, f"{c.probability:.2f}", c.evidence) for c in self.causes)
        title = f"{self.campaign.name}: {self.verdict.kind}"
        return html_table(title, ("cause", "probability", "evidence"), rows)


def diagnose(
    campaign: Campaign,
    parameters: ParameterSet,
    *,
    workers: int = 2,
    progress: Show = no_progress,
    plan: bool = False,
) -> Diagnosis:
    """Diagnose a campaign of the project's own rigs.

    parameters: the model to compare with. progress(done, size): called from time to time. plan: say
    what to measure next even if nothing is left to separate. Deterministic; the same with any
    number of workers.

    Raises
    ------
    InputError : a campaign that cannot be read or compared, named in one line
    """
    strokes, findings = observed(campaign, parameters)
    progress(0.0, 100.0)  # not before a bad campaign is refused: that is one line
    model = model_of(strokes, Spread.of(parameters))
    training, held_out = _assigned(model)
    causes_tried, terms = available(strokes), list(map(term_candidate, FORMS))
    search = Search(model, causes_tried, training, held_out, terms, workers, progress)
    try:
        verdict = search.run()
    except IntegrationError as error:
        what = "the nominal model cannot follow this campaign"
        raise InputError(f"{campaign.folder}: {what}: {error}") from None
    judged = search.judged
    # what follows counts in the processes that it runs in
    refusals = Refusals(search.fitter.refusals)
    leading = [verdict.leader] if verdict.claimed else []
    healthy, *claimed = _whole_fits(search.fitter, [verdict.healthy, *leading], workers)
    while True:
        (final,) = claimed or [healthy]
        causes = causes_of(search.fitter, verdict, judged, final, workers)
        tables = {(cause.id, cause.variant): cause.parameters for cause in causes}
        if not verdict.claimed or not any(
            includes_neutral(item, tables[item.id, item.variant]) for item in final.candidates
        ):
            break
        judged = [item for item in judged if item is not verdict.leader]
        verdict = decide(judged, model.size)
        claimed = _whole_fits(search.fitter, [verdict.leader] if verdict.claimed else [], 1)
    findings += check_strokes(model, final) + left_out(refusals, search, verdict, campaign.name)
    gain = LIMITS.needed_gain(len(strokes)) * len(search.sample) / len(strokes)
    fit, scores = search.healthy, search.scores
    if verdict.claimed:
        fit = search.refine(verdict.leader.training, 0)
        scores = search.unseen_beside(verdict.leader.training)
    elif not scores:
        scores = screen(search.fitter, fit, causes_tried)
    fit = replace(fit, blocks={k: fit.blocks[k] for k in search.sample})
    sizes = detectable(search.fitter, fit, scores, gain, workers)
    unable = _unable(sizes, search) if verdict.kind == "consistent" else ""
    if unable:
        verdict = replace(verdict, kind=kind_of(Conclusion({}, undecidable=unable)))
        findings.insert(0, Finding(campaign.name, "all", unable))
    hidden: list[Candidate] = []
    if plan or unable:  # the first variant of each cause
        hidden = list({item.id: item for item in reversed(search.candidates)}.values())[::-1]
    following = next_experiment(
        model, parameters, campaign, verdict, judged, hidden, confirm=plan, workers=workers
    )
    return Diagnosis(
        campaign,
        verdict,
        causes,
        gain_between(model, verdict, held_out),
        extended_model(parameters, final, causes, campaign) if verdict.claimed else None,
        following,
        findings,
        model,
        held_out,
        judged,
        final,
        healthy,
        sizes,
        unable,
        refusals,
    )


def left_out(
    refusals: Refusals, search: Search, verdict: Verdict[Judged], campaign: str
) -> list[Finding]:
    """Return what could not be simulated of the leading causes, and what was not judged therefore.

    That is a cause without any value, and a better explanation that was given up on held-out strokes.
    """
    done = {c.id for fit in [*search.first, *search.fits.values()] for c in fit.candidates}
    scored = {score.candidate.id for score in search.scores}
    leading = {*verdict.claimed, *verdict.probabilities}
    best = verdict.leader.training.evidence()
    findings = []
    for name, tried in refusals.items():
        alone = tried.ids[0] if len(tried.ids) == 1 else ""
        never = alone and alone not in done and (tried.lost or alone not in scored)
        better = tried.lost and name in search.fits and search.fits[name].evidence() < best
        if (never and (tried.lost or tried.refused)) or better:
            findings.append(Finding(campaign, name, f"not judged: {tried}"))
        elif tried.refused and tried.ids and leading.issuperset(tried.ids):
            findings.append(Finding(campaign, name, str(tried)))
    return findings


def _unable(sizes: Sequence[DetectableSize], search: Search) -> str:
    """Return why nothing can be concluded from a campaign in which nothing is found, or nothing."""
    causes = {item.id for item in search.candidates}
    noticed = sum(item.typical_sizes < 1.0 for item in sizes)
    if not search.scores or noticed >= LIMITS.min_noticeable_share * len(causes):
        return ""
    return (
        f"{noticed} of {len(causes)} causes would be noticed at their typical size: more strokes, "
        "gauges, a higher sampling rate or less noise would help"
    )


def _assigned(model: CampaignModel) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Return training and held-out strokes, some that look odd among the training ones."""
    training, held_out = split(model.strokes)
    if not held_out:
        return training, held_out
    fitter = Fitter(model)
    try:
        healthy = fitter.fit(use=training, iterations=8)
    except IntegrationError:  # which the search reports
        return training, held_out
    judged = [] if misfit(model, healthy).beyond > 0.0 else judge(fitter, [healthy], held_out)
    if not judged or judged[0].misfit.beyond == 0.0:
        return training, held_out
    blocks = judged[0].both.blocks
    squares = {k: float(np.mean(block.residual**2)) for k, block in blocks.items()}
    return odd_ones_in(training, held_out, squares, model.strokes)


def available(strokes: Sequence[StrokeObservation]) -> list[Candidate]:
    """Candidates that these strokes can show."""
    has: dict[Need, Callable[[StrokeObservation], bool]] = {
        "damper": lambda stroke: stroke.conditions.load == "damper",
        "internal position": lambda stroke: stroke.internal is not None,
        "length stroke": lambda stroke: stroke.conditions.system == LENGTH,
        "process exponents": lambda stroke: stroke.setup.p.air_kappa == 0.0,
    }
    return candidates({need for need, shows in has.items() if any(map(shows, strokes))})


def _whole_fits(fitter: Fitter, items: Sequence[Judged], workers: int) -> list[FitResult]:
    """Return hypotheses fitted to all strokes, from where the training left them."""

    def whole(item: Judged) -> FitResult:
        fit, scatter = item.training, item.both.stroke
        options: dict[str, Any] = {"start": fit.shared, "scatter": scatter, "iterations": 8}
        return fitter.fit(fit.candidates, **options, fine=True).light()

    return spread_out(whole, items, workers)

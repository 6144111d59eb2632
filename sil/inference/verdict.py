"""From fitted hypotheses to a verdict: which causes are claimed, how surely, and against what.

A hypothesis is scored by its evidence on the training strokes (Laplace) plus its cost on the
held-out ones, where only the strokes' own scatter may be fitted.  As long as the best of them
leaves a misfit that noise does not explain, score differences overstate what is known: then the
model error has an unknown size, and marginalising over that turns the exponential into a power,

    p_i ~ prior_i (1 + 2 (score_i - floor) / nu)^(-nu / 2),

Student's form with nu effective observations; it is exp(-score) again once the misfit is nil.

A cause is claimed only if its sign is physical, its interval excludes nothing-there, leaving it out
costs more than chance would (on training and on held-out strokes alike), and no look-alike does as
well; look-alikes that do are named as rivals.
Checked by: tests/unit/sil/inference/test_verdict.py
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Generic, Protocol, TypeVar

import numpy as np

from plant.errors import IntegrationError
from sil.inference.candidate import Candidate
from sil.inference.evidence import Misfit, misfit
from sil.inference.fit import FitResult, Fitter
from sil.inference.problem import Floats
from sil.inference.thresholds import LIMITS, UNNAMED, Thresholds
from sil.inference.workers import fitted


class Explanation(Protocol):
    """What a verdict needs of a hypothesis that all strokes have judged.

    score: cost, lower is better, in log evidence; held_cost: the part on held-out strokes (None: all
    of it is); whole: the fit against its floor.
    """

    probability: float

    @property
    def ids(self) -> tuple[str, ...]:
        """Identifiers of its causes."""

    @property
    def score(self) -> float:
        """Cost in log evidence."""

    @property
    def held_cost(self) -> float | None:
        """Cost on held-out strokes alone."""
        return None

    @property
    def whole(self) -> Misfit:
        """Misfit over all strokes."""

    @property
    def slight(self) -> tuple[str, ...]:
        """Causes that are tiny and not alone."""
        return ()


E = TypeVar("E", bound=Explanation)


@dataclass
class Judged:
    """A hypothesis judged by all strokes.

    training, held_out_fit: fits; both: the training one with the held-out strokes; score: evidence/2 on the
    training plus cost on the held-out strokes; misfit: over the held-out strokes (over the training
    ones if none are held out); whole: over all.
    """

    training: FitResult
    held_out_fit: FitResult | None
    both: FitResult
    score: float
    misfit: Misfit
    whole: Misfit
    probability: float = 0.0

    @property
    def name(self) -> str:
        """Name of the hypothesis."""
        return self.training.name

    @property
    def ids(self) -> tuple[str, ...]:
        """Identifiers of its causes."""
        return tuple(item.id for item in self.training.candidates)

    @property
    def held_cost(self) -> float | None:
        """Cost on held-out strokes alone."""
        return None if self.held_out_fit is None else 0.5 * self.held_out_fit.chi2

    @property
    def slight(self) -> tuple[str, ...]:
        """Causes that are tiny and not alone."""
        return slight_causes(self)


HeldOutFits = dict[str, tuple[FitResult, FitResult | None]]
"""Fits by name, and what the held-out strokes made of them: None if they cannot be simulated."""


def judge(
    fitter: Fitter,
    fits: Sequence[FitResult],
    held_out: Sequence[int],
    workers: int = 1,
    evaluated: HeldOutFits | None = None,
) -> list[Judged]:
    """Held-out evaluation of fits, best score first.

    known: earlier evaluations, which are not repeated; new ones are added.
    """
    evaluated = {} if evaluated is None else evaluated
    model = fitter.model
    # offsets of gauges that no training stroke has: held-out ones determine them
    training = set(range(model.size)) - set(held_out)
    trained = {name for k in training for name in model.offsets_in(k)}
    names = enumerate(model.offsets, start=len(model.unit))
    free = {k for k, name in names if name not in trained}

    def work(fit: FitResult) -> FitResult | None:
        frozen = [k for k in range(len(fit.shared)) if k not in free]
        try:
            return fitter.fit(
                fit.candidates, start=fit.shared, use=held_out, iterations=4, freeze=frozen
            ).light()
        except IntegrationError as error:
            fitter.refusals.lose(fit.candidates, error)
            return None

    judged = []
    new = [
        f for f in fits if held_out and (f.name not in evaluated or evaluated[f.name][0] is not f)
    ]
    for fit, answer in zip(new, fitted(fitter, work, new, workers), strict=True):
        evaluated[fit.name] = fit, answer
    for fit in fits:
        held_out_fit = evaluated[fit.name][1] if held_out else None
        if held_out and held_out_fit is None:
            continue
        score, both = 0.5 * fit.evidence(), fit
        score -= sum(math.log(item.prior) for item in fit.candidates)
        if held_out_fit is not None:
            # the priors of the shared parameters are counted once, with the training strokes
            score += 0.5 * held_out_fit.chi2
            blocks = {**fit.blocks, **held_out_fit.blocks}
            stroke = fit.stroke.copy()
            stroke[list(held_out)] = held_out_fit.stroke[list(held_out)]
            both = replace(fit, use=tuple(sorted(blocks)), stroke=stroke, blocks=blocks)
        held_out_misfit, whole = misfit(model, held_out_fit or fit), misfit(model, both)
        judged.append(Judged(fit, held_out_fit, both, score, held_out_misfit, whole))
    judged.sort(key=lambda item: item.score)
    weigh(judged)
    return judged


def weigh(judged: Sequence[Explanation]) -> None:
    """Fill in the probabilities of competing hypotheses."""
    if not judged:
        return
    leader = min(judged, key=lambda item: item.score)
    error = 0.5 * leader.whole.beyond
    nu = LIMITS.effective_observations
    logs = np.array(
        [
            np.log(LIMITS.pair_prior if len(item.ids) > 1 else 1.0)
            - 0.5 * nu * np.log1p(2.0 * (item.score - leader.score + error) / nu)
            for item in judged
        ]
    )
    weights = np.exp(logs - logs.max())
    weights /= weights.sum()
    for item, weight in zip(judged, weights, strict=True):
        item.probability = float(weight)


def by_cause(judged: Sequence[Explanation]) -> dict[str, float]:
    """Probability of each cause: of all hypotheses it takes part in."""
    total: dict[str, float] = {}
    for item in judged:
        for name in item.ids:
            total[name] = total.get(name, 0.0) + item.probability
    return dict(sorted(total.items(), key=lambda entry: -entry[1]))


@dataclass
class Verdict(Generic[E]):
    """What is concluded, before figures are put to it.

    leader: the accepted hypothesis; claimed: its causes that are claimed; probabilities: of
    every cause at least LIMITS.min_rival_probability probable; gains: score lost by leaving a claimed cause out.
    """

    kind: str
    leader: E
    healthy: E
    claimed: tuple[str, ...] = ()
    probabilities: dict[str, float] = field(default_factory=dict)
    gains: dict[str, float] = field(default_factory=dict)
    rivals: tuple[tuple[str, ...], ...] = ()


def _sizes_of(fit: FitResult, of: Floats) -> Iterator[tuple[Candidate, dict[str, float], float]]:
    """Yield each named cause of a fit, its values, and the size of its main parameter in `of` [own]."""
    k = 0
    for candidate, parameters in zip(fit.candidates, fit.values, strict=True):
        count = len(candidate.parameters)
        main = count if candidate.effect.sized_by == "any" else 1
        if not candidate.is_term:
            yield candidate, parameters, float(np.abs(of[k : k + main]).max())
        k += count


def acceptable(item: Judged) -> bool:
    """Return whether a hypothesis' main parameters have physical signs and exclude neutral."""
    fit = item.training
    effects = fit.layout.effect_slice
    deviation = np.diag(fit.covariance)[effects] ** 0.5
    sizes = _sizes_of(fit, fit.scaled / deviation)
    return all(
        candidate.physical(values) and size >= LIMITS.min_deviations
        for candidate, values, size in sizes
    )


def _gains_of(leader: E, judged: Sequence[E], name: str) -> tuple[float, float]:
    """Return what leaving a cause out loses: score, and cost on the held-out strokes alone."""
    rest = set(leader.ids) - {name}
    without = min((i for i in judged if set(i.ids) <= rest), key=lambda item: item.score)
    gain = without.score - leader.score
    if leader.held_cost is None or without.held_cost is None:
        return gain, gain
    return gain, without.held_cost - leader.held_cost


@dataclass(frozen=True)
class Conclusion:
    """What a verdict is decided from: the probabilities of the claimed causes, and what forbids them.

    undecidable: why nothing can be concluded, empty if something can; unexplained: noise does not
    explain what the claimed causes leave, and they depend on how that is described.
    """

    claimed: Mapping[str, float]
    undecidable: str = ""
    unexplained: bool = False
    has_rivals: bool = False


def _nothing_named_explains(one: Conclusion, limits: Thresholds) -> bool:
    surest = max(one.claimed.values(), default=0.0)
    share = one.claimed.get(UNNAMED, 0.0)
    return one.unexplained or share >= max(0.5, surest - 1e-9)


def _a_cause_is_in_doubt(one: Conclusion, limits: Thresholds) -> bool:
    return one.has_rivals or min(one.claimed.values()) < limits.min_named_probability


RULES: tuple[tuple[Callable[[Conclusion, Thresholds], bool], str], ...] = (
    (lambda one, limits: bool(one.undecidable), "cannot_tell"),
    (lambda one, limits: not one.claimed and not one.unexplained, "consistent"),
    (_nothing_named_explains, UNNAMED),
    (_a_cause_is_in_doubt, "ambiguous"),
    (lambda one, limits: True, "named"),
)
"""The verdict is that of the first rule that holds."""


def kind_of(one: Conclusion, limits: Thresholds = LIMITS) -> str:
    """Return the verdict: consistent, named, ambiguous, unnamed or cannot_tell."""
    return next(kind for holds, kind in RULES if holds(one, limits))


def decide(judged: Sequence[E], blocks: int) -> Verdict[E]:
    """Return the verdict on judged hypotheses (the healthy one among them; weighed already)."""
    healthy = next(item for item in judged if not item.ids)
    accepted = (item for item in judged if _is_accepted(item, healthy, judged, blocks))
    leader = min(accepted, key=lambda item: item.score, default=healthy)
    if not leader.ids:
        return Verdict(kind_of(Conclusion({})), healthy, healthy)
    probabilities = by_cause(judged)
    groups = _rivals_of(leader, judged, probabilities)
    most = _surest_of(leader, healthy)
    stated = {
        name: p if name == UNNAMED else min(p, most)
        for name, p in probabilities.items()
        if name in leader.ids
        or (p >= LIMITS.min_rival_probability and any(name in group for group in groups))
    }
    if leader.whole.beyond > 0.0:
        for name in leader.slight:
            stated[name] = min(stated[name], LIMITS.max_doubted_probability)
    if UNNAMED in leader.ids:
        stated[UNNAMED] = min(max(stated[UNNAMED], 1.0 - most), LIMITS.max_probability)
    conclusion = Conclusion({name: stated[name] for name in leader.ids})
    gains = {name: _gains_of(leader, judged, name)[0] for name in leader.ids}
    return Verdict(kind_of(conclusion), leader, healthy, leader.ids, stated, gains, groups)


def _is_accepted(item: E, healthy: E, judged: Sequence[E], blocks: int) -> bool:
    """Return whether a hypothesis explains enough, and each of its causes gains enough."""
    most = LIMITS.max_unexplained_share * healthy.whole.excess
    if item.whole.excess > most and item.whole.rms > LIMITS.max_residual_ratio:
        return not item.ids
    needed = LIMITS.needed_gain(blocks)
    if len(item.ids) > 1:
        inexact = 0.5 * LIMITS.form_error**2 * healthy.whole.excess
        needed = max(needed, 0.5 * LIMITS.min_share_of_rest * item.whole.beyond, inexact)
    for name in item.ids:
        gain, held_out_gain = _gains_of(item, judged, name)
        if gain < needed or held_out_gain <= 0.0:
            return False
        slight = 0.5 * LIMITS.min_slight_share * healthy.whole.excess
        if gain < slight and name in item.slight:
            return False
    return True


def _surest_of(leader: Explanation, healthy: Explanation) -> float:
    """Most that a named cause of the leader can be given, by what the leader leaves unexplained.

    A right cause of a slightly other form leaves a small share; next to a non-parametric term a
    named cause may be no more than a stepping stone.
    """
    if UNNAMED in leader.ids:
        return LIMITS.max_doubted_probability
    left = leader.whole.beyond / max(healthy.whole.excess, 1e-9)
    if leader.whole.beyond <= leader.whole.detail or left <= LIMITS.doubt_from_share:
        return LIMITS.max_probability
    doubt = min(
        1.0,
        np.log(left / LIMITS.doubt_from_share)
        / np.log(LIMITS.doubt_to_share / LIMITS.doubt_from_share),
    )
    return float(
        LIMITS.max_probability - (LIMITS.max_probability - LIMITS.max_doubted_probability) * doubt
    )


def slight_causes(item: Judged) -> tuple[str, ...]:
    """Return the causes that are tiny and not alone."""
    if len(item.ids) < 2:
        return ()
    return tuple(
        candidate.id
        for candidate, _values, size in _sizes_of(item.training, item.training.scaled)
        if candidate.effect.sized_by != "none" and size < LIMITS.slight_size
    )


def _rivals_of(
    leader: Explanation, judged: Sequence[Explanation], probabilities: dict[str, float]
) -> tuple[tuple[str, ...], ...]:
    """Return groups that the data cannot distinguish: each claimed cause with what may replace it."""
    groups = []
    least = LIMITS.min_contest_share * max(item.probability for item in judged)
    for name in leader.ids:
        rest = set(leader.ids) - {name}
        group = {name}
        for item in judged:
            if name not in item.ids and item.probability >= least:
                group |= {
                    other
                    for other in set(item.ids) - rest
                    if probabilities[other] >= LIMITS.min_rival_probability
                }
        if len(group) > 1:
            groups.append(tuple(sorted(group, key=lambda n: -probabilities[n])))
    return tuple(dict.fromkeys(groups))

"""From fitted hypotheses to a verdict: which causes are claimed, how surely, and against what.

The hypotheses are one normalised set: healthy, every cause and pair that is accepted, and something
without a name. A hypothesis is scored by its evidence on the training strokes (Laplace) plus its cost
on the held-out ones. As long as the best leaves a misfit that noise does not explain, the model's error
has an unknown size; marginalising over that turns the exponential into a power,

    p_i ~ prior_i (1 + 2 (score_i - floor) / nu)^(-nu / 2).

What has no name explains as much as the best hypothesis, and the share s of the healthy misfit that this
leaves: its odds against it are unnamed_prior (1 + s / form_share)^form_power. A right cause of slightly
another form leaves a small share. The probability of a cause is the sum over the hypotheses with it.
Checked by: tests/unit/sil/inference/test_verdict.py
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Generic, Protocol, TypeVar

import numpy as np

from sil.inference.candidate import Candidate
from sil.inference.evidence import Misfit, inexact_squares, misfit, strained
from sil.inference.fit import FitResult, Fitter
from sil.inference.problem import Floats
from sil.inference.thresholds import LIMITS, UNNAMED, Thresholds
from sil.inference.workers import fitted


class Explanation(Protocol):
    """What a verdict needs of a hypothesis that all strokes have judged."""

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

    @property
    def inexact(self) -> Mapping[str, float]:
        """Squares that errors of its causes' forms may leave, by channel, where a form is a guess."""
        return {}

    @property
    def is_explained(self) -> bool:
        """Whether noise explains what it leaves."""
        return self.whole.is_noise

    @property
    def shared_with_unnamed(self) -> float:
        """Probability that its causes act if something without a name does."""
        return LIMITS.pair_prior


E = TypeVar("E", bound=Explanation)


@dataclass
class Judged:
    """A hypothesis judged by all strokes.

    training, held_out_fit: fits; both: the two in one; score: evidence/2 on the training plus cost on the
    held-out strokes; misfit: over the held-out strokes, the training ones without any; whole: over all;
    inexact: see `Explanation`.
    """

    training: FitResult
    held_out_fit: FitResult | None
    both: FitResult
    score: float
    misfit: Misfit
    whole: Misfit
    inexact: Mapping[str, float] = field(default_factory=dict)
    probability: float = 0.0
    shared_with_unnamed: float = LIMITS.pair_prior

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

    @property
    def is_explained(self) -> bool:
        """Whether noise explains what it leaves, with ordinary tolerances and scatter."""
        return self.whole.is_noise and not strained(self.training)


HeldOutFits = dict[str, tuple[FitResult, FitResult | None]]
"""Fits by name, and what the held-out strokes made of them: None if they cannot be simulated."""


def judge(
    fitter: Fitter,
    fits: Sequence[FitResult],
    held_out: Sequence[int],
    workers: int = 1,
    evaluated: HeldOutFits | None = None,
) -> list[Judged]:
    """Held-out evaluation of fits, best score first; `evaluated`: earlier ones, to which new ones are added."""
    evaluated = {} if evaluated is None else evaluated
    model = fitter.model
    # offsets of gauges that no training stroke has: held-out ones determine them
    training = set(range(model.size)) - set(held_out)
    trained = {name for k in training for name in model.offsets_in(k)}
    names = enumerate(model.offsets, start=len(model.unit))
    free = {k for k, name in names if name not in trained}

    def work(fit: FitResult) -> FitResult | None:
        frozen = [k for k in range(len(fit.shared)) if k not in free]
        return fitter.attempt(
            fit.candidates, start=fit.shared, use=held_out, iterations=4, freeze=frozen
        )

    new = [f for f in fits if held_out and evaluated.get(f.name, (None,))[0] is not f]
    for fit, answer in zip(new, fitted(fitter, work, new, workers), strict=True):
        evaluated[fit.name] = fit, answer
    judged = []
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
        misfits = misfit(model, held_out_fit or fit), misfit(model, both)
        errors = inexact_squares(model, both)
        judged.append(Judged(fit, held_out_fit, both, score, *misfits, errors))
    return sorted(judged, key=lambda item: item.score)


def weigh(
    hypotheses: Sequence[Explanation], healthy: Explanation
) -> list[tuple[tuple[str, ...], float]]:
    """Return the probability of every hypothesis by its causes, and store it there; they sum to 1.

    Besides the hypotheses, the healthy one among them, something without a name may act: alone, or
    with the causes of the best one.
    """
    leader = min(hypotheses, key=lambda item: item.score)
    error = 0.5 * leader.whole.beyond
    nu = LIMITS.effective_observations
    behind = np.array([item.score - leader.score + error for item in hypotheses])
    priors = [LIMITS.pair_prior if len(item.ids) > 1 else 1.0 for item in hypotheses]
    weights = np.log(priors) - 0.5 * nu * np.log1p(2.0 * behind / nu)
    weights = np.exp(weights - weights.max())
    unnamed = LIMITS.unnamed_odds(_unexplained_share(leader, healthy))
    if UNNAMED in leader.ids and len(leader.ids) > 1:
        unnamed = LIMITS.unnamed_odds_beside_a_term
    unnamed *= weights[[item is leader for item in hypotheses].index(True)]
    rows = []
    for item, weight in zip(hypotheses, weights, strict=True):
        # a tiny cause may correct the form of the other one, while something is left
        slight = item.slight if item.whole.beyond > 0.0 else ()
        acts = LIMITS.slight_cause_probability if slight else 1.0
        rows.append((item.ids, acts * weight))
        rows.append((tuple(name for name in item.ids if name not in slight), (1.0 - acts) * weight))
    shared = leader.shared_with_unnamed if leader.ids and UNNAMED not in leader.ids else 0.0
    rows += [((UNNAMED,), (1.0 - shared) * unnamed), ((*leader.ids, UNNAMED), shared * unnamed)]
    total = sum(weight for _ids, weight in rows)
    for item, weight in zip(hypotheses, weights, strict=True):
        item.probability = float(weight / total)
    return [(ids, float(weight / total)) for ids, weight in rows if weight > 0.0]


def _unexplained_share(item: Explanation, healthy: Explanation) -> float:
    """Return the share of the healthy misfit that a hypothesis leaves, beyond noise and details."""
    whole = item.whole
    is_noise = not item.ids and whole.rms <= LIMITS.max_residual_ratio
    if whole.beyond <= whole.detail or is_noise:
        return 0.0
    return whole.beyond / max(healthy.whole.excess, 1e-9)


def by_cause(hypotheses: Iterable[tuple[tuple[str, ...], float]]) -> dict[str, float]:
    """Return the probability of each cause: of all hypotheses that it takes part in."""
    total: dict[str, float] = {}
    for ids, probability in hypotheses:
        for name in dict.fromkeys(ids):
            total[name] = total.get(name, 0.0) + probability
    return dict(sorted(total.items(), key=lambda entry: -entry[1]))


@dataclass
class Verdict(Generic[E]):
    """What is concluded, before figures are put to it.

    leader: the hypothesis that explains best; claimed: its causes; probabilities: of these, their rivals
    and `unnamed`; hypotheses: causes and probability of each; gains: score lost without a claimed cause.
    """

    kind: str
    leader: E
    healthy: E
    claimed: tuple[str, ...] = ()
    probabilities: dict[str, float] = field(default_factory=dict)
    hypotheses: list[tuple[tuple[str, ...], float]] = field(default_factory=list)
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
    deviation = np.diag(fit.covariance)[fit.layout.effect_slice] ** 0.5
    return all(
        candidate.physical(values) and size >= LIMITS.min_deviations
        for candidate, values, size in _sizes_of(fit, fit.scaled / deviation)
    )


def _without(leader: E, judged: Sequence[E], name: str) -> E:
    """Return the best hypothesis of a leader's other causes."""
    rest = set(leader.ids) - {name}
    return min((i for i in judged if set(i.ids) <= rest), key=lambda item: item.score)


def _gains_of(leader: E, judged: Sequence[E], name: str) -> tuple[float, float]:
    """Return what leaving a cause out loses: score, and cost on the held-out strokes alone."""
    without = _without(leader, judged, name)
    gain = without.score - leader.score
    if leader.held_cost is None or without.held_cost is None:
        return gain, gain
    return gain, without.held_cost - leader.held_cost


@dataclass(frozen=True)
class Conclusion:
    """What a verdict is decided from: probabilities of the leading causes and that something unnamed acts.

    undecidable: why nothing can be concluded, empty if something can.
    """

    claimed: Mapping[str, float]
    unnamed: float = 0.0
    undecidable: str = ""
    has_rivals: bool = False


def _nothing_named_explains(one: Conclusion, limits: Thresholds) -> bool:
    surest = max((p for name, p in one.claimed.items() if name != UNNAMED), default=0.0)
    return one.unnamed >= 0.5 and surest < limits.min_named_probability


RULES: tuple[tuple[Callable[[Conclusion, Thresholds], bool], str], ...] = (
    (lambda one, limits: bool(one.undecidable), "cannot_tell"),
    (_nothing_named_explains, UNNAMED),
    (lambda one, limits: not one.claimed, "consistent"),
    (lambda one, limits: one.has_rivals, "ambiguous"),
    (lambda one, limits: min(one.claimed.values()) < limits.min_named_probability, "ambiguous"),
    (lambda one, limits: True, "named"),
)
"""The verdict is that of the first rule that holds."""


def kind_of(one: Conclusion, limits: Thresholds = LIMITS) -> str:
    """Return the verdict: consistent, named, ambiguous, unnamed or cannot_tell."""
    return next(kind for holds, kind in RULES if holds(one, limits))


def decide(judged: Sequence[E], blocks: int) -> Verdict[E]:
    """Return the verdict on judged hypotheses, the healthy one among them, and weigh them.

    A hypothesis that is not accepted has no probability; none is where the healthy one explains the data.
    """
    healthy = next(item for item in judged if not item.ids)
    hypotheses = [healthy]
    if not healthy.is_explained:
        hypotheses += [i for i in judged if i.ids and _is_accepted(i, healthy, judged, blocks)]
    for item in judged:
        item.probability = 0.0
    leader = min(hypotheses, key=lambda item: item.score)
    weighed = weigh(hypotheses, healthy)
    probabilities = by_cause(weighed)
    groups = _rivals_of(leader, hypotheses, probabilities)
    rivals = {UNNAMED, *(name for group in groups for name in group)}
    stated = {
        name: p
        for name, p in probabilities.items()
        if name in leader.ids or (p >= LIMITS.min_rival_probability and name in rivals)
    }
    claimed = {name: stated[name] for name in leader.ids}
    unnamed = probabilities.get(UNNAMED, 0.0)
    kind = kind_of(Conclusion(claimed, unnamed, has_rivals=bool(groups)))
    gains = {name: _gains_of(leader, judged, name)[0] for name in leader.ids}
    return Verdict(kind, leader, healthy, leader.ids, stated, weighed, gains, groups)


def _is_accepted(item: E, healthy: E, judged: Sequence[E], blocks: int) -> bool:
    """Return whether a hypothesis explains enough, and each of its causes gains enough."""
    most = LIMITS.max_unexplained_share * healthy.whole.excess
    if item.whole.excess > most and item.whole.rms > LIMITS.max_residual_ratio:
        return False
    needed = LIMITS.needed_gain(blocks)
    if len(item.ids) > 1:
        needed = max(needed, 0.5 * LIMITS.min_share_of_rest * item.whole.beyond)
    inexact = 0.5 * LIMITS.form_error**2 * healthy.whole.excess if len(item.ids) > 1 else 0.0
    for name in item.ids:
        gain, held_out_gain = _gains_of(item, judged, name)
        without = _without(item, judged, name)
        form = sum(min(s, without.whole.channels[c].excess) for c, s in without.inexact.items())
        if gain < max(needed, inexact) + 0.5 * form or held_out_gain <= 0.0:
            return False
        slight = 0.5 * LIMITS.min_slight_share * healthy.whole.excess
        if gain < slight and name in item.slight:
            return False
    return True


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
    leader: Explanation, hypotheses: Sequence[Explanation], probabilities: dict[str, float]
) -> tuple[tuple[str, ...], ...]:
    """Return groups that the data cannot distinguish: each claimed cause with what may replace it."""
    groups = []
    least = LIMITS.min_contest_share * max(item.probability for item in hypotheses)
    for name in leader.ids:
        rest = set(leader.ids) - {name}
        group = {name}
        for item in hypotheses:
            if name not in item.ids and item.probability >= least:
                group |= {
                    other
                    for other in set(item.ids) - rest
                    if probabilities[other] >= LIMITS.min_rival_probability
                }
        if len(group) > 1:
            groups.append(tuple(sorted(group, key=lambda n: -probabilities[n])))
    return tuple(dict.fromkeys(groups))

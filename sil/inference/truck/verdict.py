"""From fitted hypotheses to a verdict on a truck: how probable each is, and what can be concluded.

The hypotheses are one normalised set: a healthy truck, each cause, and something without a name, whose
odds follow from the noise that the best one leaves, as for campaigns. Between causes differences in
evidence, of each the mean over its variants, count a third: fits end in one of many minima, and what the
model of a truck gets wrong repeats from shift to shift. What all of them have against a healthy truck is their evidence as it is.
Checked by: tests/unit/sil/inference/truck/test_verdict.py
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from sil.files.quantity import counted
from sil.inference.thresholds import LIMITS, UNNAMED
from sil.inference.truck.causes import Cause
from sil.inference.truck.fit import FAR_SD, Fit, Fitter
from sil.inference.verdict import Conclusion, kind_of
from sil.inference.workers import spread_out
from sil.log_replay.recorded_shifts import BETWEEN_GEARS

TEMPER: Final = 1.0 / 3.0
"""Share of a difference in evidence that counts between causes."""
MIN_SHIFTS: Final = 3
"""Shifts from which on a cause is named, and from which on a truck is judged at all unless one failed."""
REPEATED: Final = 2
"""Shifts in which a deviation repeats."""


@dataclass(frozen=True)
class Hypothesis:
    """A fit with its probability; interval: of its size at 95 %, in typical ones, if it is reported."""

    fit: Fit
    probability: float = 0.0
    interval: tuple[float, float] | None = None

    @property
    def excludes_neutral(self) -> bool:
        """Whether the interval of its size does."""
        return self.interval is not None and not self.interval[0] <= 0.0 <= self.interval[1]


@dataclass(frozen=True)
class Verdict:
    """What is concluded of a truck: the kind, the causes reported, probabilities by id, and why."""

    kind: str
    hypotheses: tuple[Hypothesis, ...]
    probabilities: dict[str, float]
    causes: tuple[Hypothesis, ...]
    findings: tuple[str, ...]

    @property
    def healthy(self) -> Hypothesis:
        """The hypothesis without a cause."""
        return next(item for item in self.hypotheses if item.fit.cause is None)

    @property
    def best(self) -> Hypothesis:
        """The most probable hypothesis."""
        return self.hypotheses[0]


def weighed(
    fits: Sequence[Fit], causes: Sequence[Cause], fitters: dict[bool, Fitter], failed: int = 0
) -> tuple[list[Hypothesis], float]:
    """Return the best fit of each hypothesis with its probability, the likeliest first, and that of none of them.

    causes: all that are offered; failed: shifts that did not reach their gear.
    """
    best: dict[str, Fit] = {}
    for fit in sorted(fits, key=lambda fit: -fit.evidence):
        best.setdefault(fit.name, fit)
    variants = Counter(cause.id for cause in causes)
    healthy = LIMITS.healthy_prior * LIMITS.failing_healthy_odds ** min(failed, 1)
    priors = [
        healthy
        if f.cause is None
        else (1.0 - LIMITS.healthy_prior) / len(variants) / variants[f.id]
        for f in best.values()
    ]
    kept = list(best.values())
    evidence = np.array([f.evidence for f in kept])
    weights = np.array(priors) * np.exp(evidence - evidence.max())
    wrong = np.array([f.cause is not None for f in kept])
    if wrong.any():
        alone = np.log(priors) + evidence
        alike = np.array([[f.id == other.id for other in kept] for f in kept])
        of_cause = np.logaddexp.reduce(np.where(alike, alone, -np.inf), axis=1)
        gentle = (alone + (TEMPER - 1.0) * of_cause)[wrong]
        gentle = np.exp(gentle - gentle.max())
        weights[wrong] = weights[wrong].sum() * gentle / gentle.sum()
    leader = int(np.argmax(weights))
    unnamed = LIMITS.unnamed_odds(_unexplained_share(kept[leader], best["healthy"], fitters))
    unnamed *= weights[leader]
    total = weights.sum() + unnamed
    hypotheses = [Hypothesis(fit, float(w / total)) for fit, w in zip(kept, weights, strict=True)]
    return sorted(hypotheses, key=lambda item: -item.probability), float(unnamed / total)


def _unexplained_share(leader: Fit, healthy: Fit, fitters: dict[bool, Fitter]) -> float:
    """Return the share of the healthy misfit that the leading hypothesis leaves.

    In chi squared, if that is more than noise everywhere; in cost, if it is some deviations that repeat.
    """
    if leader.noise_factor > LIMITS.max_residual_ratio:
        left, whole = (fit.noise_factor**2 - 1.0 for fit in (leader, healthy))
    elif fitters[leader.mounted].deviating(leader) >= REPEATED:
        left, whole = (fitters[fit.mounted].misfit_cost(fit) for fit in (leader, healthy))
    else:
        return 0.0
    return left / max(left, whole)


def by_id(hypotheses: Sequence[Hypothesis], unnamed: float) -> dict[str, float]:
    """Return the probability of each effect, of a healthy truck, and of something without a name."""
    total: dict[str, float] = {UNNAMED: unnamed}
    for item in hypotheses:
        total[item.fit.id] = total.get(item.fit.id, 0.0) + item.probability
    return dict(sorted(total.items(), key=lambda entry: -entry[1]))


def reported(hypotheses: Sequence[Hypothesis], probabilities: dict[str, float]) -> list[Hypothesis]:
    """Return the best hypothesis of each cause that is probable enough to be reported."""
    likeliest = max(
        (p for name, p in probabilities.items() if name in _causes(hypotheses)), default=0.0
    )
    # of many causes that are alike, none may reach the usual share
    least = min(LIMITS.min_rival_probability, 0.5 * likeliest)
    first: dict[str, Hypothesis] = {}
    for item in hypotheses:
        if item.fit.cause is not None and probabilities[item.fit.id] >= least:
            first.setdefault(item.fit.id, item)
    return sorted(first.values(), key=lambda item: -probabilities[item.fit.id])


def _causes(hypotheses: Sequence[Hypothesis]) -> set[str]:
    return {item.fit.id for item in hypotheses if item.fit.cause is not None}


def _interval(fit: Fit, fits: Sequence[Fit], fitters: dict[bool, Fitter]) -> tuple[float, float]:
    """Return the 95 % interval of a fit's size, with the minima that are hardly worse."""
    low, high = fitters[fit.mounted].profile(fit)
    within = fit.cost + 2.0 / TEMPER  # 2 for 95 %
    sizes = [other.size for other in fits if other.name == fit.name and other.cost <= within]
    return min(low, *sizes), max(high, *sizes)


def decide(
    fits: Sequence[Fit],
    causes: Sequence[Cause],
    fitters: dict[bool, Fitter],
    failed: int,
    workers: int = 1,
    astray: int = 0,
) -> Verdict:
    """Return the verdict on fitted hypotheses; failed: shifts that did not reach their gear; astray: others that began out of any."""
    hypotheses, unnamed = weighed(fits, causes, fitters, failed + astray)
    probabilities = by_id(hypotheses, unnamed)
    healthy = next(item.fit for item in hypotheses if item.fit.cause is None)
    far = fitters[healthy.mounted].deviating(healthy)
    sound = probabilities["healthy"]
    is_wrong = failed + astray > 0 or far >= REPEATED or sound <= LIMITS.max_healthy_probability
    claims = reported(hypotheses, probabilities) if is_wrong and hypotheses[1:] else []
    claims = spread_out(
        lambda c: replace(c, interval=_interval(c.fit, fits, fitters)), claims, workers
    )
    if claims and not claims[0].excludes_neutral:
        claims = []
    claims = [claim for claim in claims if claim.excludes_neutral]
    findings: list[str] = []
    doubt = ""
    if failed:
        findings.append(f"{counted(failed, 'shift')} did not reach the gear commanded")
    if astray:
        findings.append(f"{counted(astray, 'shift')} {BETWEEN_GEARS}")
    if far >= REPEATED:
        findings.append(
            f"a healthy truck is off by more than {FAR_SD:g} sd in {counted(far, 'shift')}"
        )
    count = len(fitters[healthy.mounted].model)
    if claims and count < MIN_SHIFTS:
        findings.append(f"{counted(count, 'shift')} cannot tell one cause from another")
        claims = []
    if is_wrong and (not claims or sound >= LIMITS.min_healthy_probability):
        unnamed, claims = 1.0, []
        if not findings:
            findings.append(f"a healthy truck is {sound:.2g} probable, and no cause has a size")
    elif not is_wrong and sound < LIMITS.min_healthy_probability:
        shown = ", ".join(f"{name} {p:.2f}" for name, p in probabilities.items() if p > 0.05)
        doubt = f"too much for a healthy truck, too little for an alarm: {shown}"
        findings.append(doubt)
    conclusion = Conclusion(
        {claims[0].fit.id: probabilities[claims[0].fit.id]} if claims else {},
        unnamed,
        doubt,
    )
    kind = kind_of(conclusion)
    if kind == "named":
        claims = claims[:1]
    elif kind == UNNAMED:
        claims = []
    return Verdict(kind, tuple(hypotheses), probabilities, tuple(claims), tuple(findings))

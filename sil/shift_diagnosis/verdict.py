"""The verdict on fitted hypotheses: which cause, how sure, and what would not have been noticed.

Checked by: tests/unit/sil/shift_diagnosis/test_verdict.py, test_diagnose_logs.py
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from math import exp, log, log1p
from typing import Final

import numpy as np

from sil.files.quantity import counted
from sil.inference.thresholds import LIMITS, UNNAMED
from sil.shift_diagnosis.fit import Fit
from sil.shift_diagnosis.linear import (
    SIZE_PRIOR,
    Floats,
    Linear,
    Noise,
    hidden_cost,
    projected,
)
from sil.shift_diagnosis.model import Cause
from sil.shift_diagnosis.shifts import RecordedShift

HEALTHY_PRIOR: Final = 0.5
EFFECTIVE: Final = 4.0
"""Effective observations of the error that a fit's minimum has, in log evidence between causes."""
MINIMUM: Final = 2.0
"""Log evidence by which equally good minima differ."""
REPEATED: Final = 30
"""Shifts from which on more of them separate two causes no better: what the model of a truck gets
wrong is the same in each."""
ALARM: Final = 0.01
"""Probability of a healthy truck below which something is claimed to be wrong."""
CERTAIN: Final = 0.8
"""Probability from which a cause is named."""
EXPLAINED: Final = 1.5
"""Chi squared per number up to which noise explains the rest."""
SEPARABLE: Final = 9.0
"""Chi squared by which two causes must differ to count as separable: three standard deviations."""
LARGEST: Final = 10.0
"""Size up to which another cause is tried, in typical ones: three deviations of a size's prior."""
STRANGE: Final = 3.0
"""Deviation of a truck's own quantity that is not called healthy without doubt."""
DOUBTED: Final = 0.2
"""Probability of a healthy truck below which a search goes on."""
CONSISTENT: Final = 0.5
"""Probability of a healthy truck below which it is not called consistent."""
SPREAD: Final = 0.1
"""Probability of all causes that are not reported from which it is stated."""
SCANNED: Final[Floats] = 0.05 * 1.15 ** np.arange(50.0)
"""Sizes that are tried for being noticed, in typical ones."""
NOTICED: Final = 1.28
"""Standard deviations of the evidence for 90 % certainty to notice."""


@dataclass(frozen=True)
class Judged:
    """A hypothesis over all shifts: evidence with both priors, and how probable it is.

    chi2: per compared number. minima: sizes at which fits from other starts ended, about as good.
    """

    fit: Fit
    cost: float
    chi2: float
    minima: tuple[float, ...] = ()
    probability: float = 0.0

    @classmethod
    def of(cls, fit: Fit) -> Judged:
        """Return the hypothesis of a fit to all shifts."""
        count = max(1, int(fit.linear.count.sum()) - fit.linear.units)
        return cls(fit, fit.cost, float(fit.linear.misfit.sum()) / count)

    @property
    def name(self) -> str:
        """Name of the cause."""
        return self.fit.cause.name if self.fit.cause else "healthy"

    @property
    def id(self) -> str:
        """Id of the cause's effect."""
        return self.fit.cause.effect.id if self.fit.cause else "healthy"

    @property
    def size(self) -> tuple[float, float]:
        """Size of the cause and its standard deviation, in typical sizes."""
        estimate, variance = self.fit.estimate[-1], self.fit.covariance[-1, -1]
        spread = np.mean([(size - estimate) ** 2 for size in self.minima]) if self.minima else 0.0
        return float(estimate), float(np.sqrt(variance * max(1.0, self.chi2) + spread))


@dataclass(frozen=True)
class Detectable:
    """What the bus shows of a cause: the smallest size it would show, and what looks the same.

    size: in typical ones, noticed in nine of ten trucks; None: at no size. alike: ids of causes, of
    any physical size up to LARGEST, that cannot be distinguished from it at its size or the typical
    one, whichever is larger; none if it would be noticed at no size.
    """

    cause: Cause
    size: float | None
    alike: tuple[str, ...]

    @property
    def value(self) -> float | None:
        """The size in the unit of the cause's parameter."""
        return None if self.size is None else self.cause.value(self.size)


@dataclass(frozen=True)
class ShiftDiagnosis:
    """All that was found of the shifts of one truck."""

    verdict: str
    shifts: tuple[RecordedShift, ...]
    judged: tuple[Judged, ...]
    probabilities: dict[str, float]
    detectable: tuple[Detectable, ...]
    mounted: bool
    noise: Noise
    findings: tuple[str, ...]
    priors: dict[str, float]

    @property
    def healthy(self) -> Judged:
        """The hypothesis without a cause."""
        return next(item for item in self.judged if item.fit.cause is None)

    @property
    def best(self) -> Judged:
        """The most probable hypothesis."""
        return self.judged[0]

    @property
    def named(self) -> list[Judged]:
        """The causes reported: the one named, or all that cannot be excluded."""
        if self.verdict not in ("named", "ambiguous"):
            return []
        wrong = {name: p for name, p in self.probabilities.items() if name != "healthy"}
        least = CERTAIN if self.verdict == "named" else _least_reported(wrong)
        found: dict[str, Judged] = {}
        for item in self.judged:
            if wrong.get(item.id, 0.0) >= least:
                found.setdefault(item.id, item)
        return list(found.values())


def _least_reported(wrong: Mapping[str, float]) -> float:
    """Return the probability from which a cause is reported, of those that cannot be distinguished."""
    # of many causes that are alike, none may reach the usual share
    return min(LIMITS.min_rival_probability, 0.5 * max(wrong.values()))


def weighed(
    judged: Sequence[Judged], ids: int, unsure: Mapping[str, float] | None = None
) -> list[Judged]:
    """Return the hypotheses with their probabilities, the most probable first.

    A cause that is behind another counts by Student's form: their fits end in one of many minima,
    and the differences between truck and model repeat from shift to shift. What all causes together
    have against a healthy truck is their evidence as it is. ids: how many effects are offered.
    unsure: of some effects, by their id, log evidence below which being behind decides nothing.
    """
    scale = max(1.0, min(item.chi2 for item in judged))
    shifts = len(judged[0].fit.linear.misfit)
    least_between = scale * MINIMUM * max(1.0, shifts / REPEATED)
    variants = Counter(item.id for item in judged)
    least = min((item.cost for item in judged if item.fit.cause), default=0.0)
    logs, shares = np.zeros(len(judged)), np.zeros(len(judged))
    for k, item in enumerate(judged):
        if item.fit.cause is None:
            logs[k] = log(HEALTHY_PRIOR) - item.cost / scale
        else:
            prior = (1.0 - HEALTHY_PRIOR) / ids / variants[item.id]
            between = max(least_between, (unsure or {}).get(item.id, 0.0))
            behind = 0.5 * EFFECTIVE * log1p(2.0 * (item.cost - least) / between / EFFECTIVE)
            logs[k] = log(prior) - item.cost / scale
            shares[k] = prior * exp(-behind)
    weights = np.exp(logs - np.max(logs))
    weights /= weights.sum()
    wrong = np.array([item.fit.cause is not None for item in judged])
    if wrong.any():
        weights[wrong] = weights[wrong].sum() * shares[wrong] / shares[wrong].sum()
    pairs = zip(judged, weights.tolist(), strict=True)
    return sorted((replace(i, probability=w) for i, w in pairs), key=lambda i: -i.probability)


def with_failures(found: ShiftDiagnosis, failed: int) -> ShiftDiagnosis:
    """Return a diagnosis with the shifts that failed: they stand first, and nothing beside them is healthy."""
    if not failed:
        return found
    text = f"{counted(failed, 'shift')} did not reach the gear commanded"
    verdict = UNNAMED if found.verdict in ("consistent", "cannot_tell") else found.verdict
    return replace(found, verdict=verdict, findings=(text, *found.findings))


def detectable_of(linear: Linear, ids: int) -> tuple[Detectable, ...]:
    """Return what the shifts show of each cause, from their Fisher information.

    A cause is noticed if the evidence that it leaves in a truck called healthy is enough for an
    alarm. A cause that would be noticed at no size looks like a healthy truck, not like a cause.
    """
    linear = linear.without_cliffs()
    causes, (information, _score) = linear.causes, projected(linear)
    diagonal = np.maximum(np.diag(information), 1e-12)
    gain, deviation = hidden_cost(linear, SCANNED)
    volume = 0.5 * np.log1p(diagonal * SIZE_PRIOR**2)[:, None]
    needed = log(ids * (1.0 - ALARM) / ALARM) + volume + 0.5 * (SCANNED / SIZE_PRIOR) ** 2
    noticed = gain - NOTICED * deviation > needed
    found = []
    for k, cause in enumerate(causes):
        first = int(np.argmax(noticed[k]))
        size = float(SCANNED[first]) * (cause.sign or 1)
        if not noticed[k, first] or cause.value(size) == cause.value(0.9 * size):
            found.append(Detectable(cause, None, ()))
            continue
        tested = max(abs(size), 1.0) * (cause.sign or 1)
        apart = distances(information, causes, k, tested)
        alike = [
            other.effect.id
            for other, by in zip(causes, apart.tolist(), strict=True)
            if by < SEPARABLE and other.effect.id != cause.effect.id
        ]
        found.append(Detectable(cause, size, tuple(dict.fromkeys(alike))))
    return tuple(found)


def distances(information: Floats, causes: Sequence[Cause], k: int, size: float) -> Floats:
    """Return how far [causes] cause k of a size a is from each, of that one's best size b.

    d = a^2 I_kk - 2 a b I_kj + b^2 I_jj, in chi squared, with the truck's own quantities marginalised;
    b is physical and at most LARGEST. information: [causes, causes]; size: in typical ones. Where
    both signs of cause k are physical, the nearer one counts.
    """
    found = np.empty(len(causes))
    for j, other in enumerate(causes):
        own, across = max(float(information[j, j]), 1e-12), float(information[k, j])
        low, high = other.sizes(LARGEST)
        signed = (size,) if causes[k].sign else (size, -size)
        best = [(a, min(max(a * across / own, low), high)) for a in signed]
        found[j] = min(
            a * a * float(information[k, k]) - 2.0 * a * b * across + b * b * own for a, b in best
        )
    return found


def verdict_of(
    judged: Sequence[Judged], probabilities: dict[str, float], detectable: Sequence[Detectable]
) -> tuple[str, list[str]]:
    """Return the verdict and what is to be said of it."""
    best, healthy = judged[0], next(item for item in judged if item.fit.cause is None)
    wrong = {name: p for name, p in probabilities.items() if name != "healthy"}
    top = max(wrong, key=lambda name: wrong[name], default="")
    if all(item.size is None for item in detectable):
        return "cannot_tell", ["no cause of the catalogue would show in these shifts"]
    if min(item.chi2 for item in judged) > EXPLAINED:
        text = (
            f"the best explanation, {best.name}, leaves {best.chi2:.1f} times the noise (in chi "
            f"squared); {EXPLAINED:g} is the limit"
        )
        return UNNAMED, [text, *_where(best)]
    if probabilities["healthy"] <= ALARM:
        if wrong[top] < CERTAIN:
            return "ambiguous", _spread(wrong)
        size, deviation = next(item for item in judged if item.id == top).size
        if abs(size) <= 1.96 * deviation:
            return "ambiguous", [f"{top} is not named: its 95 % interval holds a size of nil"]
        return "named", []
    if healthy.chi2 > EXPLAINED:
        return UNNAMED, [f"without a cause {healthy.chi2:.1f} times the noise remain"]
    unseen = list(_unnoticed(detectable))
    odd = [
        f"{name} {value:+.1f}"
        for name, value in zip(healthy.fit.linear.names, healthy.fit.values, strict=True)
        if abs(value) > STRANGE
    ]
    if odd:
        unseen.insert(0, f"healthy only if unusual, in standard deviations: {', '.join(odd)}")
    doubted = probabilities["healthy"] < CONSISTENT
    if doubted:
        shown = ", ".join(f"{name} {p:.2f}" for name, p in wrong.items() if p > 0.05)
        unseen.insert(0, f"too much for a healthy truck, too little for an alarm: {shown}")
    return ("cannot_tell" if odd or doubted else "consistent"), unseen


def _spread(wrong: Mapping[str, float]) -> list[str]:
    """Return what is to be said of the causes that are not reported, if they are not improbable."""
    others = [p for p in wrong.values() if p < _least_reported(wrong)]
    if sum(others) < SPREAD:
        return []
    return [
        f"the other {sum(others):.2f} of the probability is spread over "
        f"{counted(len(others), 'cause')}, none above {max(others):.2g}"
    ]


def _unnoticed(detectable: Sequence[Detectable]) -> Iterator[str]:
    """Yield, class by class, up to which size causes would not have been noticed in these shifts."""
    classes: dict[str, dict[str, str]] = {}
    for item in detectable:
        own = item.cause.effect
        text = "any size"
        if item.value is not None:
            text = f"{item.value:.2g} {item.cause.parameter.unit}".removesuffix(" -")
        classes.setdefault(own.cause_class, {}).setdefault(own.id, f"{own.id} {text}")
    for name, texts in classes.items():
        yield f"not noticed up to ({name}): {', '.join(texts.values())}"


def _where(best: Judged) -> list[str]:
    """Return where in its shifts the best explanation fails most."""
    residuals = best.fit.linear.residuals
    mean = np.zeros(max(map(len, residuals)))
    for own in residuals:
        mean[: len(own)] += own**2 / len(residuals)
    worst = int(np.argmax(mean))
    return [
        f"largest deviation {1e3 * float(np.sqrt(mean[worst])):.2f} mm (rms over shifts), "
        f"{10 * worst - 50:d} ms after the first command"
    ]

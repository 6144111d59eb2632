"""The verdict on a truck's shifts: which cause, how sure, and what the bus cannot separate.

Every hypothesis, none or one cause, is fitted together with all in which healthy trucks differ, and
scored by its evidence (Laplace). The priors of the truck's quantities have heavy tails, so that an
unusual truck is not called a faulty one. Where the best hypothesis
leaves more than noise, all scores count less in proportion.
Checked by: tests/unit/sil/shift_diagnosis/test_diagnose_logs.py
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from math import log, log1p
from typing import Final

import numpy as np

from plant.parameters import ParameterSet
from sil.diagnosis.verdict import RIVAL_SHARE, UNNAMED
from sil.files.progress import Progress
from sil.shift_diagnosis.fit import Fit, Fitter
from sil.shift_diagnosis.linear import (
    NOISE,
    SIZE_PRIOR,
    Floats,
    Linear,
    Noise,
    explained,
    hidden_cost,
    linearise,
    projected,
)
from sil.shift_diagnosis.model import LEAST_NOISE_M, Cause, PlantModel, catalogue
from sil.shift_diagnosis.shifts import LEAD_S, Shift

MOST_SHIFTS: Final = 120
"""Shifts that are judged; of more, as many spread evenly over the logs."""
FIT_SHIFTS: Final = 12
"""Shifts that a hypothesis is fitted to before all judge it."""
HOPELESS: Final = 12.0
"""Log evidence behind the best on some shifts from which a cause is not fitted to all."""
FITTED: Final = 8
"""Causes that are fitted, those that the linear model and a coarse search favour."""
STRAINED: Final = 2.3
"""Deviation of a truck's own quantity, in standard deviations, that a cause might explain."""
STRANGE: Final = 3.0
"""Deviation of a truck's own quantity that is not called healthy without doubt."""
WORTH_A_FIT: Final = 2.0
"""Gain in log evidence by the linear model from which a cause is fitted."""
FARTHEST: Final = 8.0
"""Largest value from which a fit begins, in standard deviations and typical sizes."""
SCANNED: Final[Floats] = 0.05 * 1.15 ** np.arange(50.0)
"""Sizes that are tried for being noticed, in typical ones."""
NOTICED: Final = 1.28
"""Standard deviations of the evidence for 90 % certainty to notice."""
DOUBTED: Final = 0.2
"""Probability of a healthy truck below which it is not called consistent."""
QUICK_SHIFTS: Final = 6
"""Shifts that a cause is fitted to in a first search."""
HEALTHY_PRIOR: Final = 0.5
EFFECTIVE: Final = 4.0
"""Effective observations of the error that a fit's minimum has, in log evidence between causes."""
ALARM: Final = 0.01
"""Probability of a healthy truck below which something is claimed to be wrong."""
CERTAIN: Final = 0.8
"""Probability from which a cause is named."""
EXPLAINED: Final = 1.5
"""Chi squared per number up to which noise explains the rest."""
RESTARTS: Final = 3
"""Causes from whose fits the healthy truck is fitted again."""
SAME: Final = 0.995
"""Correlation of what two causes do from which one of them is not offered."""
SEPARABLE: Final = 9.0
"""Chi squared by which two causes must differ to count as separable: three standard deviations."""
FEWEST_SHIFTS: Final = 3


@dataclass(frozen=True)
class Judged:
    """A hypothesis over all shifts: evidence with both priors, and how probable it is.

    chi2: per compared number.
    """

    fit: Fit
    cost: float
    chi2: float
    probability: float = 0.0

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
        found = self.fit
        return float(found.estimate[-1]), float(
            np.sqrt(found.covariance[-1, -1] * max(1.0, self.chi2))
        )


@dataclass(frozen=True)
class Detectable:
    """What the bus shows of a cause: the smallest size it would show, and what looks the same.

    size: in typical ones, noticed in nine of ten trucks; None: at no size. alike: causes that cannot
    be told apart from it at that size or the typical one, whichever is larger.
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
    shifts: tuple[Shift, ...]
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
        least = CERTAIN if self.verdict == "named" else RIVAL_SHARE
        found: dict[str, Judged] = {}
        for item in self.judged:
            if item.fit.cause is not None and self.probabilities.get(item.id, 0.0) >= least:
                found.setdefault(item.id, item)
        return list(found.values())


def judge_shifts(
    shifts: Sequence[Shift], parameters: ParameterSet, progress: Progress | None = None
) -> ShiftDiagnosis:
    """Judge the shifts of one truck against the plant of a parameter set."""
    say = progress or (lambda _done, _all: None)
    used = _spread(shifts, MOST_SHIFTS)
    if len(used) < FEWEST_SHIFTS:
        text = f"{len(used)} usable shifts; at least {FEWEST_SHIFTS} are needed to judge"
        return ShiftDiagnosis("cannot_tell", tuple(used), (), {}, (), True, NOISE, (text,), {})
    models = [PlantModel(parameters, mounted) for mounted in (True, False)]
    fitter, healthy = healthy_fit(models, _spread(used, FIT_SHIFTS), Noise(rest_noise_m(used)))
    say(20.0, 100.0)
    causes = catalogue()
    linear = _linear(fitter, used, healthy, causes)
    alone = linear.information.sum(axis=0)[linear.units :, linear.units :]
    offered = [k for k in range(len(causes)) if not _repeats(k, causes, alone)]
    causes = [causes[k] for k in offered]
    linear = linear.restricted(offered)
    say(40.0, 100.0)
    fits = [healthy]
    chosen = _promising(fitter, healthy, linear)
    for number, (cause, points) in enumerate(chosen):
        fits.append(min((fitter.fit(cause, at) for at in points), key=lambda fit: fit.cost))
        say(40.0 + 30.0 * (number + 1) / len(chosen), 100.0)
    best = fitter.settle(min(fits, key=lambda fit: fit.cost))
    whole = Fitter(fitter.model, used, fitter.noise)
    weights = whole.at(best.cause, best.point).linear.weights
    whole.noise = replace(whole.noise, weights=weights)
    judged = [
        _judged(whole, fit.cause, fit.point)
        for fit in fits
        if fit.cause is None or fit.cost < min(f.cost for f in fits) + HOPELESS
    ]
    say(80.0, 100.0)
    ids = len({cause.effect.id for cause in causes})
    judged = _weighed(judged, ids)
    judged = _weighed(_with_rivals(whole, fitter, judged, causes), ids)
    judged = _weighed(_healthy_again(whole, judged), ids)
    probabilities: dict[str, float] = {}
    for item in judged:
        probabilities[item.id] = probabilities.get(item.id, 0.0) + item.probability
    detectable = _detectable(_linear(whole, used, judged[0].fit, causes), ids)
    verdict, findings = _verdict(judged, probabilities, detectable)
    return ShiftDiagnosis(
        verdict, tuple(used), tuple(judged), probabilities, detectable, fitter.model.mounted,
        fitter.noise, tuple(findings), fitter.model.unit,
    )  # fmt: skip


def _linear(fitter: Fitter, shifts: Sequence[Shift], at: Fit, causes: Sequence[Cause]) -> Linear:
    """Return shifts linearised around a hypothesis' truck, with the causes' sizes at 0."""
    return linearise(
        fitter.model, shifts, at.values, causes, noise=replace(fitter.noise, weights=())
    )


def healthy_fit(
    models: Sequence[PlantModel], shifts: Sequence[Shift], noise: Noise
) -> tuple[Fitter, Fit]:
    """Fit a healthy truck and the scatter of its shifts; of models, the one that fits better."""
    starts = []
    for model in models:
        fitter = Fitter(model, shifts, noise)
        starts.append((fitter, fitter.fit(None, np.zeros(len(fitter.names)))))
    fitter, healthy = min(starts, key=lambda pair: pair[1].half_chi2)
    return fitter, fitter.settle(healthy)


def rest_noise_m(shifts: Sequence[Shift]) -> float:
    """Return the standard deviation of a position before the first motion, at least the timer's [m]."""
    rests = [s.position_m[s.time_s < LEAD_S] for s in shifts]
    squares = np.concatenate(
        [(r - np.mean(r)) ** 2 * len(r) / (len(r) - 1) for r in rests if len(r) > 1]
    )
    return float(max(LEAST_NOISE_M, np.sqrt(np.mean(squares))))


def _spread(shifts: Sequence[Shift], most: int) -> list[Shift]:
    """Return at most so many shifts, evenly spread, every kind of shift in its share."""
    if len(shifts) <= most:
        return list(shifts)
    return [shifts[k] for k in np.linspace(0, len(shifts) - 1, most).round().astype(int)]


def _judged(whole: Fitter, cause: Cause | None, start: Floats) -> Judged:
    """Return a hypothesis fitted to all shifts, from where some of them left it."""
    final = whole.fit(cause, start, rounds=8)
    count = max(1, int(final.linear.count.sum()) - final.linear.units)
    return Judged(final, final.cost, float(final.linear.misfit.sum()) / count)


def _promising(fitter: Fitter, healthy: Fit, linear: Linear) -> list[tuple[Cause, list[Floats]]]:
    """Return the causes worth a fit, each with the points [units + 1] to begin from.

    By the linear model; where a healthy truck is not enough or a strange one, by fits to a few shifts.
    """
    enough = healthy.half_chi2 < 0.5 * EXPLAINED * int(healthy.linear.count.sum())
    strained = not enough or np.max(np.abs(healthy.values)) > STRAINED
    quick = Fitter(fitter.model, _spread(fitter.shifts, QUICK_SHIFTS), fitter.noise)
    base, _point = explained(linear)
    found: list[tuple[float, Cause, list[Floats]]] = []
    for k, cause in enumerate(linear.causes):
        cost, point = explained(linear, k)
        gain, starts = base - cost, [np.clip(point, -FARTHEST, FARTHEST)]
        if cause.sign * point[-1] < 0.0:
            gain, starts = 0.0, []
        if strained:
            signs = (1.0, -1.0) if cause.sign == 0 else (float(cause.sign),)
            fits = [quick.fit(cause, np.append(healthy.values, s), rounds=4) for s in signs]
            best = min(fits, key=lambda fit: fit.cost)
            found.append((-best.cost, cause, [best.point, *starts]))
        elif gain > WORTH_A_FIT:
            found.append((gain, cause, starts))
    chosen: list[tuple[Cause, list[Floats]]] = []
    ids = Counter[str]()
    for _gain, cause, starts in sorted(found, key=lambda item: -item[0]):
        if len(chosen) < FITTED and ids[cause.effect.id] < 2:
            chosen.append((cause, starts))
            ids[cause.effect.id] += 1
    return chosen


def _with_rivals(
    whole: Fitter, fitter: Fitter, judged: Sequence[Judged], causes: Sequence[Cause]
) -> list[Judged]:
    """Return the hypotheses, those that look like the best cause fitted from where that one is."""
    best = next((item for item in judged if item.fit.cause is not None), None)
    if best is None or best.probability < ALARM:
        return list(judged)
    cause, size = best.fit.cause, best.size[0]
    assert cause is not None
    linear = linearise(
        whole.model, fitter.shifts, best.fit.values, causes, {cause: best.fit.size}, fitter.noise
    )
    share = len(whole.shifts) / len(fitter.shifts)
    information = projected(linear)[0] * share
    found = {item.fit.cause: item for item in judged}
    k = list(causes).index(cause)
    for j, other in enumerate(causes):
        own, across = max(float(information[j, j]), 1e-12), float(information[k, j])
        start = size * across / own
        left = size**2 * float(information[k, k]) - start**2 * own
        if j == k or left > 4.0 * SEPARABLE or other.sign * start < 0.0:
            continue
        item = _judged(whole, other, np.append(best.fit.values, start))
        if (
            left < SEPARABLE
        ):  # one of several minima does not tell apart what the information cannot
            item = replace(item, cost=min(item.cost, best.cost + 0.5 * left))
        if other not in found or item.cost < found[other].cost:
            found[other] = item
    return list(found.values())


def _healthy_again(whole: Fitter, judged: Sequence[Judged]) -> list[Judged]:
    """Return the hypotheses, the healthy truck fitted from where the best causes are, too.

    The residual has several minima: what a cause gained by another start is not its merit.
    """
    best = next(item for item in judged if item.fit.cause is None)
    causes = [item for item in judged if item.fit.cause is not None]
    for item in [item for item in causes if item.probability > ALARM][:RESTARTS]:
        again = _judged(whole, None, item.fit.values)
        best = again if again.cost < best.cost else best
    return [best, *causes]


def _repeats(k: int, causes: Sequence[Cause], information: Floats) -> bool:
    """Return whether a cause does the same to these shifts as another that says it more simply.

    That is an earlier variant of the same effect, or, where the condition of an effect on the
    valves' switching does not vary, the effect that has none.
    """
    diagonal = np.maximum(np.diag(information), 1e-12)
    own = causes[k].effect
    return any(
        abs(information[j, k]) > SAME * float(np.sqrt(diagonal[j] * diagonal[k]))
        and (
            (other.effect is own and j < k)
            or (own.switching and other.effect.switching == own.switching and not own.tolerance)
        )
        for j, other in enumerate(causes)
        if j != k
    )


def _weighed(judged: Sequence[Judged], ids: int) -> list[Judged]:
    """Return the hypotheses with their probabilities, the most probable first.

    A cause that is behind another counts by Student's form: their fits end in one of many minima.
    """
    scale = max(1.0, min(item.chi2 for item in judged))
    variants = Counter(item.id for item in judged)
    least = min((item.cost for item in judged if item.fit.cause), default=0.0)
    logs = np.zeros(len(judged))
    for k, item in enumerate(judged):
        if item.fit.cause is None:
            logs[k] = log(HEALTHY_PRIOR) - item.cost / scale
        else:
            prior = log((1.0 - HEALTHY_PRIOR) / ids / variants[item.id])
            behind = 0.5 * EFFECTIVE * log1p(2.0 * (item.cost - least) / scale / EFFECTIVE)
            logs[k] = prior - least / scale - behind
    weights = np.exp(logs - np.max(logs))
    weights /= weights.sum()
    pairs = zip(judged, weights.tolist(), strict=True)
    return sorted((replace(i, probability=w) for i, w in pairs), key=lambda i: -i.probability)


def _detectable(linear: Linear, ids: int) -> tuple[Detectable, ...]:
    """Return what the shifts show of each cause, from their Fisher information.

    A cause is noticed if the evidence that it leaves in a truck called healthy is enough for an
    alarm. Two causes of sizes a and b differ by |a x - b y|^2 in units of the noise, with the truck's
    own quantities marginalised; of b the best physical one is taken.
    """
    causes, (information, _score) = linear.causes, projected(linear)
    diagonal = np.maximum(np.diag(information), 1e-12)
    gain = hidden_cost(linear, SCANNED)
    volume = 0.5 * np.log1p(diagonal * SIZE_PRIOR**2)[:, None]
    needed = log(ids * (1.0 - ALARM) / ALARM) + volume + 0.5 * (SCANNED / SIZE_PRIOR) ** 2
    noticed = gain - NOTICED * np.sqrt(2.0 * gain) > needed
    found = []
    for k, cause in enumerate(causes):
        first = int(np.argmax(noticed[k]))
        size = float(SCANNED[first]) * (cause.sign or 1)
        shown = noticed[k, first] and cause.value(size) != cause.value(0.9 * size)
        tested = max(abs(size), 1.0) if shown else 1.0
        alike = []
        for j, other in enumerate(causes):
            if other.effect.id == cause.effect.id:
                continue
            across = float(information[k, j])
            reachable = cause.sign * other.sign * across >= 0.0
            same = across**2 / diagonal[j] if reachable else 0.0
            if tested**2 * (diagonal[k] - same) < SEPARABLE:
                alike.append(other.effect.id)
        found.append(Detectable(cause, size if shown else None, tuple(dict.fromkeys(alike))))
    return tuple(found)


def _verdict(
    judged: Sequence[Judged], probabilities: dict[str, float], detectable: Sequence[Detectable]
) -> tuple[str, list[str]]:
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
        return ("named" if wrong[top] >= CERTAIN else "ambiguous"), []
    if healthy.chi2 > EXPLAINED:
        return UNNAMED, [f"without a cause {healthy.chi2:.1f} times the noise remain"]
    unseen = list(unnoticed(detectable))
    odd = [
        f"{name} {value:+.1f}"
        for name, value in zip(healthy.fit.linear.names, healthy.fit.values, strict=True)
        if abs(value) > STRANGE
    ]
    if odd:
        unseen.insert(0, f"healthy only if unusual, in standard deviations: {', '.join(odd)}")
    if probabilities["healthy"] < DOUBTED:
        shown = ", ".join(f"{name} {p:.2f}" for name, p in wrong.items() if p > 0.05)
        unseen.insert(0, f"too much for a healthy truck, too little for an alarm: {shown}")
    return ("cannot_tell" if odd or probabilities["healthy"] < DOUBTED else "consistent"), unseen


def unnoticed(detectable: Sequence[Detectable]) -> Iterator[str]:
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

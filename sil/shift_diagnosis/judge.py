"""The verdict on a truck's shifts: which cause, how sure, and what the bus cannot separate.

Every hypothesis, none or one cause, is fitted together with all in which healthy trucks differ, and
scored by its evidence (Laplace). The priors of the truck's quantities have heavy tails, so that an
unusual truck is not called a faulty one. Where the best hypothesis
leaves more than noise, all scores count less in proportion.
Checked by: tests/unit/sil/shift_diagnosis/test_diagnose_logs.py
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import log
from typing import Final

import numpy as np

from plant.parameters import ParameterSet
from sil.diagnosis.verdict import UNNAMED
from sil.files.progress import Progress
from sil.shift_diagnosis.fit import Fit, Fitter
from sil.shift_diagnosis.linear import Floats, linearise, projected
from sil.shift_diagnosis.model import LEAST_NOISE_M, Cause, PlantModel, catalogue
from sil.shift_diagnosis.shifts import LEAD_S, Shift

MOST_SHIFTS: Final = 120
"""Shifts that are judged; of more, as many spread evenly over the logs."""
FIT_SHIFTS: Final = 12
"""Shifts that a hypothesis is fitted to before all judge it."""
HOPELESS: Final = 12.0
"""Log evidence behind the best on some shifts from which a cause is not fitted to all."""
FITTED: Final = 10
"""Causes that are fitted, those that the linear model and a coarse search favour."""
STRAINED: Final = 2.3
"""Deviation of a truck's own quantity, in standard deviations, that a cause might explain."""
WORTH_A_FIT: Final = 0.5
"""Gain in log evidence by the linear model from which a cause is fitted to a strained truck; a
truck that is explained without strain needs 3."""
SIZES: Final = (0.7, 2.5)
"""Sizes at which the coarse search looks, in typical ones."""
HEALTHY_PRIOR: Final = 0.5
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

    size: in typical ones, three standard deviations; alike: causes that cannot be told apart from
    it at twice that size or the typical one, whichever is larger.
    """

    cause: Cause
    size: float
    alike: tuple[str, ...]


@dataclass(frozen=True)
class ShiftDiagnosis:
    """All that was found of the shifts of one truck."""

    verdict: str
    shifts: tuple[Shift, ...]
    judged: tuple[Judged, ...]
    probabilities: dict[str, float]
    detectable: tuple[Detectable, ...]
    mounted: bool
    noise_m: float
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
        least = CERTAIN if self.verdict == "named" else 0.03
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
        return ShiftDiagnosis("cannot_tell", tuple(used), (), {}, (), True, 0.0, (text,), {})
    noise = rest_noise_m(used)
    few = _spread(used, FIT_SHIFTS)
    starts = []
    for mounted in (True, False):
        fitter = Fitter(PlantModel(parameters, mounted), few, noise)
        starts.append((fitter, fitter.fit(None, np.zeros(len(fitter.names)), 0.0)))
    fitter, healthy = min(starts, key=lambda pair: pair[1].half_chi2)
    say(20.0, 100.0)
    whole = Fitter(fitter.model, used, noise)
    causes = catalogue()
    linear = linearise(whole.model, used, healthy.values, causes, noise_m=noise)
    information, score = projected(linear)
    alone = linear.information.sum(axis=0)[linear.units :, linear.units :]
    offered = [k for k in range(len(causes)) if not _repeats(k, causes, alone)]
    causes = [causes[k] for k in offered]
    information, score = information[np.ix_(offered, offered)], score[offered]
    say(40.0, 100.0)
    judged = [_judged(whole, None, healthy.values, 0.0)]
    chosen = _promising(fitter, healthy, causes, information, score)
    fits = []
    for number, (cause, at) in enumerate(chosen):
        fits.append(fitter.fit(cause, at[:-1], float(at[-1])))
        say(40.0 + 30.0 * (number + 1) / len(chosen), 100.0)
    fits = sorted(fits, key=lambda fit: fit.cost)
    for fit in fits:
        if fit.cost < fits[0].cost + HOPELESS:
            judged.append(_judged(whole, fit.cause, fit.values, fit.size))
    say(80.0, 100.0)
    ids = len({cause.effect.id for cause in causes})
    judged = _weighed(judged, ids)
    judged = _weighed(_with_rivals(whole, fitter, judged, causes), ids)
    judged = _weighed(_healthy_again(whole, judged), ids)
    probabilities: dict[str, float] = {}
    for item in judged:
        probabilities[item.id] = probabilities.get(item.id, 0.0) + item.probability
    detectable = _detectable(causes, information)
    verdict, findings = _verdict(judged, probabilities, detectable)
    return ShiftDiagnosis(
        verdict, tuple(used), tuple(judged), probabilities, detectable, fitter.model.mounted,
        noise, tuple(findings), fitter.model.unit,
    )  # fmt: skip


def rest_noise_m(shifts: Sequence[Shift]) -> float:
    """Return the standard deviation of a position before the first motion, at least the timer's [m]."""
    rests = [s.position_m[s.time_s < LEAD_S] for s in shifts]
    squares = np.concatenate(
        [(r - np.mean(r)) ** 2 * len(r) / (len(r) - 1) for r in rests if len(r) > 1]
    )
    return float(np.hypot(LEAST_NOISE_M, np.sqrt(np.mean(squares))))


def _spread(shifts: Sequence[Shift], most: int) -> list[Shift]:
    """Return at most so many shifts, evenly spread, every kind of shift in its share."""
    if len(shifts) <= most:
        return list(shifts)
    return [shifts[k] for k in np.linspace(0, len(shifts) - 1, most).round().astype(int)]


def _judged(whole: Fitter, cause: Cause | None, values: Floats, size: float) -> Judged:
    """Return a hypothesis fitted to all shifts, from where some of them left it."""
    final = whole.fit(cause, values, size, rounds=5)
    count = max(1, int(final.linear.count.sum()) - final.linear.units)
    return Judged(final, final.cost, float(final.linear.misfit.sum()) / count)


def _promising(
    fitter: Fitter, healthy: Fit, causes: Sequence[Cause], information: Floats, score: Floats
) -> list[tuple[Cause, Floats]]:
    """Return the causes worth a fit, each with the point [units + 1] to begin from."""
    diagonal = np.maximum(np.diag(information), 1e-9)
    size = score / (diagonal + 1.0)
    found: list[tuple[float, Cause, Floats]] = []
    explained = healthy.half_chi2 < 0.5 * EXPLAINED * healthy.linear.count.sum()
    strained = float(np.max(np.abs(healthy.values))) > STRAINED
    for k, cause in enumerate(causes):
        if cause.sign * size[k] >= 0.0:
            gain = 0.5 * score[k] ** 2 / (diagonal[k] + 1.0)
            if explained and gain < (WORTH_A_FIT if strained else 3.0):
                continue
            start = float(np.clip(size[k], -5.0, 5.0))
            found.append((healthy.half_chi2 - gain, cause, np.append(healthy.values, start)))
    if not explained:
        zero = np.zeros(len(fitter.names))
        for cause in causes:
            signs = (1, -1) if cause.sign == 0 else (cause.sign,)
            trials = [np.append(zero, sign * size) for sign in signs for size in SIZES]
            costs = fitter.costs(cause, trials, healthy.linear)
            best = int(np.argmin(costs))
            found.append((float(costs[best]), cause, trials[best]))
    chosen: dict[Cause, Floats] = {}
    ids: dict[str, int] = {}
    for _cost, cause, at in sorted(found, key=lambda item: item[0]):
        if cause not in chosen and len(chosen) < FITTED and ids.get(cause.effect.id, 0) < 2:
            chosen[cause] = at
            ids[cause.effect.id] = ids.get(cause.effect.id, 0) + 1
    return list(chosen.items())


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
        whole.model, fitter.shifts, best.fit.values, causes, {cause: best.fit.size}, whole.noise_m
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
        item = _judged(whole, other, best.fit.values, start)
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
        again = _judged(whole, None, item.fit.values, 0.0)
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
    """Return the hypotheses with their probabilities, the most probable first."""
    scale = max(1.0, min(item.chi2 for item in judged))
    variants = {name: sum(item.id == name for item in judged) for name in {j.id for j in judged}}
    logs = np.array(
        [
            -item.cost / scale
            + log(
                HEALTHY_PRIOR
                if item.fit.cause is None
                else (1.0 - HEALTHY_PRIOR) / ids / variants[item.id]
            )
            for item in judged
        ]
    )
    weights = np.exp(logs - np.max(logs))
    weights /= weights.sum()
    weighed = [
        Judged(item.fit, item.cost, item.chi2, float(w))
        for item, w in zip(judged, weights, strict=True)
    ]
    return sorted(weighed, key=lambda item: -item.probability)


def _detectable(causes: Sequence[Cause], information: Floats) -> tuple[Detectable, ...]:
    """Return what the shifts show of each cause, from their Fisher information [causes, causes].

    Two causes of sizes a and b differ by |a x - b y|^2 in units of the noise, with the truck's own
    quantities marginalised; of b the best physical one is taken.
    """
    diagonal = np.maximum(np.diag(information), 1e-12)
    found = []
    for k, cause in enumerate(causes):
        size = 3.0 / float(np.sqrt(diagonal[k]))
        tested = max(2.0 * size, 1.0)
        alike = []
        for j, other in enumerate(causes):
            if other.effect.id == cause.effect.id:
                continue
            across = float(information[k, j])
            reachable = cause.sign * other.sign * across >= 0.0
            same = across**2 / diagonal[j] if reachable else 0.0
            if tested**2 * (diagonal[k] - same) < SEPARABLE:
                alike.append(other.effect.id)
        found.append(Detectable(cause, size, tuple(dict.fromkeys(alike))))
    return tuple(found)


def _verdict(
    judged: Sequence[Judged], probabilities: dict[str, float], detectable: Sequence[Detectable]
) -> tuple[str, list[str]]:
    best, healthy = judged[0], next(item for item in judged if item.fit.cause is None)
    wrong = {name: p for name, p in probabilities.items() if name != "healthy"}
    top = max(wrong, key=lambda name: wrong[name], default="")
    if all(item.size > 30.0 for item in detectable):
        return "cannot_tell", ["no cause of the catalogue would show in these shifts"]
    if min(item.chi2 for item in judged) > EXPLAINED:
        text = (
            f"the best explanation, {best.name}, leaves {best.chi2:.1f} times the noise (in chi "
            f"squared); {EXPLAINED:g} is the limit"
        )
        return UNNAMED, [text, *_where(best)]
    if probabilities["healthy"] > ALARM:
        if healthy.chi2 > EXPLAINED:
            return UNNAMED, [f"without a cause {healthy.chi2:.1f} times the noise remain"]
        suspected = f"the most probable cause, {top}, has {wrong.get(top, 0.0):.2f}"
        return "consistent", [suspected] if wrong.get(top, 0.0) > 0.2 else []
    if wrong[top] >= CERTAIN:
        return "named", []
    return "ambiguous", []


def _where(best: Judged) -> list[str]:
    """Return where in its shifts the best explanation fails most."""
    residual = best.fit.linear.residual_m
    rms = np.sqrt(np.nanmean(residual**2, axis=0))
    worst = int(np.nanargmax(rms))
    return [
        f"largest deviation {1e3 * float(rms[worst]):.2f} mm (rms over shifts), {10 * worst - 50:d} ms "
        "after the first command"
    ]

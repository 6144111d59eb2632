"""A truck's shifts judged: hypotheses searched, fitted to some shifts and then to all.

Every hypothesis, none or one cause, is fitted together with all in which healthy trucks differ, and
scored by its evidence (Laplace). The priors of the truck's quantities have heavy tails, so that an
unusual truck is not called a faulty one. Where the best hypothesis
leaves more than noise, all scores count less in proportion.
Checked by: tests/unit/sil/shift_diagnosis/test_judge.py, test_diagnose_logs.py
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np

from plant.parameters import ParameterSet
from sil.diagnosis.workers import Stages
from sil.files.progress import Progress
from sil.fitting.fit import no_progress
from sil.shift_diagnosis.fit import COARSE_M, FARTHEST, Fit, Fitter, fits_of
from sil.shift_diagnosis.linear import (
    NOISE,
    SIZE_PRIOR,
    Floats,
    Linear,
    Noise,
    estimates,
    explained,
    linearise,
    projected,
    unit_names,
)
from sil.shift_diagnosis.loads import BARRIERS, CONE, own_loads, vary, with_speeds, without_speeds
from sil.shift_diagnosis.model import LEAST_NOISE_M, Cause, PlantModel, catalogue
from sil.shift_diagnosis.shifts import LEAD_S, Shift
from sil.shift_diagnosis.starts import usual_starts
from sil.shift_diagnosis.verdict import (
    ALARM,
    DOUBTED,
    EXPLAINED,
    SEPARABLE,
    Judged,
    ShiftDiagnosis,
    detectable_of,
    verdict_of,
    weighed,
)

MOST_SHIFTS: Final = 120
"""Shifts that are judged; of more, as many spread evenly over the logs."""
FIT_SHIFTS: Final = 12
"""Shifts that a hypothesis is fitted to before all judge it."""
LEADING: Final = 3
"""Hypotheses, the best on these, of which the best on all shifts says how the shifts scatter."""
HOPELESS: Final = 12.0
"""Log evidence behind the best on some shifts from which a cause is not fitted to all."""
FITTED: Final = 8
"""Causes that are fitted, those that the linear model and a coarse search favour."""
STRAINED: Final = 2.3
"""Deviation of a truck's own quantity, in standard deviations, that a cause might explain."""
WORTH_A_FIT: Final = 2.0
"""Gain in log evidence by the linear model from which a cause is fitted."""
LARGEST_START: Final = 8.0
"""Largest value from which a fit begins, in standard deviations and typical sizes."""
AS_GOOD: Final = 5.0
"""Log evidence within which another minimum of a fit is as good: its size is in the interval."""
SECANT: Final = 0.5
"""Step of the differences for intervals: positions have kinks."""
NEAREST: Final = 6
"""Causes that come nearest to the shifts in a usual truck and are fitted from there, too."""
QUICK_SHIFTS: Final = 6
"""Shifts that a cause is fitted to in a first search."""
RESTARTS: Final = 3
"""Causes from whose fits the healthy truck is fitted again."""
SECOND: Final = 5
"""Causes that are fitted from the truck of the best one."""
NEARLY: Final = 0.5
"""Chi squared per number by which a rival's fit may be worse than that of the best cause."""
SHOWN: Final = 0.5
"""Share of the prior's variance of a size above which shifts say nothing of it."""
SAME: Final = 0.995
"""Correlation of what two causes do from which one of them is not offered."""
FEWEST_SHIFTS: Final = 3
Items = Sequence[tuple[Cause | None, Floats]]
Run = Callable[[Callable[[Cause | None, Floats], Fit], Items], list[Fit]]
"""Fits of causes from their starts, on some processes."""
VARIES_PA: Final = 2e4
"""Standard deviation of the supply pressure from which what depends on it can be distinguished."""
SCANS: Final = 2
"""Rounds of loads found and a healthy truck fitted with them."""
ODD, MOST_ODD = 3.0, 0.15
"""Chi squared per number, of the shifts' median, from which a shift is odd; and how many may be."""


def judge_shifts(
    shifts: Sequence[Shift],
    parameters: ParameterSet,
    progress: Progress | None = None,
    workers: int = 1,
) -> ShiftDiagnosis:
    """Judge the shifts of one truck against the plant of a parameter set, on so many processes."""
    stages = Stages(progress or no_progress)
    left_out = Counter[str]()
    used = _spread(with_speeds(shifts, left_out), MOST_SHIFTS)
    missing = [f"{n} shifts {why} left out" for why, n in left_out.items()]
    if len(used) < FEWEST_SHIFTS:
        text = f"{len(used)} usable shifts; at least {FEWEST_SHIFTS} are needed to judge"
        return ShiftDiagnosis(
            "cannot_tell", tuple(used), (), {}, (), True, NOISE, (text, *missing), {}
        )
    models = [PlantModel(parameters, mounted) for mounted in (True, False)]
    fitter, healthy, used = loaded_fit(models, used, Noise(rest_noise_m(used)))
    stages.until(15.0)(1.0, 1.0)
    causes = _offered(used)
    linear = _linear(fitter, used, healthy, causes)
    alone = linear.information.sum(axis=0)[linear.units :, linear.units :]
    causes = [cause for k, cause in enumerate(causes) if not _repeats(k, causes, alone)]
    run = partial(fits_of, workers=workers)
    chosen = _promising(fitter, healthy, linear, causes, partial(run, progress=stages.until(35.0)))
    fits = [healthy, *run(fitter.fit, chosen, progress=stages.until(50.0))]
    fits += _second(fitter, fits, causes, partial(run, progress=stages.until(55.0)))
    close = _close(fits)
    minima = {
        best.cause: tuple(
            fit.size for fit in fits if fit.cause is best.cause and fit.cost < best.cost + AS_GOOD
        )
        for best in close
        if best.cause is not None
    }
    close[0] = fitter.settle(close[0])
    whole = Fitter(fitter.model, used, fitter.noise)
    leading = _on_all(whole, close, partial(run, progress=stages.until(60.0)))
    weights, odd = _without_odd(leading[0])
    whole.noise = replace(whole.noise, weights=weights)
    starts = {fit.cause: fit.point for fit in (*close, *leading)}
    finish = partial(_final, whole)
    ids = len({cause.effect.id for cause in causes})
    finals = run(finish, list(starts.items()), progress=stages.until(75.0))
    judged = weighed([Judged.of(fit) for fit in finals], ids)
    if not _is_settled(judged, ids):
        own = partial(run, progress=stages.until(80.0))
        judged = weighed(_with_rivals(whole, judged, causes, own), ids)
    judged = weighed(_healthy_again(whole, judged), ids)
    if _healthy_share(judged) < DOUBTED:
        own = partial(run, progress=stages.until(90.0))
        judged = weighed(_second_attempt(fitter, whole, judged, causes, own), ids)
        own = partial(run, progress=stages.until(97.0))
        judged = weighed(_with_rivals(whole, judged, causes, own), ids)
        judged = weighed(_healthy_again(whole, judged), ids)
    judged = [
        item if item.fit.cause is None else replace(item, minima=minima.get(item.fit.cause, ()))
        for item in judged
    ]
    probabilities: dict[str, float] = {}
    for item in judged:
        probabilities[item.id] = probabilities.get(item.id, 0.0) + item.probability
    detectable = detectable_of(_linear(whole, used, judged[0].fit, causes), ids)
    verdict, findings = verdict_of(judged, probabilities, detectable)
    if odd:
        verdict, findings = _beside_odd(verdict, findings, used, odd)
    return ShiftDiagnosis(
        verdict, tuple(used), tuple(judged), probabilities, detectable, fitter.model.mounted,
        fitter.noise, (*findings, *missing), fitter.model.unit,
    )  # fmt: skip


def _linear(fitter: Fitter, shifts: Sequence[Shift], at: Fit, causes: Sequence[Cause]) -> Linear:
    """Return shifts linearised around a hypothesis' truck, with the causes' sizes at 0.

    Steps are small: with large ones, what is not linear looks like something that only the cause does.
    """
    noise = replace(fitter.noise, weights=())
    return linearise(fitter.model, shifts, at.values, causes, noise=noise)


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


def _offered(shifts: Sequence[Shift]) -> list[Cause]:
    """Return the catalogue's causes, those by the supply pressure only if that is known to vary."""
    supplies = [s.supply_pa for s in shifts if not np.isnan(s.supply_pa)]
    varies = len(supplies) > 1 and float(np.std(supplies)) > VARIES_PA
    return [c for c in catalogue() if varies or not c.effect.switching or c.effect.tolerance]


def _is_explained(fit: Fit) -> bool:
    """Return whether noise explains what a fit leaves."""
    return fit.half_chi2 < 0.5 * EXPLAINED * int(fit.linear.count.sum())


def loaded_fit(
    models: Sequence[PlantModel], used: Sequence[Shift], noise: Noise
) -> tuple[Fitter, Fit, list[Shift]]:
    """Fit a healthy truck; return it with the shifts, which have loads of their own where needed.

    That is without speeds in the log, or where a truck with equal loads does not explain its shifts
    and loads that differ explain them better.
    """
    silent = without_speeds(used)
    found: list[tuple[Fitter, Fit, list[Shift]]] = []
    if not silent:
        found = [(*healthy_fit(models, _spread(used, FIT_SHIFTS), noise), list(used))]
        if _is_explained(found[0][1]):
            return found[0]
    for free in (CONE if silent else BARRIERS, BARRIERS + CONE):
        for model in models if silent else [found[0][0].model]:
            own, values = list(used), np.zeros(len(unit_names(model)))
            for _ in range(SCANS):
                own = own_loads(model, own, values, free)
                few = _spread(own, FIT_SHIFTS)
                fitter, healthy = healthy_fit([model], few, replace(noise, loads=free))
                values = healthy.values
            if silent or vary(own, used):
                found.append((fitter, healthy, own))
        best = min(found, key=lambda item: item[1].cost, default=None)
        if best is not None and _is_explained(best[1]):
            break
    assert best is not None
    return best


def _without_odd(best: Fit) -> tuple[tuple[Floats, ...], list[int]]:
    """Return the weights of the shifts, and which count less.

    These are few that fit far worse than most, and all that cannot be simulated.
    """
    linear = best.linear
    each = linear.misfit / np.maximum(linear.count, 1)
    limit = ODD * max(1.0, float(np.median(each)))
    odd, unable = each > limit, linear.count == 0
    if odd.sum() > MOST_ODD * len(each):
        return linear.weights, np.flatnonzero(unable).tolist()
    shares = np.minimum(1.0, limit / np.maximum(each, limit))
    weights = tuple(s * w for s, w in zip(shares, linear.weights, strict=True))
    return weights, np.flatnonzero(odd | unable).tolist()


def _beside_odd(
    verdict: str, findings: Sequence[str], shifts: Sequence[Shift], odd: Sequence[int]
) -> tuple[str, list[str]]:
    """Return verdict and findings of shifts some of which are odd: they are not consistent."""
    names = ", ".join(f"{shifts[k].begin_s:.2f} s of {Path(shifts[k].source).name}" for k in odd)
    text = (
        f"{len(odd)} of {len(shifts)} shifts fit far worse than the others, or cannot be "
        f"simulated, and count less; they begin at {names}"
    )
    return ("cannot_tell" if verdict == "consistent" else verdict), [text, *findings]


def rest_noise_m(shifts: Sequence[Shift]) -> float:
    """Return the standard deviation of a position before the first motion, at least the timer's [m]."""
    rests = [s.position_m[s.time_s < LEAD_S] for s in shifts]
    own = [(r - np.mean(r)) ** 2 * len(r) / (len(r) - 1) for r in rests if len(r) > 1]
    if not own:
        return LEAST_NOISE_M
    squares = np.concatenate(own)
    return float(max(LEAST_NOISE_M, np.sqrt(np.mean(squares))))


def _spread(shifts: Sequence[Shift], most: int) -> list[Shift]:
    """Return at most so many shifts, evenly spread, of those between two gears their share.

    Into gear and out of it come in turn: every second shift would be of one kind.
    """
    if len(shifts) <= most:
        return list(shifts)
    # stable: in time among shifts between the same gears
    order = sorted(range(len(shifts)), key=lambda k: (shifts[k].start, shifts[k].end))
    taken = np.linspace(0, len(shifts) - 1, most).round().astype(int)
    return [shifts[k] for k in sorted(order[at] for at in taken)]


def _final(whole: Fitter, cause: Cause | None, start: Floats) -> Fit:
    """Return a hypothesis fitted to all shifts, from where some of them left it."""
    final = whole.fit(cause, start, rounds=8)
    wide = whole.at(cause, final.point, difference=SECANT).linear
    covariance = estimates(wide.without_cliffs())[1]  # near a kink, slopes claim too much
    if covariance[-1, -1] > final.covariance[-1, -1]:
        final = replace(final, covariance=covariance)
    return final


def _close(fits: Sequence[Fit]) -> list[Fit]:
    """Return the healthy truck and the causes that are not hopeless, the best first.

    All are fits to the same shifts with the same noise: else their costs cannot be compared.
    """
    least = min(fit.cost for fit in fits)
    close = [fit for fit in fits if fit.cause is None or fit.cost < least + HOPELESS]
    found: dict[Cause | None, Fit] = {}
    for fit in sorted(close, key=lambda fit: fit.cost):
        found.setdefault(fit.cause, fit)
    return list(found.values())


def _on_all(whole: Fitter, fits: Sequence[Fit], run: Run) -> list[Fit]:
    """Return the leading hypotheses, of fits to some shifts in order, on all shifts, best first."""
    items: Items = [(fit.cause, fit.point) for fit in fits[:LEADING]]
    finals = run(partial(whole.fit, rounds=8), items)
    return sorted(finals, key=lambda fit: fit.cost)


def _promising(
    fitter: Fitter, healthy: Fit, linear: Linear, causes: Sequence[Cause], run: Run
) -> list[tuple[Cause, Floats]]:
    """Return the causes worth a fit, each as often as there are points [units + 1] to begin from.

    By the linear model; where a healthy truck is not enough or a strange one, by fits to a few shifts
    from there, and by the sizes that come near in a usual truck.
    """
    strained = not _is_explained(healthy) or np.max(np.abs(healthy.values)) > STRAINED
    quick = Fitter(fitter.model, _spread(fitter.shifts, QUICK_SHIFTS), fitter.noise)
    usual = usual_starts(quick, causes, COARSE_M[0]) if strained else {}
    base, _point = explained(linear)
    quickly: dict[Cause, Fit] = {}
    if strained:
        items: Items = [
            (cause, np.append(healthy.values, sign))
            for cause in causes
            for sign in ((1.0, -1.0) if cause.sign == 0 else (float(cause.sign),))
        ]
        tried = run(partial(quick.fit, rounds=4), items)
        for fit in sorted(tried, key=lambda fit: fit.cost):
            assert fit.cause is not None
            quickly.setdefault(fit.cause, fit)
    found: list[tuple[float, Cause, list[Floats]]] = []
    for cause in causes:
        cost, point = explained(linear, linear.causes.index(cause))
        gain, starts = base - cost, [np.clip(point, -LARGEST_START, LARGEST_START)]
        if cause.sign * point[-1] < 0.0:
            gain, starts = 0.0, []
        if strained:
            best = quickly[cause]
            found.append((-best.cost, cause, [best.point, *starts]))
        elif gain > WORTH_A_FIT:
            found.append((gain, cause, starts))
    chosen: list[tuple[Cause, list[Floats]]] = []
    ids = Counter[str]()
    for _gain, cause, starts in sorted(found, key=lambda item: -item[0]):
        if len(chosen) < FITTED and ids[cause.effect.id] < 2:
            chosen.append((cause, starts))
            ids[cause.effect.id] += 1
    near = sorted(usual, key=lambda cause: usual[cause][0])[:NEAREST]
    starts_of = dict(chosen) | {cause: [] for cause in near if cause not in dict(chosen)}
    return [
        (cause, point)
        for cause, own in starts_of.items()
        for point in (*own, *([usual[cause][1]] if cause in near else []))
    ]


def _second(fitter: Fitter, fits: Sequence[Fit], causes: Sequence[Cause], run: Run) -> list[Fit]:
    """Return fits of the causes that the linear model favours around the best cause's truck.

    The first ones begin around a healthy truck, which a cause may have made strange: their minima
    are then next to it. Of each cause the better fit is judged.
    """
    best = min(fits, key=lambda fit: fit.cost)
    healthy = next(fit for fit in fits if fit.cause is None)
    if best.cause is None or healthy.cost - best.cost < 0.5 * SEPARABLE:
        return []
    linear = _linear(fitter, fitter.shifts, best, causes)
    points = [(*explained(linear, k), cause) for k, cause in enumerate(causes)]
    points = [item for item in points if item[2].sign * item[1][-1] >= 0.0]
    points = sorted((item for item in points if item[2] is not best.cause), key=lambda i: i[0])
    limit = np.append(np.full(linear.units, FARTHEST), LARGEST_START)
    items: Items = [
        (cause, np.clip(point, -limit, limit)) for _cost, point, cause in points[:SECOND]
    ]
    return run(fitter.fit, items)


def _is_settled(judged: Sequence[Judged], ids: int) -> bool:
    """Return whether no alarm could follow if every cause were as probable as the best one."""
    healthy = _healthy_share(judged)
    best = max((item.probability for item in judged if item.fit.cause is not None), default=0.0)
    return healthy > DOUBTED * (healthy + ids * best)


def _healthy_share(judged: Sequence[Judged]) -> float:
    """Return the probability of a healthy truck."""
    return next(item.probability for item in judged if item.fit.cause is None)


def _second_attempt(
    fitter: Fitter, whole: Fitter, judged: Sequence[Judged], causes: Sequence[Cause], run: Run
) -> list[Judged]:
    """Return the hypotheses, every cause fitted once more before one of them is claimed.

    First to some shifts, from a usual truck, from the healthy one, and from the best cause's; then
    the best variant of each effect to all. What the first search left out need not be worse.
    """
    usual = usual_starts(fitter, causes, COARSE_M[0])
    trucks = [item.fit for item in judged if item.fit.cause is None]
    trucks += [item.fit for item in judged if item.fit.cause is not None][:1]
    items: list[tuple[Cause | None, Floats]] = [(cause, usual[cause][1]) for cause in causes]
    for truck in trucks:
        linear = _linear(fitter, fitter.shifts, truck, causes)
        for k, cause in enumerate(causes):
            size = explained(linear, k)[1][-1]
            if cause is not truck.cause and cause.sign * size >= 0.0:
                start = float(np.clip(size, *cause.sizes(LARGEST_START)))
                items.append((cause, np.append(truck.values, start)))
    first: dict[str, Fit] = {}
    for fit in sorted(run(fitter.fit, items), key=lambda fit: fit.cost):
        assert fit.cause is not None
        first.setdefault(fit.cause.effect.id, fit)
    finals = run(partial(_final, whole), [(fit.cause, fit.point) for fit in first.values()])
    found = {item.fit.cause: item for item in judged}
    for item in map(Judged.of, finals):
        before = found.get(item.fit.cause)
        if before is None or item.cost < before.cost:
            found[item.fit.cause] = item
    return list(found.values())


def _with_rivals(
    whole: Fitter, judged: Sequence[Judged], causes: Sequence[Cause], run: Run
) -> list[Judged]:
    """Return the hypotheses, those that look like the best cause fitted from where that one is."""
    best = next((item for item in judged if item.fit.cause is not None), None)
    if best is None or best.probability < ALARM:
        return list(judged)
    cause, size = best.fit.cause, best.size[0]
    assert cause is not None
    # some of the shifts need not show at all what only a few do, such as a valve that closes late
    linear = linearise(
        whole.model, whole.shifts, best.fit.values, causes, {cause: best.fit.size}, whole.noise
    )
    information = projected(linear)[0]
    found = {item.fit.cause: item for item in judged}
    k = list(causes).index(cause)
    whole_effect = size**2 * float(information[k, k])
    apart: dict[Cause, float] = {}
    items: list[tuple[Cause | None, Floats]] = []
    for j, other in enumerate(causes):
        own, across = max(float(information[j, j]), 1e-12), float(information[k, j])
        start = size * across / own
        left = whole_effect - start**2 * own
        declared = other.effect.id in (*cause.effect.look_alikes, cause.effect.id)
        declared |= cause.effect.id in other.effect.look_alikes
        if j == k or other.sign * start < 0.0 or (left > 4.0 * SEPARABLE and not declared):
            continue
        start = float(np.clip(start, *other.sizes(LARGEST_START)))
        items.append((other, np.append(best.fit.values, start)))
        apart[other] = left
    for fit in run(partial(_final, whole), items):
        rival, item = fit.cause, Judged.of(fit)
        assert rival is not None
        # a minimum does not separate what the information cannot, if that fit is a fit at all
        if apart[rival] < min(SEPARABLE, 0.5 * whole_effect) and item.chi2 < best.chi2 + NEARLY:
            item = replace(item, cost=min(item.cost, best.cost + 0.5 * apart[rival]))
        if rival not in found or item.cost < found[rival].cost:
            found[rival] = item
    return list(found.values())


def _healthy_again(whole: Fitter, judged: Sequence[Judged]) -> list[Judged]:
    """Return the hypotheses, the healthy truck fitted from where the best causes are, too.

    The residual has several minima: what a cause gained by another start is not its merit. A fit
    begins where the truck's quantities take over what the cause does, as far as they can by the
    linear model; if it ends elsewhere, the healthy truck is still no worse than that model says.
    """
    best = next(item for item in judged if item.fit.cause is None)
    causes = [item for item in judged if item.fit.cause is not None]
    for item in [item for item in causes if item.probability > ALARM][:RESTARTS]:
        fit, units = item.fit, item.fit.linear.units
        taken_over = fit.covariance[:units, -1] / fit.covariance[-1, -1] * fit.size
        for start in (fit.values - taken_over, fit.values):
            again = Judged.of(_final(whole, None, np.clip(start, -FARTHEST, FARTHEST)))
            best = again if again.cost < best.cost else best
        variance = float(fit.covariance[-1, -1])
        lost = 0.5 * float(fit.estimate[-1]) ** 2 / variance
        # of a cause that does nothing there, the prior alone is left: the linear model says nothing
        cost = fit.half_chi2 + 0.5 * float(fit.linear.volume.sum()) + lost
        if variance < SHOWN * SIZE_PRIOR**2 and cost < best.cost:
            chi2 = item.chi2 + 2.0 * lost / max(1, int(fit.linear.count.sum()) - units)
            moved = whole.at(None, np.clip(fit.values - taken_over, -FARTHEST, FARTHEST))
            best = replace(best, fit=moved, cost=cost, chi2=min(best.chi2, chi2))
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

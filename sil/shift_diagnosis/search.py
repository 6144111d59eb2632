"""The search for causes: which are fitted, from where, and against which rivals.

The residual of a truck has several minima, so a fit depends on where it begins. Each function adds
fits from other starts: around a healthy truck, in a usual one, and in the truck of the best cause.
Checked by: tests/unit/sil/shift_diagnosis/test_search.py
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Final

import numpy as np

from sil.shift_diagnosis.fit import COARSE_M, FARTHEST, Fit, Fitter
from sil.shift_diagnosis.healthy import is_explained, spread
from sil.shift_diagnosis.linear import (
    SIZE_PRIOR,
    Floats,
    Linear,
    estimates,
    explained,
    linearise,
    projected,
)
from sil.shift_diagnosis.model import Cause
from sil.shift_diagnosis.shifts import RecordedShift
from sil.shift_diagnosis.starts import starts_around
from sil.shift_diagnosis.verdict import (
    ALARM,
    DOUBTED,
    SEPARABLE,
    Judged,
)

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
STARTS: Final = 2
"""Starts of each effect from which it is fitted, of many that a coarse search compares."""
SHOWN: Final = 0.5
"""Share of the prior's variance of a size above which shifts say nothing of it."""
Items = Sequence[tuple[Cause | None, Floats]]
Run = Callable[[Callable[[Cause | None, Floats], Fit], Items], list[Fit]]
"""Fits of causes from their starts, on some processes."""


def linear_at(
    fitter: Fitter, shifts: Sequence[RecordedShift], at: Fit, causes: Sequence[Cause]
) -> Linear:
    """Return shifts linearised around a hypothesis' truck, with the causes' sizes at 0.

    Steps are small: with large ones, what is not linear looks like something that only the cause does.
    """
    noise = replace(fitter.noise, weights=())
    return linearise(fitter.model, shifts, at.values, causes, noise=noise)


def final_fit(whole: Fitter, cause: Cause | None, start: Floats) -> Fit:
    """Return a hypothesis fitted to all shifts, from where the fit to some of them ended.

    start: [units, or units + 1 with a cause's size], prior deviations and typical sizes.
    """
    final = whole.fit(cause, start, rounds=8)
    wide = whole.at(cause, final.point, difference=SECANT).linear
    covariance = estimates(wide.without_cliffs())[1]  # near a kink, slopes claim too much
    if covariance[-1, -1] > final.covariance[-1, -1]:
        final = replace(final, covariance=covariance)
    return final


def close_ones(fits: Sequence[Fit]) -> list[Fit]:
    """Return the healthy truck and the causes that are not hopeless, the best first.

    All are fits to the same shifts with the same noise: else their costs cannot be compared.
    """
    least = min(fit.cost for fit in fits)
    close = [fit for fit in fits if fit.cause is None or fit.cost < least + HOPELESS]
    found: dict[Cause | None, Fit] = {}
    for fit in sorted(close, key=_cost):
        found.setdefault(fit.cause, fit)
    return list(found.values())


def on_all(whole: Fitter, fits: Sequence[Fit], run: Run) -> list[Fit]:
    """Return the leading hypotheses, of fits to some shifts in order, on all shifts, best first."""
    items: Items = [(fit.cause, fit.point) for fit in fits[:LEADING]]
    finals = run(partial(whole.fit, rounds=8), items)
    return sorted(finals, key=_cost)


def promising(
    fitter: Fitter, healthy: Fit, linear: Linear, causes: Sequence[Cause], run: Run
) -> list[tuple[Cause, Floats]]:
    """Return the causes worth a fit, each as often as there are points [units + 1] to begin from.

    By the linear model; where a healthy truck is not enough or a strange one, by fits to a few shifts
    from there, and by the sizes that come near in a usual truck.
    """
    strained = not is_explained(healthy) or np.max(np.abs(healthy.values)) > STRAINED
    quick = Fitter(fitter.model, spread(fitter.shifts, QUICK_SHIFTS), fitter.noise)
    usual = starts_around(quick, causes, COARSE_M[0]) if strained else {}
    base, _point = explained(linear)
    quickly: dict[Cause, Fit] = {}
    if strained:
        items: Items = [
            (cause, np.append(healthy.values, sign))
            for cause in causes
            for sign in ((1.0, -1.0) if cause.sign == 0 else (float(cause.sign),))
        ]
        tried = run(partial(quick.fit, rounds=4), items)
        for fit in sorted(tried, key=_cost):
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
    near = sorted(usual, key=lambda cause: usual[cause][0][0])[:NEAREST]
    starts_of = dict(chosen) | {cause: [] for cause in near if cause not in dict(chosen)}
    return [
        (cause, point)
        for cause, own in starts_of.items()
        for point in (*own, *([usual[cause][0][1]] if cause in near else []))
    ]


def around_best(
    fitter: Fitter, fits: Sequence[Fit], causes: Sequence[Cause], run: Run
) -> list[Fit]:
    """Return fits of the causes that the linear model favours around the best cause's truck.

    The first ones begin around a healthy truck, which a cause may have made strange: their minima
    are then next to it. Of each cause the better fit is judged.
    """
    best = min(fits, key=_cost)
    healthy = next(fit for fit in fits if fit.cause is None)
    if best.cause is None or healthy.cost - best.cost < 0.5 * SEPARABLE:
        return []
    linear = linear_at(fitter, fitter.shifts, best, causes)
    points = [(*explained(linear, k), cause) for k, cause in enumerate(causes)]
    points = [item for item in points if item[2].sign * item[1][-1] >= 0.0]
    points = sorted((item for item in points if item[2] is not best.cause), key=lambda i: i[0])
    limit = np.append(np.full(linear.units, FARTHEST), LARGEST_START)
    items: Items = [
        (cause, np.clip(point, -limit, limit)) for _cost, point, cause in points[:SECOND]
    ]
    return run(fitter.fit, items)


def is_settled(judged: Sequence[Judged], ids: int) -> bool:
    """Return whether no alarm could follow if every cause were as probable as the best one."""
    healthy = healthy_share(judged)
    best = max((item.probability for item in judged if item.fit.cause is not None), default=0.0)
    return healthy > DOUBTED * (healthy + ids * best)


def healthy_share(judged: Sequence[Judged]) -> float:
    """Return the probability of a healthy truck."""
    return next(item.probability for item in judged if item.fit.cause is None)


def second_attempt(
    fitter: Fitter, whole: Fitter, judged: Sequence[Judged], causes: Sequence[Cause], run: Run
) -> list[Judged]:
    """Return the hypotheses, every cause fitted once more before one of them is claimed.

    From a usual truck, from the healthy one, and from the best cause's: to a few shifts, the best
    starts of each effect to more, and the best variant of those that are not hopeless to all. What
    the first search left out need not be worse.
    """
    usual = starts_around(fitter, causes, COARSE_M[0])
    trucks = [item.fit for item in judged if item.fit.cause is None]
    trucks += [item.fit for item in judged if item.fit.cause is not None][:1]
    items: list[tuple[Cause | None, Floats]] = [(cause, usual[cause][0][1]) for cause in causes]
    for truck in trucks:
        linear = linear_at(fitter, fitter.shifts, truck, causes)
        for k, cause in enumerate(causes):
            size = explained(linear, k)[1][-1]
            if cause is not truck.cause and cause.sign * size >= 0.0:
                start = float(np.clip(size, *cause.sizes(LARGEST_START)))
                items.append((cause, np.append(truck.values, start)))
    quick = Fitter(fitter.model, spread(fitter.shifts, QUICK_SHIFTS), fitter.noise)
    best = _best_of_each(run(partial(quick.fit, rounds=4), items), STARTS)
    best = _best_of_each(run(fitter.fit, [(fit.cause, fit.point) for fit in best]), 1)
    close = [fit for fit in best if fit.cost < min(best, key=_cost).cost + HOPELESS]
    finals = run(partial(final_fit, whole), [(fit.cause, fit.point) for fit in close])
    found = {item.fit.cause: item for item in judged}
    for item in map(Judged.of, finals):
        before = found.get(item.fit.cause)
        if before is None or item.cost < before.cost:
            found[item.fit.cause] = item
    return list(found.values())


def _cost(fit: Fit) -> float:
    return fit.cost


def _best_of_each(fits: Sequence[Fit], most: int) -> list[Fit]:
    """Return at most so many fits of each effect, those of the least cost."""
    found: dict[str, list[Fit]] = {}
    for fit in sorted(fits, key=_cost):
        assert fit.cause is not None
        found.setdefault(fit.cause.effect.id, []).append(fit)
    return [fit for own in found.values() for fit in own[:most]]


def with_rivals(
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
    for fit in run(partial(final_fit, whole), items):
        rival, item = fit.cause, Judged.of(fit)
        assert rival is not None
        # a minimum does not separate what the information cannot, if that fit is a fit at all
        if apart[rival] < min(SEPARABLE, 0.5 * whole_effect) and item.chi2 < best.chi2 + NEARLY:
            item = replace(item, cost=min(item.cost, best.cost + 0.5 * apart[rival]))
        if rival not in found or item.cost < found[rival].cost:
            found[rival] = item
    return list(found.values())


def healthy_again(whole: Fitter, judged: Sequence[Judged]) -> list[Judged]:
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
            again = Judged.of(final_fit(whole, None, np.clip(start, -FARTHEST, FARTHEST)))
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

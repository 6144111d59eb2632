"""What the shifts of a truck would show: the least size of each cause, and what looks the same.

Shifts of such a truck with the cause are simulated, and a healthy truck is fitted to them: from where it was,
while the cause grows, and anew at several supplies. A cause is noticed if its evidence against that one is
enough for an alarm in nine of ten trucks.
Checked by: tests/unit/sil/inference/truck/test_detectable.py
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from math import log, sqrt
from typing import Final

import numpy as np

from sil.inference.problem import Floats
from sil.inference.thresholds import LIMITS
from sil.inference.truck.causes import Cause
from sil.inference.truck.fit import FINE_M, MIDDLE_M, Fit, Fitter
from sil.inference.truck.gains import Beside, secants
from sil.inference.workers import spread_out


@dataclass(frozen=True)
class Tested:
    """What counts as noticed, and which sizes are tested; sizes in typical ones."""

    sure: float = 1.28
    """Standard deviations of the evidence for 90 % certainty."""
    separable: float = 9.0
    """Chi squared by which two causes differ that can be told apart: three standard deviations."""
    largest_rival: float = 10.0
    """Size up to which another cause is tried: three deviations of a size's prior."""
    first: float = 0.8
    """First size, by that of a linear model, ..."""
    least: float = 0.25
    """... and at least this; ..."""
    growth: tuple[float, float] = (1.25, 3.0)
    """... limits of the factor to the next."""
    tries: int = 6
    largest: float = 20.0
    """Largest size tried."""
    rounds: int = 8
    """Of a healthy truck's fit, ..."""
    shares: tuple[float, ...] = (0.33, 0.67, 1.0)
    """... which also follows the cause through these shares of its size, ..."""
    rounds_each: int = 4
    """... with so many rounds at each."""
    supplies: tuple[float, ...] = (0.0, -2.0)
    """Supplies at which it begins anew, in standard deviations, ..."""
    rounds_anew: tuple[int, int] = (10, 8)
    """... with so many rounds at a larger error of the model, and at its own."""
    shifts: int = 6
    """Shifts that are tested; of more, each stands for its share."""
    tiny: float = 1e-6
    """Least information of a cause."""


TESTED: Final = Tested()


@dataclass(frozen=True)
class Detectable:
    """What the bus shows of a cause: the least size that it would show, and what looks the same.

    size: in typical ones, noticed in nine of ten trucks; None: at no size. alike: ids of causes that cannot
    be distinguished from it at its size or the typical one, whichever is larger; none if at no size.
    """

    cause: Cause
    size: float | None
    alike: tuple[str, ...]

    @property
    def value(self) -> float | None:
        """The size in the unit of the cause's parameter."""
        return None if self.size is None else self.cause.value(self.size)


def detectable_of(
    fitter: Fitter, fit: Fit, causes: Sequence[Cause], workers: int = 1
) -> list[Detectable]:
    """Return what shifts like these would show of each effect in its first variant, in a truck as fitted."""
    tested = np.unique(np.linspace(0, len(fitter.model) - 1, TESTED.shifts).round().astype(int))
    share = len(tested) / len(fitter.model)
    if share < 1.0:
        fitter = Fitter(fitter.model.only(tested), fitter.measured_noise_m)
    # beside a cause the loads may differ between shifts again, whatever they do in this truck
    spread = np.maximum(fit.spread, 1.0)
    truck = replace(fit, noise_factor=1.0, spread=spread, each=fit.each[tested])
    truck = fitter.evaluated(truck, FINE_M)
    if share < 1.0:
        fitter.reference = fitter.slopes(truck)
    first: dict[str, Cause] = {}
    for cause in causes:
        first.setdefault(cause.id, cause)
    kept = list(first.values())
    slopes = np.array([secants(fitter, truck, c, [float(c.sign or 1)])[0] for c in kept])
    information = Beside.of(fitter, truck).information(slopes)[0] / share
    odds = LIMITS.healthy_prior / (1.0 - LIMITS.healthy_prior) * len(kept)
    odds *= (1.0 - LIMITS.max_healthy_probability) / LIMITS.max_healthy_probability
    # gain - TESTED.sure sqrt(2 gain) = log(odds)
    gain = 0.5 * (TESTED.sure + sqrt(TESTED.sure**2 + 2.0 * log(odds))) ** 2

    def noticed(k: int) -> float | None:
        information_kk = max(float(information[k, k]), TESTED.tiny)
        # a linear cause gains size^2 information / 2
        size = max(TESTED.first * sqrt(2.0 * gain / information_kk), TESTED.least)
        size *= kept[k].sign or 1
        for _ in range(TESTED.tries):
            if kept[k].clipped(size) != size or abs(size) > TESTED.largest:
                return None
            there = gain_of(fitter, truck, kept[k], size, share * gain) / share
            if there > gain:
                return size
            low, high = TESTED.growth
            size *= min(max(sqrt(gain / max(there, TESTED.tiny)), low), high)
        return None

    sizes = spread_out(noticed, range(len(kept)), workers)
    rows = zip(kept, sizes, range(len(kept)), strict=True)
    return [
        Detectable(cause, size, () if size is None else _alike(information, kept, k, size))
        for cause, size, k in rows
    ]


def gain_of(
    fitter: Fitter, truck: Fit, cause: Cause, size: float, enough: float = -np.inf
) -> float:
    """Return the log evidence for a cause against a healthy truck, in shifts of `truck` with it of a size.

    Infinite if such shifts cannot be simulated; at most `enough` it is a bound from above.
    """
    with_cause = replace(truck, cause=cause, size=size)
    seen = _with_positions(fitter, with_cause)
    if seen is None:
        return float("inf")
    with_cause = seen.evaluated(with_cause, FINE_M)
    starts: list[Callable[[], Fit]] = [
        lambda: seen.improved(truck, FINE_M, TESTED.rounds),
        lambda: seen.improved(_followed(fitter, with_cause), FINE_M, TESTED.rounds),
        *(partial(_begun_anew, seen, truck, supply) for supply in TESTED.supplies),
    ]
    best = replace(truck, cost=np.inf)
    for begun in starts:
        best = min(best, begun(), key=seen.whole_cost)
        # evidence gains less than the cost falls: a cause pays for its size
        if best.cost - with_cause.cost <= enough:
            return best.cost - with_cause.cost
    rng = np.random.default_rng(1)
    healthy, faulty = (seen.finished(fit, rng, times=1) for fit in (best, with_cause))
    return faulty.evidence - healthy.evidence


def _followed(fitter: Fitter, with_cause: Fit) -> Fit:
    """Return a healthy truck fitted again and again while the cause grows: at once, it is stuck on the way."""
    rng = np.random.default_rng(1)
    fit = replace(with_cause, cause=None, size=0.0)
    for share in TESTED.shares:
        seen = _with_positions(fitter, replace(with_cause, size=share * with_cause.size))
        if seen is not None:
            fit = seen.improved(fit, FINE_M, TESTED.rounds_each)
    assert seen is not None
    return seen.improved(seen.rescanned(fit, MIDDLE_M, rng), MIDDLE_M, TESTED.rounds)


def _begun_anew(seen: Fitter, truck: Fit, supply: float) -> Fit:
    """Return a healthy truck fitted from a usual one at a supply in standard deviations, with the spread of `truck`."""
    rng, fit = np.random.default_rng(1), replace(seen.start(), spread=truck.spread)
    fit.unit[seen.layout.at["supply"]] = supply
    wide, fine = TESTED.rounds_anew
    fit = seen.improved(seen.rescanned(fit, MIDDLE_M, rng), MIDDLE_M, wide)
    return seen.improved(fit, FINE_M, fine)


def _with_positions(fitter: Fitter, fit: Fit) -> Fitter | None:
    """Return a fitter that sees the positions of another truck; None if they cannot be simulated."""
    which = np.arange(len(fitter.model))
    amounts = fitter.layout.amounts(fit.unit, fit.each)
    positions_m, done = fitter.model.positions(which, amounts, fit.cause, fit.size)
    if not done.all():
        return None
    seen = copy.copy(fitter)
    seen.position_m = positions_m
    return seen


def _alike(information: Floats, causes: Sequence[Cause], k: int, size: float) -> tuple[str, ...]:
    """Return the ids of causes that cannot be told from cause k."""
    tested = max(abs(size), 1.0) * (causes[k].sign or 1)
    apart = distances(information, causes, k, tested).tolist()
    pairs = zip(causes, apart, strict=True)
    return tuple(
        other.id for other, by in pairs if by < TESTED.separable and other is not causes[k]
    )


def distances(information: Floats, causes: Sequence[Cause], k: int, size: float) -> Floats:
    """Return how far [causes] cause k of a size a is from each, of that one's best size b.

    d = a^2 I_kk - 2 a b I_kj + b^2 I_jj, in chi squared, with the truck's own quantities marginalised;
    b is physical and at most TESTED.largest_rival. information: [causes, causes]; size: in typical ones. Where
    both signs of cause k are physical, the nearer one counts.
    """
    out = np.empty(len(causes))
    for j, other in enumerate(causes):
        own, across = max(float(information[j, j]), 1e-12), float(information[k, j])
        low, high = other.bounds
        low, high = max(low, -TESTED.largest_rival), min(high, TESTED.largest_rival)
        signed = (size,) if causes[k].sign else (size, -size)
        best = [(a, min(max(a * across / own, low), high)) for a in signed]
        out[j] = min(
            a * a * float(information[k, k]) - 2.0 * a * b * across + b * b * own for a, b in best
        )
    return out

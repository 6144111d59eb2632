"""What the shifts of a truck would show: the least size of each cause, and what looks the same.

The size follows from the information in the shifts, and is tested by a fit: shifts of such a truck with the
cause are simulated, and a healthy truck is fitted to them. A cause is noticed if what that leaves is enough
for an alarm in nine of ten trucks.
Checked by: tests/unit/sil/inference/truck/test_detectable.py
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import log, sqrt
from typing import Final

import numpy as np

from sil.inference.problem import Floats
from sil.inference.thresholds import LIMITS
from sil.inference.truck.causes import Cause
from sil.inference.truck.fit import FINE_M, PRIORS, Fit, Fitter
from sil.inference.truck.gains import Beside, secants
from sil.inference.workers import spread_out


@dataclass(frozen=True)
class Tested:
    """What counts as noticed, and which sizes are tested; sizes in typical ones.

    sure: standard deviations of the evidence for 90 % certainty; separable: chi squared by which two causes
    differ that can be told apart, three standard deviations; largest_rival: size up to which another cause
    is tried: three deviations of a size's prior; first: the first size by that of a linear model, growth to
    the next, at most `tries` and up to `largest`; rounds of each fit; tiny: least information of a cause.
    """

    sure: float = 1.28
    separable: float = 9.0
    largest_rival: float = 10.0
    first: float = 0.8
    growth: float = 1.6
    tries: int = 4
    largest: float = 20.0
    rounds: int = 8
    tiny: float = 1e-6


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
    # beside a cause the loads may differ between shifts again, whatever they do in this truck
    spread = np.maximum(fit.spread, 1.0)
    truck = replace(fit, cause=None, size=0.0, noise_factor=1.0, spread=spread)
    truck = fitter.evaluated(truck, FINE_M)
    first: dict[str, Cause] = {}
    for cause in causes:
        first.setdefault(cause.id, cause)
    own = list(first.values())
    slopes = np.array([secants(fitter, truck, c, [float(c.sign or 1)])[0] for c in own])
    information = Beside.of(fitter, truck).information(slopes)[0]
    prior = log(LIMITS.healthy_prior / (1.0 - LIMITS.healthy_prior) * len(own))
    alarm = log((1.0 - LIMITS.max_healthy_probability) / LIMITS.max_healthy_probability)

    usual = _seeing(fitter, truck.position_m)
    least = usual.improved(truck, FINE_M, TESTED.rounds).cost

    def noticed(k: int) -> float | None:
        own_information = max(float(information[k, k]), TESTED.tiny)
        needed = prior + alarm + 0.5 * log(1.0 + own_information * PRIORS.size_sd**2)
        # gain - TESTED.sure sqrt(2 gain) = needed; a linear cause gains size^2 information / 2
        gain = 0.5 * (TESTED.sure + sqrt(TESTED.sure**2 + 2.0 * needed)) ** 2
        size = TESTED.first * sqrt(2.0 * gain / own_information) * (own[k].sign or 1)
        for _ in range(TESTED.tries):
            if own[k].clipped(size) != size or abs(size) > TESTED.largest:
                return None
            if fitted_cost(fitter, truck, own[k], size, least + gain) - least > gain:
                return size
            size *= TESTED.growth
        return None

    sizes = spread_out(noticed, range(len(own)), workers)
    rows = zip(own, sizes, range(len(own)), strict=True)
    return [
        Detectable(cause, size, () if size is None else _alike(information, own, k, size))
        for cause, size, k in rows
    ]


def fitted_cost(
    fitter: Fitter, truck: Fit, cause: Cause, size: float, enough: float = -np.inf
) -> float:
    """Return the cost, down to `enough`, of a healthy truck fitted to shifts of `truck` with a cause of a size."""
    which = np.arange(len(fitter.model))
    amounts = fitter.layout.amounts(truck.unit, truck.each)
    x, done = fitter.model.positions(which, amounts, cause, size)
    if not done.all():
        return float("inf")
    return _seeing(fitter, x).improved(truck, FINE_M, TESTED.rounds, enough=enough).cost


def _seeing(fitter: Fitter, position_m: Floats | None) -> Fitter:
    """Return a fitter for which other positions were recorded."""
    assert position_m is not None
    other = copy.copy(fitter)
    other.position_m = position_m
    return other


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

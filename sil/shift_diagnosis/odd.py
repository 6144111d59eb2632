"""Shifts that fit far worse than the others: by their own scatter, or by something unexplained.

The scatter of a shift is marginalised with slopes. A stay that leaves the synchronizer, or arrives,
some milliseconds sooner than the model has another position at one pulse, of which the slope there
says nothing. So what an odd shift's own quantities explain is found without slopes.
Checked by: tests/unit/sil/shift_diagnosis/test_odd.py
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import erfc, sqrt
from pathlib import Path
from typing import Final

import numpy as np

from sil.shift_diagnosis.evolution import evolved
from sil.shift_diagnosis.fit import UNABLE, Fit, Fitter
from sil.shift_diagnosis.linear import LOAD_SHARE, Floats, Linear, linearise, point_of
from sil.shift_diagnosis.loads import BARRIERS, CONE
from sil.shift_diagnosis.model import JITTER_S, LEAST_NOISE_M, Point
from sil.shift_diagnosis.shifts import RecordedShift

ODD, MOST_ODD = 3.0, 0.15
"""Chi squared per number, of the shifts' median, from which a shift is odd; and how many may be."""
IMPULSES: Final[Floats] = np.linspace(-3.5, 3.5, 29)
"""Deviations of a cone's impulse that an odd shift is tried with, in standard deviations."""
UNUSUAL: Final = 1e-3
"""Probability below which as many deviations as large are no scatter."""
RARE: Final = 30.0
"""Chi squared of a shift's own quantities that one shift in ten thousand exceeds."""
GENERATIONS: Final = 60


def _limit(linear: Linear) -> tuple[Floats, float]:
    """Return chi squared per number of each shift [n], and from which one a shift is odd."""
    each = linear.misfit / np.maximum(linear.count, 1)
    return each, ODD * max(1.0, float(np.median(each)))


def own_impulses(
    fitter: Fitter, healthy: Fit, shifts: Sequence[RecordedShift]
) -> list[RecordedShift]:
    """Return the shifts, those odd ones into gear with the impulse of their own that explains them.

    Where another one, within its scatter, does; all as they were, where more are odd, or by more,
    than scatter makes.
    """
    model, noise = fitter.model, fitter.noise
    linear = linearise(model, shifts, healthy.values, noise=noise)
    each, limit = _limit(linear)
    into_gear = [k for k, shift in enumerate(shifts) if shift.end in "BF"]
    found, deviations = list(shifts), list[float]()
    for k in into_gear:
        if each[k] <= limit:
            continue
        sd = model.each[f"cone_{shifts[k].end}"]
        speeds = shifts[k].difference_rad_s * np.exp(sd * IMPULSES)
        tried = [replace(shifts[k], difference_rad_s=float(speed)) for speed in speeds]
        own = linearise(model, tried, healthy.values, noise=noise)
        costs = np.where(own.count > 0, own.misfit + IMPULSES**2, np.inf)
        best = int(np.argmin(costs))
        if costs[best] < limit * own.count[best]:
            found[k] = tried[best]
            deviations.append(float(IMPULSES[best]))
    return found if is_usual(deviations, len(into_gear)) else list(shifts)


def is_usual(deviations: Sequence[float], count: int) -> bool:
    """Return whether the largest of so many normal deviations may be these."""
    from scipy.special import bdtrc

    largest = sorted(map(abs, deviations), reverse=True)
    return all(bdtrc(j, count, erfc(size / sqrt(2.0))) > UNUSUAL for j, size in enumerate(largest))


def without_odd(best: Fit, fitter: Fitter) -> tuple[tuple[Floats, ...], list[int]]:
    """Return the weights [pulses, pulses] of each shift in 1/m2, and which shifts are unexplained.

    Those are few that fit far worse than most although their own quantities may differ, and all that
    cannot be simulated. Every odd shift counts less, those that its own quantities explain, too.
    """
    linear = best.linear
    each, limit = _limit(linear)
    odd, unable = each > limit, linear.count == 0
    for k in np.flatnonzero(odd).tolist() if odd.sum() <= 2.0 * MOST_ODD * len(each) else []:
        odd[k] = not is_scatter(fitter, best, k, limit)
    if odd.sum() > MOST_ODD * len(each):
        return linear.weights, np.flatnonzero(unable).tolist()
    shares = np.minimum(1.0, limit / np.maximum(each, limit))
    weights = tuple(s * w for s, w in zip(shares, linear.weights, strict=True))
    return weights, np.flatnonzero(odd | unable).tolist()


def is_scatter(fitter: Fitter, best: Fit, k: int, limit: float) -> bool:
    """Return whether shift k is explained, up to a chi squared per number, by its own quantities.

    Those are the model's of a shift, with all of their scatter, and its loads where those differ from
    shift to shift; together no more unusual than RARE.
    """
    model, shift = fitter.model, fitter.shifts[k]
    sds = model.each | {name: LOAD_SHARE * model.unit[name] for name in fitter.noise.loads}
    active = () if best.cause is None else ((best.cause, best.size),)
    point = Point(point_of(model, fitter.names, best.values), active)
    acting = {"pull"} if shift.end == "N" else {"mesh", f"cone_{shift.end}"}
    names = [name for name in sds if name not in {*BARRIERS, *CONE} - acting]

    def costs(own: list[Floats]) -> Floats:
        points = []
        for z in own:
            moved = point
            for name, by in zip(names, z.tolist(), strict=True):
                moved = moved.moved(name, by * sds[name])
            points.append(moved)
        x, v, done = model.predict([shift], points)
        variance = max(fitter.noise.position_m, LEAST_NOISE_M) ** 2 + (JITTER_S * v[0]) ** 2
        misfit = np.sum((shift.position_m - x[0]) ** 2 / variance, axis=1)
        unusual: Floats = np.sum(np.array(own) ** 2, axis=1)
        found: Floats = np.where(done[0], misfit + unusual, UNABLE)
        return np.nan_to_num(found, nan=UNABLE)

    zeros = np.zeros(len(names))
    found = evolved(
        costs, zeros, 10.0 * np.eye(len(names)), GENERATIONS, 60
    )  # as wide as the scatter
    return bool(found @ found < RARE and costs([found])[0] < limit * len(shift.time_s))


def with_odd(
    verdict: str, findings: Sequence[str], shifts: Sequence[RecordedShift], odd: Sequence[int]
) -> tuple[str, list[str]]:
    """Return verdict and findings of shifts some of which are odd: they are not consistent."""
    names = ", ".join(f"{shifts[k].begin_s:.2f} s of {Path(shifts[k].source).name}" for k in odd)
    text = (
        f"{len(odd)} of {len(shifts)} shifts fit far worse than the others, or cannot be "
        f"simulated, and count less; they begin at {names}"
    )
    return ("cannot_tell" if verdict == "consistent" else verdict), [text, *findings]

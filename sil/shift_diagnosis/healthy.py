"""The healthy truck of recorded shifts: its loads, its noise, and the shifts that do not fit it.

Checked by: tests/unit/sil/shift_diagnosis/test_healthy.py
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from sil.shift_diagnosis.fit import Fit, Fitter
from sil.shift_diagnosis.linear import (
    Floats,
    Noise,
    unit_names,
)
from sil.shift_diagnosis.loads import BARRIERS, CONE, own_loads, vary, without_speeds
from sil.shift_diagnosis.model import LEAST_NOISE_M, PlantModel
from sil.shift_diagnosis.shifts import LEAD_S, Shift
from sil.shift_diagnosis.verdict import (
    EXPLAINED,
)

FIT_SHIFTS: Final = 12
"""Shifts that a hypothesis is fitted to before all judge it."""
SCANS: Final = 2
"""Rounds of loads found and a healthy truck fitted with them."""
ODD, MOST_ODD = 3.0, 0.15
"""Chi squared per number, of the shifts' median, from which a shift is odd; and how many may be."""


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


def is_explained(fit: Fit) -> bool:
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
        found = [(*healthy_fit(models, spread(used, FIT_SHIFTS), noise), list(used))]
        if is_explained(found[0][1]):
            return found[0]
    for free in (CONE if silent else BARRIERS, BARRIERS + CONE):
        for model in models if silent else [found[0][0].model]:
            own, values = list(used), np.zeros(len(unit_names(model)))
            for _ in range(SCANS):
                own = own_loads(model, own, values, free)
                few = spread(own, FIT_SHIFTS)
                fitter, healthy = healthy_fit([model], few, replace(noise, loads=free))
                values = healthy.values
            if silent or vary(own, used):
                found.append((fitter, healthy, own))
        best = min(found, key=lambda item: item[1].cost, default=None)
        if best is not None and is_explained(best[1]):
            break
    assert best is not None
    return best


def without_odd(best: Fit) -> tuple[tuple[Floats, ...], list[int]]:
    """Return the weights [pulses, pulses] of each shift in 1/m2, and which shifts count less.

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


def with_odd(
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


def spread(shifts: Sequence[Shift], most: int) -> list[Shift]:
    """Return at most so many shifts, evenly spread, of those between two gears their share.

    Into gear and out of it come in turn: every second shift would be of one kind.
    """
    if len(shifts) <= most:
        return list(shifts)
    # stable: in time among shifts between the same gears
    order = sorted(range(len(shifts)), key=lambda k: (shifts[k].start, shifts[k].end))
    taken = np.linspace(0, len(shifts) - 1, most).round().astype(int)
    return [shifts[k] for k in sorted(order[at] for at in taken)]

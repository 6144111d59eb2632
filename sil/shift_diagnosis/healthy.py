"""The healthy truck of recorded shifts: its loads and its noise.

Checked by: tests/unit/sil/shift_diagnosis/test_healthy.py
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from sil.shift_diagnosis.fit import Fit, Fitter
from sil.shift_diagnosis.linear import (
    Noise,
    unit_names,
)
from sil.shift_diagnosis.loads import BARRIERS, CONE, own_loads, vary, without_speeds
from sil.shift_diagnosis.model import LEAST_NOISE_M, PlantModel
from sil.shift_diagnosis.odd import own_impulses
from sil.shift_diagnosis.shifts import LEAD_S, RecordedShift
from sil.shift_diagnosis.verdict import (
    EXPLAINED,
)

FIT_SHIFTS: Final = 12
"""Shifts that a hypothesis is fitted to before all judge it."""
SCANS: Final = 2
"""Rounds of loads found and a healthy truck fitted with them."""


def healthy_fit(
    models: Sequence[PlantModel], shifts: Sequence[RecordedShift], noise: Noise
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
    models: Sequence[PlantModel], used: Sequence[RecordedShift], noise: Noise
) -> tuple[Fitter, Fit, list[RecordedShift]]:
    """Fit a healthy truck; return it with the shifts, which have loads of their own where needed.

    That is without speeds in the log, or where a truck with equal loads does not explain its shifts
    and loads that differ explain them better; and of few odd shifts the impulse, if that suffices.
    """
    silent = without_speeds(used)
    found: list[tuple[Fitter, Fit, list[RecordedShift]]] = []
    if not silent:
        found = [(*healthy_fit(models, spread(used, FIT_SHIFTS), noise), list(used))]
        fitter, healthy, own = found[0]
        for _ in range(SCANS):
            if is_explained(healthy):
                break
            own = own_impulses(fitter, healthy, used)
            if all(now is old for now, old in zip(own, used, strict=True)):
                break
            fitter, healthy = healthy_fit([fitter.model], spread(own, FIT_SHIFTS), noise)
        if is_explained(healthy):
            return fitter, healthy, own
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


def rest_noise_m(shifts: Sequence[RecordedShift]) -> float:
    """Return the standard deviation of a position before the first motion, at least the timer's [m]."""
    rests = [s.position_m[s.time_s < LEAD_S] for s in shifts]
    own = [(r - np.mean(r)) ** 2 * len(r) / (len(r) - 1) for r in rests if len(r) > 1]
    if not own:
        return LEAST_NOISE_M
    squares = np.concatenate(own)
    return float(max(LEAST_NOISE_M, np.sqrt(np.mean(squares))))


def spread(shifts: Sequence[RecordedShift], most: int) -> list[RecordedShift]:
    """Return at most so many shifts, evenly spread, of those between two gears their share.

    Into gear and out of it come in turn: every second shift would be of one kind.
    """
    if len(shifts) <= most:
        return list(shifts)
    # stable: in time among shifts between the same gears
    order = sorted(range(len(shifts)), key=lambda k: (shifts[k].start, shifts[k].end))
    taken = np.linspace(0, len(shifts) - 1, most).round().astype(int)
    return [shifts[k] for k in sorted(order[at] for at in taken)]

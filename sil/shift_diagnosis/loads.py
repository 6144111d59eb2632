"""Loads of single shifts: barrier of the teeth and impulse of the cone, where no signal gives them.

What the shifts of a truck have in common is fitted with one barrier into and one out of gear, and the
impulse from the speed difference. Where that does not explain them, or the log has no speeds, each
shift gets loads of its own, found by scans, and what they can do is taken out of its residual.
Checked by: tests/unit/sil/shift_diagnosis/test_loads.py
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from sil.shift_diagnosis.linear import Floats, point_of, unit_names
from sil.shift_diagnosis.model import IMPULSE_PER_SPEED, PlantModel, Point
from sil.shift_diagnosis.shifts import RecordedShift

BARRIERS: Final = ("mesh", "pull")
CONE: Final = ("cone_B", "cone_F")
LARGEST_N_S: Final = 150.0
"""Largest impulse of a cone that is tried."""
RANGE_N: Final = 900.0
"""Deviation of a barrier from the truck's up to which it is tried."""
USUAL_N: Final = 300.0
"""Standard deviation of a barrier between shifts that is assumed in a scan."""
UNEQUAL_N, UNEQUAL = 120.0, 0.2
"""Standard deviations of barriers, and of impulses' logarithms, from which loads differ."""
LITTLE_RAD_S: Final = 0.5
STEPS: Final = 13
ROUNDS: Final = 4
NARROWER: Final = 0.3
"""Share of its range that a scan leaves to the next."""
TOLERANCE_M, TOLERANCE_S = 1e-4, 5e-4
"""What a pulse may be off in a scan, by position and by time."""


def with_speeds(shifts: Sequence[RecordedShift], skipped: Counter[str]) -> list[RecordedShift]:
    """Return the shifts less those few that lack speeds, which `skipped` counts.

    Where half or more of those into gear lack them, all stay, as shifts of a log without speeds.
    """
    into_gear = sum(shift.end in "BF" for shift in shifts)
    lacking = sum(bool(np.isnan(shift.difference_rad_s)) for shift in shifts)
    if not 0 < 2 * lacking < into_gear:
        return list(shifts)
    skipped["into gear without speeds"] += lacking
    return [shift for shift in shifts if not np.isnan(shift.difference_rad_s)]


def without_speeds(shifts: Sequence[RecordedShift]) -> bool:
    """Return whether speeds are missing for some of the shifts."""
    return any(np.isnan(shift.difference_rad_s) for shift in shifts)


def own_loads(
    model: PlantModel, shifts: Sequence[RecordedShift], values: Floats, free: Sequence[str]
) -> list[RecordedShift]:
    """Return the shifts with the loads, of those that are free, that suit each best.

    values: of the truck's quantities [units], in prior standard deviations.
    """
    if not free:
        return list(shifts)
    point = Point(point_of(model, unit_names(model), values))
    return [_scanned(model, shift, point, free) for shift in shifts]


def _scanned(
    model: PlantModel, shift: RecordedShift, point: Point, free: Sequence[str]
) -> RecordedShift:
    """Return a shift with its best loads: impulse and barrier are scanned in turn, ever closer."""
    into_gear = shift.end in "BF"
    impulse = 0.5 * LARGEST_N_S
    best = replace(shift, load_n=0.0)
    if np.isnan(best.difference_rad_s):
        best = replace(best, difference_rad_s=impulse / IMPULSE_PER_SPEED)  # where the scan begins
    wide = 1.0
    for _ in range(ROUNDS):
        if into_gear and f"cone_{shift.end}" in free:
            tried = np.maximum(
                impulse + wide * 0.5 * LARGEST_N_S * np.linspace(-1.0, 1.0, STEPS), 0
            )
            variants = [replace(best, difference_rad_s=float(j / IMPULSE_PER_SPEED)) for j in tried]
            best = _nearest(model, best, variants, point)
            impulse = abs(best.difference_rad_s) * IMPULSE_PER_SPEED
        if ("mesh" if into_gear else "pull") in free:
            offsets = best.load_n + wide * RANGE_N * np.linspace(-1.0, 1.0, STEPS)
            variants = [replace(best, load_n=float(n)) for n in offsets]
            best = _nearest(model, best, variants, point)
        wide *= NARROWER
    return best


def _nearest(
    model: PlantModel, shift: RecordedShift, variants: Sequence[RecordedShift], point: Point
) -> RecordedShift:
    """Return that of variants of `shift` whose motion comes nearest; itself if none can be simulated."""
    x, v, done = model.predict(variants, [point])
    if not done.any():
        return shift
    tolerance = TOLERANCE_M**2 + (TOLERANCE_S * v[:, 0]) ** 2
    misfit: Floats = np.log1p((shift.position_m - x[:, 0]) ** 2 / tolerance).sum(axis=1)
    misfit += 0.5 * np.array([shift.load_n / USUAL_N for shift in variants]) ** 2
    return variants[int(np.argmin(np.where(done[:, 0], misfit, np.inf)))]


def vary(shifts: Sequence[RecordedShift], before: Sequence[RecordedShift]) -> bool:
    """Return whether loads found differ between shifts beyond what all of them have in common.

    before: the same shifts with the speeds as recorded.
    """
    into = [s.end in "BF" for s in shifts]
    for gear in (True, False):
        own = [s.load_n for s, is_into in zip(shifts, into, strict=True) if is_into == gear]
        if len(own) > 1 and np.std(own) > UNEQUAL_N:
            return True
    pairs = [
        (abs(now.difference_rad_s) + LITTLE_RAD_S, abs(old.difference_rad_s) + LITTLE_RAD_S)
        for now, old, is_into in zip(shifts, before, into, strict=True)
        if is_into
    ]
    ratios = np.log([now / old for now, old in pairs])
    return len(ratios) > 1 and bool(np.std(ratios) > UNEQUAL)

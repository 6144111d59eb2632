"""Intervals of fitted parameters: curvature first, then a likelihood profile of the main ones.

A profile fixes the parameter, fits everything else again and looks where the cost has risen by
1.92 (95 %), times the factor by which the residuals exceed their floor.  It closes on both sides,
stops at a physical bound, and says which other parameter ran into its own on the way.

Source: Raue et al. 2009 (profile likelihood); pyPESTO's profiles for the idea of reporting bounds.
Checked by: tests/unit/sil/diagnosis/test_diagnose.py
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from plant.errors import IntegrationError
from sil.diagnosis.workers import spread_out
from sil.fitting.fit import FARTHEST_SD, FitResult, Fitter
from sil.fitting.floor import Misfit
from sil.fitting.hypotheses import Candidate, scaled_of, value_of

RISE = 1.92
PROFILE_STEPS = (1.0, 2.0, 3.0)


@dataclass(frozen=True)
class Interval:
    """Value with its 95 % interval; `profiled`: by likelihood profile; note: what limited it."""

    value: float
    low: float
    high: float
    unit: str
    profiled: bool = False
    note: str = ""


def intervals(
    fitter: Fitter, fit: FitResult, misfit: Misfit, workers: int, profile: bool = True
) -> dict[str, dict[str, Interval]]:
    """Intervals of every effect parameter of a fit, by candidate name."""
    inflation = max(1.0, misfit.rms**2)
    deviation = np.sqrt(np.maximum(np.diag(fit.covariance), 0.0) * inflation)
    found: dict[str, dict[str, Interval]] = {}
    k = fit.layout.healthy
    mains = []
    for candidate, own in zip(fit.candidates, fit.values, strict=True):
        table = {}
        for j, parameter in enumerate(candidate.parameters):
            half = 1.96 * float(deviation[k])
            value = own[parameter.name]
            index = scaled_of(parameter, value)
            low, high = value_of(parameter, index - half), value_of(parameter, index + half)
            table[parameter.name] = Interval(value, low, high, parameter.unit)
            if j == 0 and not candidate.is_term:
                mains.append((candidate, k, float(deviation[k])))
            k += 1
        found[candidate.name] = table
    if not profile or not mains:
        return found
    jobs = [(c, index, sd, side) for c, index, sd in mains for side in (-1.0, 1.0)]

    def work(job: tuple[Candidate, int, float, float]) -> tuple[float, str]:
        return one_side(fitter, fit, job[1], job[2], job[3], inflation)

    ends = spread_out(work, jobs, workers)
    for (candidate, _place, _sd, side), (moved, note) in zip(jobs, ends, strict=True):
        parameter = candidate.parameters[0]
        old = found[candidate.name][parameter.name]
        edge = value_of(parameter, scaled_of(parameter, old.value) + moved)
        # the wider of profile and curvature: a profile may stop short in a curved valley
        low = min(edge, old.low) if side < 0 else old.low
        high = max(edge, old.high) if side > 0 else old.high
        notes = "; ".join(text for text in (old.note, note) if text)
        found[candidate.name][parameter.name] = Interval(
            old.value, low, high, old.unit, True, notes
        )
    return found


def one_side(
    fitter: Fitter, fit: FitResult, index: int, sd: float, side: float, inflation: float
) -> tuple[float, str]:
    """Distance (signed, in typical sizes) at which the profiled cost has risen by the threshold."""
    strokes = fit.use[:: max(1, len(fit.use) // 12)]
    share = len(strokes) / len(fit.use)
    base = fitter.fit(
        fit.candidates,
        start=fit.shared,
        scatter=fit.stroke,
        use=strokes,
        iterations=3,
        freeze=[index],
    )
    wide = sd / share**0.5
    target = RISE * inflation * 1.0
    before = (0.0, 0.0)
    note = ""
    begin = base
    for step in PROFILE_STEPS:
        there = base.shared.copy()
        there[index] = base.shared[index] + side * step * wide
        there = np.where(np.arange(len(there)) == index, there, begin.shared)
        try:
            moved = fitter.fit(
                fit.candidates,
                start=there,
                scatter=begin.stroke,
                use=strokes,
                iterations=2,
                freeze=[index],
            )
        except IntegrationError:
            return side * step * sd, "beyond, the motion cannot be continued"
        rise = moved.cost - base.cost
        stuck = np.flatnonzero(np.abs(moved.shared[: fit.layout.healthy]) >= FARTHEST_SD - 1e-6)
        if len(stuck):
            note = f"{fit.layout.names[stuck[0]]} at its bound"
        if rise >= target:
            # the root of the parabola through the last two points and the optimum
            edge = np.interp(
                np.sqrt(target), [np.sqrt(max(before[1], 0.0)), np.sqrt(rise)], [before[0], step]
            )
            return side * float(edge) * sd, note
        before = (step, rise)
        begin = moved
    return side * PROFILE_STEPS[-1] * sd, note or "flat profile"

"""Intervals of fitted parameters: curvature first, then a likelihood profile of the main ones.

A profile fixes the parameter, fits everything else again and looks where the cost has risen by
1.92 (95 %), times the factor by which the residuals exceed their floor. A cause whose form is a guess
is no better known than that.

Source: Raue et al. 2009 (profile likelihood); pyPESTO's profiles for the idea of reporting bounds.
Checked by: tests/unit/sil/inference/test_diagnose.py
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np

from plant.effects import EffectParameter
from plant.errors import IntegrationError
from sil.inference.candidate import scaled_of, value_of
from sil.inference.evidence import Misfit
from sil.inference.fit import FARTHEST_SD, FitResult, Fitter
from sil.inference.report import Interval
from sil.inference.workers import spread_out


def intervals(
    fitter: Fitter, fit: FitResult, misfit: Misfit, workers: int, profile: bool = True
) -> dict[str, dict[str, Interval]]:
    """Return the intervals of every effect parameter of a fit, by candidate name."""
    inflation = max(1.0, misfit.rms**2)
    deviation = np.sqrt(np.maximum(np.diag(fit.covariance), 0.0) * inflation).tolist()
    tables: dict[str, dict[str, Interval]] = {}
    jobs: list[tuple[str, EffectParameter, int, float]] = []
    k = fit.layout.healthy
    for candidate, values in zip(fit.candidates, fit.values, strict=True):
        table = tables[candidate.name] = {}
        if profile and not candidate.is_term:
            jobs += [(candidate.name, candidate.parameters[0], k, side) for side in (-1.0, 1.0)]
        for parameter in candidate.parameters:
            value = values[parameter.name]
            centre, half = scaled_of(parameter, value), 1.96 * deviation[k]
            low, high = (value_of(parameter, centre + step) for step in (-half, half))
            table[parameter.name] = Interval(value, low, high, parameter.unit)
            k += 1

    def work(job: tuple[str, EffectParameter, int, float]) -> tuple[float, str]:
        _name, _parameter, index, side = job
        return _one_side(fitter, fit, index, deviation[index], side, inflation)

    ends = spread_out(work, jobs, workers)
    form_errors = {candidate.name: candidate.effect.form_error for candidate in fit.candidates}
    for (name, parameter, _index, _side), (moved, note) in zip(jobs, ends, strict=True):
        old = tables[name][parameter.name]
        edge = value_of(parameter, scaled_of(parameter, old.value) + moved)
        # the wider of profile and curvature: a profile may stop short in a curved valley
        low, high = min(edge, old.low), max(edge, old.high)
        form = 1.96 * form_errors[name] * abs(old.value - parameter.neutral)
        tables[name][parameter.name] = replace(
            old,
            low=max(old.value - float(np.hypot(old.value - low, form)), parameter.low),
            high=min(old.value + float(np.hypot(high - old.value, form)), parameter.high),
            note="; ".join(text for text in (old.note, note) if text),
        )
    return tables


def _one_side(
    fitter: Fitter, fit: FitResult, index: int, sd: float, side: float, inflation: float
) -> tuple[float, str]:
    """Return the distance (signed, in typical sizes) at which the profiled cost passes the threshold, and a note."""
    strokes = fit.use[:: max(1, len(fit.use) // 12)]
    wide = sd / (len(strokes) / len(fit.use)) ** 0.5
    fitted = partial(fitter.fit, fit.candidates, use=strokes, freeze=[index])
    base = moved = fitted(start=fit.shared, scatter=fit.stroke, iterations=3)
    target = 1.92 * inflation
    before = (0.0, 0.0)
    note = ""
    for step in (1.0, 2.0, 3.0):
        there = moved.shared.copy()
        there[index] = base.shared[index] + side * step * wide
        try:
            moved = fitted(start=there, scatter=moved.stroke, iterations=2)
        except IntegrationError:
            return side * step * sd, "beyond, the motion cannot be continued"
        rise = moved.cost - base.cost
        stuck = np.flatnonzero(np.abs(moved.shared[: fit.layout.healthy]) >= FARTHEST_SD - 1e-6)
        if len(stuck):
            note = f"{fit.layout.names[stuck[0]]} at its bound"
        if rise >= target:
            # the root of the parabola through the last two points and the optimum
            roots = [np.sqrt(max(before[1], 0.0)), np.sqrt(rise)]
            edge = float(np.interp(np.sqrt(target), roots, [before[0], step]))
            return side * edge * sd, note
        before = (step, rise)
    return side * step * sd, note or "flat profile"

"""`calibrate LOG...`: from the shifts in a healthy truck's logs to a model of that truck.

The healthy truck of a diagnosis, fitted; every third shift held out in turn shows what it leaves. Loads,
supply and the way of a pulse to the log differ from trip to trip: a calibration does not carry them over.
Checked by: tests/unit/sil/inference/calibrate/test_logs.py
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import exp, inf
from pathlib import Path

import numpy as np

from can_dbc.errors import InputError
from plant.kernel.layout import LENGTH
from plant.parameters import Number, Parameter, ParameterSet
from plant.parameters.calibration import OF_TRUCK, UNITS
from sil.files.quantity import counted
from sil.inference.calibrate.calibration import (
    FOLDS,
    Calibrated,
    Calibration,
    HeldOut,
    actuator_values,
)
from sil.inference.evidence import ChannelMisfit
from sil.inference.fit import Show, no_progress
from sil.inference.truck.diagnosis import MOST_SHIFTS, SEARCHED_SHIFTS, noise_of
from sil.inference.truck.fit import FINE_M, FIRST_FACTOR, MIDDLE_M, PULSE_S, Fit, Fitter
from sil.inference.truck.search import Search, spread
from sil.inference.truck.simulator import ShiftModel, trips_of
from sil.inference.workers import Stages
from sil.log_replay.recorded_shifts import LEAD_S, RecordedShift
from sil.report.figure import MM, MS, Figure, Panel, Series, Span, Stack

FEWEST_SHIFTS = 6


@dataclass(frozen=True)
class TruckCalibration(Calibration):
    """A truck calibrated on the shifts of its logs; fit: of them all."""

    fitter: Fitter
    fit: Fit


def calibrate_truck(
    shifts: Sequence[RecordedShift],
    parameters: ParameterSet,
    name: str,
    show: Show = no_progress,
    workers: int = 1,
) -> TruckCalibration:
    """Fit a healthy truck to its shifts.

    parameters: the data sheet. Raises InputError for too few shifts, shifts that failed, and a rig
    without a gearbox.
    """
    if len(shifts) < FEWEST_SHIFTS:
        raise InputError(
            f"{name}: {counted(len(shifts), 'shift')}; expected at least {FEWEST_SHIFTS}, "
            "better twelve, into and out of both gears"
        )
    if failed := sum(shift.failed for shift in shifts):
        what = f"{counted(failed, 'shift')} did not reach the gear"
        raise InputError(f"{name}: {what}; expected the logs of a healthy truck")
    fresh = {p: item for p, item in parameters.entries.items() if p not in UNITS}
    sheet = replace(parameters, entries=fresh)
    used, stages = spread(shifts, MOST_SHIFTS), Stages(show)
    few, noise_m = spread(used, SEARCHED_SHIFTS), noise_of(used, sheet)
    search = Search.of(few, sheet, noise_m, (), workers, used)
    fits = search.healthy_fits(stages)
    if not fits[0].mounted:
        raise InputError(f"{name}: shifts of a rig without gearbox; expected those of a truck")
    fits = _alike(fits)
    if len(used) > len(few):
        wholes = [search.on_all(used, sheet, noise_m, [fit]) for fit in fits]
        search, fits = wholes[0][0], _alike([fit for _, (fit,) in wholes])
    fitter, fit = search.fitters[True], fits[0]
    held_out = _held_out(fitter, fit, stages.until(100.0))
    estimates = _estimates(fitter, fits)
    if held_out.discrepancy > 0.0:
        path = "discrepancy.position_m"
        fresh[path] = Parameter(held_out.discrepancy, UNITS[path], "rms on held-out shifts")
    return TruckCalibration(
        name,
        counted(len(used), "shift"),
        replace(sheet, entries=fresh),
        {"position_m": held_out},
        _values(estimates, sheet),
        tuple((name, e.amount, e.after, e.before) for name, e in estimates.items()),
        {
            f"posterior_truck.{name}": Parameter(e.after, OF_TRUCK[name], "standard deviation")
            for name, e in estimates.items()
        },
        None,
        (),
        fitter,
        fit,
    )


@dataclass(frozen=True)
class _Estimate:
    """A quantity of the truck, in its unit: its amount, its 95 % interval, its deviation before the fit."""

    amount: float
    low: float
    high: float
    before: float

    @property
    def after(self) -> float:
        """The standard deviation after the fit."""
        return min((self.high - self.low) / 3.92, self.before)


def _alike(fits: Sequence[Fit]) -> list[Fit]:
    """Return the fits of a mounted actuator that the data cannot tell from the likeliest, that one first."""
    mounted = sorted((fit for fit in fits if fit.mounted), key=lambda fit: fit.cost)
    # among the kinks of pulses all minima are local: up to 5 behind counts
    return [fit for fit in mounted if fit.cost < mounted[0].cost + 5.0]


def _estimates(fitter: Fitter, fits: Sequence[Fit]) -> dict[str, _Estimate]:
    """Return the quantities of the truck by name, by the first of fits that are alike, with the intervals of all together.

    Friction, mass and supply are one long ridge, along which fits from several supplies end in different places.
    """
    result = {}
    for name in OF_TRUCK:
        column = fitter.layout.at[name]
        sd = fitter.layout.own[column].unit_sd
        ends = []
        for fit in fits:
            assert fit.unit_sd is not None
            # kinks steepen slopes: of 16 intervals 15 hold the truth, with a factor of 1.5 10
            half = 1.96 * min(1.0, 2.0 * float(fit.unit_sd[column]))
            ends += [sd * (float(fit.unit[column]) + by) for by in (-half, half)]
        amount = sd * float(fits[0].unit[column])
        result[name] = _Estimate(amount, min(ends), max(ends), sd)
    return result


def _values(estimates: Mapping[str, _Estimate], sheet: ParameterSet) -> dict[str, Calibrated]:
    """Return by path what a fit makes of the data sheet, with 95 % intervals."""
    of_gearbox = {"linkage": "truck.F_gearbox", "mass": "truck.m_gearbox"}
    delays = {"rise": "valve.D_rise", "fall": "valve.D_fall"}
    values: dict[str, Calibrated] = {}
    for name, item in estimates.items():
        rows: list[dict[str, Number]] = []
        for size in (item.amount, item.low, item.high):
            if (path := of_gearbox.get(name)) is not None:
                rows.append({path: sheet.value(path) * exp(size)})
                continue
            moved = actuator_values(sheet, {name: size}, {LENGTH})
            # which has both delays with any quantity
            paths = {delays[name]} if name in delays else moved.keys() - delays.values()
            rows.append({p: v for p, v in moved.items() if p in paths})
        for path, value in rows[0].items():
            if isinstance(value, tuple):
                values[path] = Calibrated(value)
            else:
                values[path] = Calibrated(value, *(float(row[path]) for row in rows[1:]))  # type: ignore[arg-type]
    return values


def _held_out(fitter: Fitter, fit: Fit, show: Show) -> HeldOut:
    """Return what the model leaves of shifts that it was not fitted to: only their loads and the supply of their trip are."""
    model, trips = fitter.model, trips_of(fitter.model.shifts)
    of_trip = {name for name in fitter.layout.at if name.startswith("supply_")}
    kept = [k for name, k in fitter.layout.at.items() if name not in {*of_trip, "supply"}]
    off, ratio = [], []

    def part(which: np.ndarray) -> Fitter:
        shifts = [model.shifts[k] for k in np.flatnonzero(which)]
        return Fitter(ShiftModel(shifts, model.parameters, model.mounted, trips), fitter.noise_m)

    for fold in range(FOLDS):
        rows = np.arange(len(model)) % FOLDS == fold
        training, rest = part(~rows), part(rows)
        trained = training.improved(replace(fit, each=fit.each[~rows]), FINE_M, 10)
        rng = np.random.default_rng(fold)
        # what is of a shift is free in any case: from where it is in the whole fit
        out = replace(trained, each=fit.each[rows], noise_factor=FIRST_FACTOR)
        for error_m in (MIDDLE_M, FINE_M, FINE_M):
            scanned = rest.rescanned(out, error_m, rng, 160)
            out = rest.improved(scanned, error_m, 8, kept=kept)
        assert out.position_m is not None
        recorded = rest.model.recorded
        off.append(rest.off(out.position_m)[recorded])
        ratio.append((rest.off(out.position_m) ** 2 / rest.variance(FINE_M))[recorded])
        show(fold + 1, FOLDS)
    square, ratios = np.concatenate(off) ** 2, np.concatenate(ratio)
    rms = float(np.sqrt(ratios.mean()))
    left_m = float(np.sqrt(max(0.0, square.mean() * (1.0 - 1.0 / max(rms, 1.0) ** 2))))
    band = float(np.sqrt(1.0 + 3.0 * np.sqrt(2.0 / len(ratios))))
    return HeldOut(ChannelMisfit(rms, len(ratios), band), fitter.noise_m, left_m, PULSE_S)


def shifts_figure(result: TruckCalibration) -> Figure:
    """Return every shift: recorded, the calibrated truck, and residuals."""
    assert result.fit.position_m is not None
    stacks, noise_m = [], np.sqrt(result.fitter.variance(FINE_M))
    rows = zip(result.fitter.model.shifts, result.fit.position_m, noise_m, strict=True)
    for shift, positions_m, sd_m in rows:
        n = len(shift.time_s)
        ms, x = MS * (shift.time_s - LEAD_S), positions_m[:n]
        lines = [
            Series("recorded", ms, MM * shift.position_m, "measured", "marked", width=2.0),
            Series("calibrated", ms, MM * x, "after", width=0.9),
        ]
        band = Span(-inf, inf, "grid", "", -3.0, 3.0)
        rest = [Series("residual", ms, (shift.position_m - x) / sd_m[:n], "after", width=0.8)]
        panels = [
            Panel("position", "mm", lines, height=150),
            Panel("residual / noise", "", rest, spans=[band], height=90, legend=False),
        ]
        title = f"{shift.start} to {shift.end}, {shift.begin_s:.2f} s of {Path(shift.source).name}"
        stacks.append(Stack("time from the first command, ms", panels, title, width=5.5))
    return Figure(stacks)

"""`calibrate`: from a data sheet and healthy strokes of one unit to a model of that unit.

The values of the data sheet are priors. They are fitted together with offsets of sensors and each stroke's
scatter, as in a diagnosis. Whole strokes held out in turn show what the model leaves beyond the noise:
its discrepancy, which widens this fit and every later one.
Checked by: tests/unit/sil/inference/calibrate/test_calibrate.py
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from math import exp, pi

import numpy as np

from can_dbc.errors import InputError
from plant.effects.setup import Setup
from plant.effects.stroke_conditions import StrokeConditions
from plant.effects.term import FORMS
from plant.effects.tolerances import FACTORS, shift
from plant.errors import IntegrationError
from plant.kernel.layout import Parameters
from plant.parameters import Number, Parameter, ParameterSet
from plant.parameters.calibration import UNITS
from plant.parameters.cylinder import area_of
from sil.campaign.campaign import Campaign, Floats
from sil.files.quantity import counted
from sil.inference.campaign.checks import observed
from sil.inference.campaign.diagnosis import available
from sil.inference.campaign.model import CampaignModel, channel_parts, model_of
from sil.inference.candidate import term_candidate
from sil.inference.evidence import ChannelMisfit, misfit
from sil.inference.fit import FitResult, Fitter, Show, no_progress
from sil.inference.problem import Block
from sil.inference.screening import screen
from sil.inference.spread import Spread
from sil.inference.thresholds import LIMITS

FLOW_MAPS = {
    Parameters.k_in: ("flow_charge.c_high", "flow_charge.c_low"),
    Parameters.k_out: ("flow_discharge.c_high", "flow_discharge.c_low"),
}


@dataclass(frozen=True)
class Calibrated:
    """A value of the model file; low, high: its 95 % interval, None for a list."""

    value: Number
    low: float | None = None
    high: float | None = None


def calibrated_values(
    parameters: ParameterSet, model: CampaignModel, fit: FitResult
) -> dict[str, Calibrated]:
    """Return by path what a fit makes of a data sheet, intervals by slopes: in logarithms, of the delays as they are."""
    amounts, covariance = unit_estimate(model, fit)
    read = cylinder_values if "cylinder.bore" in parameters else actuator_values
    systems = {stroke.conditions.system for stroke in model.strokes}

    def at(moved: Floats) -> dict[str, Number]:
        return read(parameters, dict(zip(model.unit, moved.tolist(), strict=True)), systems)

    steps = 1e-4 * np.diag(np.sqrt(np.diag(covariance)))
    there = [at(amounts + step) for step in steps]
    values = {}
    for path, value in at(amounts).items():
        if isinstance(value, tuple):
            values[path] = Calibrated(value)
            continue
        by = np.array([float(one[path]) - value for one in there]) / np.diag(steps)  # type: ignore[arg-type]
        half = 1.96 * float(np.sqrt(by @ covariance @ by))
        if parameters[path].unit == "s" or value <= 0.0:
            low, high = max(0.0, value - half), value + half
        else:
            low, high = value * exp(-half / value), value * exp(half / value)
        values[path] = Calibrated(value, low, high) if half > 0.0 else Calibrated(value)
    return values


def cylinder_values(
    parameters: ParameterSet, amounts: Mapping[str, float], systems: set[int]
) -> dict[str, Number]:
    """Return the section [cylinder] after `amounts`; its tubes are within valves and dead volumes then."""
    value = parameters.value
    setup = Setup.of(parameters, StrokeConditions("fixed", value("supply.P_s"), ()))
    for name, amount in amounts.items():
        shift(setup, name, amount)
    p = setup.p
    area_m2 = 0.25 * pi * (value("cylinder.bore") ** 2 - value("cylinder.rod") ** 2)
    moved = {
        "dead_volume_1": p.vol_b,
        "dead_volume_2": p.vol_n - area_m2 * value("cylinder.stroke"),
        "mass": p.m_s,
        "breakaway": p.f_static_s,
        "coulomb": p.f_run_s,
        "viscous": p.beta_s,
        "spring_rate": p.spring_k,
        "spring_preload": 0.0 - p.f_external,
        **{
            name: getattr(p, name) for name in ("valve_b", "wall_heat", "wall_density", "wall_ends")
        },
        "kappa": p.air_kappa,
        "gauge_lag": setup.gauge_lag_s,
        "tube_length": 0.0,
    }
    values = {f"cylinder.{name}": float(number) for name, number in moved.items()} | delays(setup)
    for end, area in (("in", p.k_in * p.cda_in), ("out", p.k_out * p.cda_out)):
        if f"cylinder.valve_c_{end}" in parameters:
            values[f"cylinder.valve_c_{end}"] = float(area) / area_of(1.0)
        else:
            values[f"cylinder.valve_cda_{end}"] = float(area)
    return dict(values)


def actuator_values(
    parameters: ParameterSet, amounts: Mapping[str, float], systems: set[int]
) -> dict[str, Number]:
    """Return what `amounts` change of the shifting actuator's parameters, for the rigs `systems`."""
    values: dict[str, Number] = {}
    fields = {field.start: field for field in Parameters.fields.values()}
    for name, amount in amounts.items():
        factor = exp(amount)
        for index in FACTORS.get(name, ()):
            by_system = fields[index].paths
            paths = [by_system[s] for s in systems if by_system and by_system[s]]
            for path in (*paths, *FLOW_MAPS.get(index, ())):
                old = parameters[path].value
                if isinstance(old, tuple):
                    values[path] = tuple(factor * item for item in old)
                else:
                    values[path] = factor * old
    setup = Setup.of(parameters, StrokeConditions("fixed", parameters.value("supply.P_s"), ()))
    for name in ("rise", "fall"):
        shift(setup, name, amounts.get(name, 0.0))
    return values | delays(setup)


def delays(setup: Setup) -> dict[str, float]:
    """Return the valves' delays of a stroke by their paths [s]."""
    timing = setup.timing
    return {"valve.D_rise": 1e-9 * timing.rise_ns, "valve.D_fall": 1e-9 * timing.fall_ns}


FOLDS = 3
ITERATIONS = 50
"""Most of a fit; from a data sheet that is 30 % off, friction and heat of the walls take about 30."""
MIN_STROKES = 4
MAX_RESIDUAL_RATIO = 4.0
"""Held-out rms over the noise up to which a model is good enough, its intervals widened by what it leaves."""


@dataclass(frozen=True)
class HeldOut:
    """A channel on strokes that the fit did not use: rms over the noise, deviations in its unit, correlation time."""

    misfit: ChannelMisfit
    noise: float
    discrepancy: float
    time_s: float


@dataclass(frozen=True)
class Calibration:
    """A calibrated unit.

    name: of the data; content: how many strokes or shifts; values: what the model file states, by path;
    changes: each quantity of the unit with its amount, its deviation after the fit and before it;
    posterior: what the file says of these; missing: structures that would explain what is left, and
    their shares of it, None if not looked for.
    """

    name: str
    content: str
    parameters: ParameterSet
    channels: Mapping[str, HeldOut]
    values: Mapping[str, Calibrated]
    changes: tuple[tuple[str, float, float, float], ...]
    posterior: Mapping[str, Parameter]
    missing: Mapping[str, float] | None
    findings: tuple[str, ...]

    @property
    def good(self) -> bool:
        """Whether the model is good enough to diagnose with."""
        return self.worst[1] <= MAX_RESIDUAL_RATIO

    @property
    def worst(self) -> tuple[str, float]:
        """The channel that is off most on strokes held out, and its rms over the noise."""
        name = max(self.channels, key=lambda name: self.channels[name].misfit.rms)
        return name, self.channels[name].misfit.rms

    @property
    def undetermined(self) -> tuple[str, ...]:
        """Quantities that the data do not determine."""
        return tuple(n for n, _, after, before in self.changes if after > 0.9 * before)

    @property
    def scalars(self) -> dict[str, Calibrated]:
        """The calibrated values that are one number with an interval, by path."""
        return {path: item for path, item in self.values.items() if item.low is not None}

    @property
    def headline(self) -> str:
        """The verdict in one sentence."""
        worst, rms = self.worst
        data = self.content.split()[-1]
        if rms <= LIMITS.max_residual_ratio:
            what = f"noise explains the {data} that the fit did not use"
            return f"Good enough to diagnose with: {what}."
        text = f"{worst} is off by {rms:.2g} times its noise on {data} that the fit did not use"
        if self.good:
            return f"Good enough to diagnose with: {text}, and every interval is wider for it."
        text = f"Not good enough to diagnose with: {text}"
        if self.missing is None:
            return f"{text}; opc4 diagnose says what of it a cause explains."
        names = [f"{name} ({share:.0%})" for name, share in self.missing.items()]
        if not names:
            return f"{text}, and nothing in the catalogue explains that."
        return f"{text}. What would explain most of it: {', '.join(names)}."


@dataclass(frozen=True)
class StrokeCalibration(Calibration):
    """A unit calibrated on strokes; model, fit: with the discrepancy."""

    model: CampaignModel
    fit: FitResult


def calibrate(
    campaign: Campaign, parameters: ParameterSet, progress: Show = no_progress
) -> StrokeCalibration:
    """Fit a unit to its healthy strokes.

    parameters: the data sheet. Raises InputError for a campaign that cannot be compared, too few strokes,
    and a data sheet that cannot follow them.
    """
    count = len(campaign.strokes)
    if count < MIN_STROKES:
        better = "better ten, of every kind that a diagnosis shall use"
        expected = f"expected at least {MIN_STROKES}, {better}"
        raise InputError(f"{campaign.folder}: {count} strokes; {expected}")
    fresh = {p: item for p, item in parameters.entries.items() if p not in UNITS}
    sheet = replace(parameters, entries=fresh)
    strokes, findings = observed(campaign, sheet)
    model = model_of(strokes, Spread.of(sheet, calibrating=True))
    try:
        channels = held_out(model, progress)
        for name, channel in channels.items():
            left = {"discrepancy": channel.discrepancy, "discrepancy_time": channel.time_s}
            for section, value in left.items() if channel.discrepancy > 0.0 else ():
                path = f"{section}.{name}"
                fresh[path] = Parameter(value, UNITS[path], "rms on held-out strokes")
        model = model_of(observed(campaign, replace(sheet, entries=fresh))[0], model.spread)
        fit = Fitter(model, progress).fit(iterations=ITERATIONS)
    except IntegrationError as error:
        raise InputError(f"{campaign.folder}: {sheet.name} cannot follow it: {error}") from None
    result = StrokeCalibration(
        campaign.name,
        counted(count, "stroke"),
        replace(sheet, entries=fresh),
        channels,
        calibrated_values(sheet, model, fit),
        tuple(quantities(model, fit)),
        posterior(model, fit),
        {},
        tuple(map(str, findings)),
        model,
        fit,
    )
    return result if result.good else replace(result, missing=missing_structure(model, fit))


def held_out(model: CampaignModel, progress: Show) -> dict[str, HeldOut]:
    """Return each channel's residual on strokes that the fit did not use; raises IntegrationError where motion cannot be continued."""
    fitter = Fitter(model, progress)
    blocks: dict[int, Block] = {}
    start = None
    for fold in range(FOLDS):
        out = [k for k in range(model.size) if k % FOLDS == fold]
        training = [k for k in range(model.size) if k not in out]
        fit = fitter.fit(start=start, use=training, iterations=ITERATIONS)
        start = fit.shared
        blocks |= fitter.fit(start=start, use=out, iterations=4, freeze=range(len(start))).blocks
    whole = misfit(model, replace(fit, use=tuple(sorted(blocks)), blocks=blocks))
    channels = {}
    for name, parts in residuals(model, blocks).items():
        noise, spacing_s = parts[0][1], float(np.median(np.diff(parts[0][2])))
        variance, long_run = covariances([part[0] for part in parts])
        excess = max(0.0, variance - noise**2)
        alike = max(1.0, long_run / excess) if excess > 0.0 else 1.0
        channels[name] = HeldOut(
            whole.channels[name], noise, float(np.sqrt(excess)), float(alike * spacing_s)
        )
    return channels


def residuals(
    model: CampaignModel, blocks: Mapping[int, Block]
) -> dict[str, list[tuple[Floats, float, Floats]]]:
    """Return by channel each stroke's residuals [n], its noise (both in the channel's unit) and instants [n] in s."""
    parts: dict[str, list[tuple[Floats, float, Floats]]] = {}
    for stroke, block in ((model.strokes[k], block) for k, block in blocks.items()):
        for channel, r in channel_parts(stroke, block.residual):
            item = r * channel.sd, channel.noise.sd, stroke.time_s[channel.rows]
            parts.setdefault(channel.name, []).append(item)
    return parts


def covariances(parts: list[Floats]) -> tuple[float, float]:
    """Return the mean square of residuals, arrays [n], and their excess over white noise, summed up to the first lag without correlation."""
    variance = float(np.mean(np.concatenate(parts) ** 2))
    total = 0.0
    for lag in range(1, min(map(len, parts)) // 2):
        moved = float(np.mean(np.concatenate([r[lag:] * r[:-lag] for r in parts])))
        if moved <= 0.05 * variance:
            break
        total += 2.0 * moved
    return variance, total


def missing_structure(model: CampaignModel, fit: FitResult) -> dict[str, float]:
    """Return the effects and terms that explain most of what a fit leaves, and their shares of it."""
    tried = [*available(model.strokes), *map(term_candidate, FORMS)]
    left = max(misfit(model, fit).excess, 1.0)
    shares: dict[str, float] = {}
    for score in screen(Fitter(model), fit, tried):
        name = score.candidate.variant if score.candidate.is_term else score.candidate.id
        if 2.0 * score.gain > 0.1 * left:
            shares.setdefault(name, min(1.0, 2.0 * score.gain / left))
    return dict(list(shares.items())[:3])


def quantities(model: CampaignModel, fit: FitResult) -> Iterator[tuple[str, float, float, float]]:
    """Yield each quantity of the unit: its amount, its deviation after the fit, and the one before it."""
    amounts, covariance = unit_estimate(model, fit)
    after = np.sqrt(np.diag(covariance)).tolist()
    before = np.sqrt(np.sum(model.spread.root**2, axis=1)).tolist()
    yield from zip(model.unit, amounts.tolist(), after, before, strict=True)


def unit_estimate(model: CampaignModel, fit: FitResult) -> tuple[Floats, Floats]:
    """Return the amounts of the unit's quantities [unit], each in its own unit, and their covariance [unit, unit]."""
    root, count = model.spread.root, len(model.unit)
    return root @ fit.shared[:count], root @ fit.covariance[:count, :count] @ root.T


def posterior(model: CampaignModel, fit: FitResult) -> dict[str, Parameter]:
    """Return the section [posterior]: the rows of the covariance of the unit's quantities."""
    _amounts, covariance = unit_estimate(model, fit)
    names = [name for name in model.unit if f"posterior.{name}" in UNITS]
    rows = [model.unit.index(name) for name in names]
    entries = {}
    for k, name in enumerate(names, start=1):
        row = tuple(covariance[rows[k - 1], rows[:k]].tolist())
        path, text = f"posterior.{name}", f"covariance with {', '.join(names[:k])}"
        entries[path] = Parameter(row, UNITS[path], text)
    return entries

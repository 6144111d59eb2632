"""Process exponents by least squares on the pressures of strokes with imposed position (T3.2)."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np

from plant.devices.valve import seconds_to_ns
from plant.kernel.layout import Parameters
from plant.parameters import ParameterSet
from plant.systems.driven import pressures_along
from plant.systems.setup import make_setup
from sil.campaign.campaign import Campaign, Floats
from sil.fitting.fit import Show, no_progress
from sil.fitting.observations import nominal_noise
from sil.identify.estimate import Estimate, Identified
from sil.identify.friction import plain_strokes, pressures_from_rest
from sil.report.figure import BAR, Figure, Panel, Series, Stack

NAMES = ("alpha_m1", "alpha_1", "alpha_m2", "alpha_2")
FIELDS = [getattr(Parameters, name) for name in NAMES]

SMOOTH_SAMPLES = 21
"""Width of the local cubic that smooths the measured position."""


def _position_error_m(parameters: ParameterSet, count: int, seed: int) -> Floats:
    """Return errors [count] of the potentiometer in m: noise and winding step, drawn from a seed.

    The resting position before the stroke, which the others are counted from, is one such step off.
    """
    generator = np.random.default_rng(seed)
    step = parameters.value("potentiometer.resolution")
    noise = generator.normal(0.0, parameters.value("potentiometer.noise_sd"), count)
    return np.asarray(noise + generator.uniform(-0.5 * step, 0.5 * step, count) + step / 12**0.5)


def identify_alpha(
    campaign: Campaign, parameters: ParameterSet, progress: Show = no_progress
) -> Identified:
    """alpha_m and alpha of charging and discharging from a campaign's fixed-piston strokes.

    Position-driven: friction plays no part.  Each stroke's delays and supply are fitted with them.
    """
    from scipy.optimize import least_squares
    from scipy.signal import savgol_filter

    strokes = plain_strokes(campaign)
    supply_sd = parameters.value("repeatability.supply_sd")
    prepared = []
    for entry, record in strokes:
        setup = make_setup(parameters, entry.conditions)
        time_s = record.time_s - record.time_s[0]
        position = savgol_filter(record["position_m"], SMOOTH_SAMPLES, 3)
        resting = np.abs(record["position_m"] - record["position_m"][0]) < 1.5e-4
        begun = int(np.argmax(~resting))
        position[:begun] = np.median(record["position_m"][: max(begun, 1)])
        position = np.clip(position - position[0] + entry.conditions.start_offset_m, 0.0, None)
        measured = np.column_stack(pressures_from_rest(record, campaign.atmosphere_pa))
        prepared.append((setup, time_s, position, measured))

    def modelled(x: Floats, k: int, error_m: Floats | float = 0.0) -> Floats:
        setup, time_s, position, _measured = prepared[k]
        twin = setup.copy()
        for index, alpha in zip(FIELDS, x[:4], strict=True):
            twin.p[index] = alpha
        # counted from one: the relative steps of the differences would vanish at zero
        opens_ms, closes_ms, supply = x[4 + 3 * k : 7 + 3 * k] - 1.0
        later, closes = seconds_to_ns(1e-3 * opens_ms), seconds_to_ns(1e-3 * closes_ms)
        twin.p.p_supply *= 1.0 + supply_sd * supply
        twin.timing = replace(
            twin.timing,
            rise_ns=max(0, twin.timing.rise_ns + later),
            fall_ns=max(0, twin.timing.fall_ns + closes),
        )
        return pressures_along(twin, time_s, np.maximum(position + error_m, 0.0))

    calls = itertools.count()

    def residual(x: Floats) -> Floats:
        progress(next(calls), 40 * len(x))
        parts = [((modelled(x, k) - p[3]) / 500.0)[::5].ravel() for k, p in enumerate(prepared)]
        # delays scatter by a few tenths of a millisecond from stroke to stroke and unit to unit
        own = x[4:].reshape(-1, 3) - 1.0
        parts.append((own / np.array([0.36, 0.92, 1.0])).ravel())
        return np.concatenate(parts)

    start = np.ones(4 + 3 * len(prepared))
    steps = np.concatenate([np.full(4, 1e-4), np.full(3 * len(prepared), 1e-2)])
    fit = least_squares(residual, start, x_scale="jac", diff_step=steps, max_nfev=40)
    freedom = max(1, len(fit.fun) - len(fit.x))
    inflation = max(1.0, 2.0 * fit.cost / freedom)
    covariance = np.linalg.pinv(fit.jac.T @ fit.jac) * inflation
    # a flow map known to 1 % carries over to alpha_m, a volume known to 1 % to both
    floor = np.array([0.015, 0.012, 0.015, 0.012])
    source = (
        f"least squares on both pressures of {len(prepared)} strokes with imposed position; "
        "interval includes 1 % of flow and of volume"
    )
    centres = fit.x[:4]
    halves = 1.96 * np.hypot(np.sqrt(np.diag(covariance)[:4]), floor * np.abs(centres))
    estimates = [
        Estimate(f"alpha.{name}", x, x - half, x + half, source)
        for name, x, half in zip(NAMES, centres.tolist(), halves.tolist(), strict=True)
    ]
    shown = [modelled(fit.x, k) for k in range(len(prepared))]
    squares = [(one - p[3]) ** 2 for one, p in zip(shown, prepared, strict=True)]
    rms_pa = float(np.sqrt(np.mean(squares)))
    _setup, time_s, _position, measured = prepared[0]
    x, lines = time_s[::10], []
    for k, role in enumerate(("series0", "series1")):
        points, fitted = (BAR * pressures[::10, k] for pressures in (measured, shown[0]))
        lines.append(Series(f"P{k + 1} measured", x, points, role, "dots"))
        lines.append(Series(f"P{k + 1} fitted", x, fitted, role))
    panel = Panel("Pressures with imposed position", "bar", lines, height=320)
    # an error of the position is one of the volume: the potentiometer's noise, and the bias of its
    # smoothing (what a second pass would change), carried through the model
    errors = [
        savgol_filter(x + _position_error_m(parameters, len(x), k), SMOOTH_SAMPLES, 3) - x
        for k, (_setup, _time_s, x, _measured) in enumerate(prepared)
    ]
    carried = [modelled(fit.x, k, error) - shown[k] for k, error in enumerate(errors)]
    noise_pa = np.hypot(
        nominal_noise(parameters)["pressure"].sd, np.sqrt(np.mean(np.square(carried)))
    )
    over_noise = rms_pa / float(noise_pa)
    notes = (f"rms of the fit {rms_pa:.0f} Pa",)
    return Identified(
        "alpha", tuple(estimates), notes, Figure([Stack("time, s", [panel])]), over_noise
    )

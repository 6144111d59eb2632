"""Process exponents by least squares on the pressures of strokes with imposed position (T3.2)."""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from plant.devices.valve import seconds_to_ns
from plant.effects.setup import Setup
from plant.kernel.layout import Parameters
from plant.parameters import ParameterSet
from plant.systems.driven import pressures_along
from plant.systems.setup import make_setup
from sil.campaign.campaign import Campaign, Floats
from sil.files.quantity import counted
from sil.inference.campaign.observations import nominal_noise
from sil.inference.fit import Show, no_progress
from sil.inference.identify.estimate import Estimate, Identified
from sil.inference.identify.friction import plain_strokes, pressures_from_rest
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


class _Driven(NamedTuple):
    """One stroke driven by its measured position: time in s [n], pressures in Pa [n, 2]."""

    setup: Setup
    time_s: Floats
    position_m: Floats
    measured_pa: Floats

    def pressures_pa(
        self, alphas: Floats, own: Floats, supply_sd: float, error_m: Floats | float = 0.0
    ) -> Floats:
        """Return the simulated pressures [n, 2] with the position off by `error_m` [n].

        own: how much later the valve opens and closes in ms, and the supply in `supply_sd`; counted
        from one: the relative steps of the differences would vanish at zero.
        """
        twin = self.setup.copy()
        for index, alpha in zip(FIELDS, alphas, strict=True):
            twin.p[index] = alpha
        opens_ms, closes_ms, supply = own - 1.0
        later, closes = seconds_to_ns(1e-3 * opens_ms), seconds_to_ns(1e-3 * closes_ms)
        twin.p.p_supply *= 1.0 + supply_sd * supply
        twin.timing = replace(
            twin.timing,
            rise_ns=max(0, twin.timing.rise_ns + later),
            fall_ns=max(0, twin.timing.fall_ns + closes),
        )
        return pressures_along(twin, self.time_s, np.maximum(self.position_m + error_m, 0.0))


def _driven(campaign: Campaign, parameters: ParameterSet) -> list[_Driven]:
    """Return the campaign's fixed-piston strokes, their positions smoothed and at rest until they move."""
    from scipy.signal import savgol_filter

    strokes = []
    for entry, record in plain_strokes(campaign):
        position = savgol_filter(record["position_m"], SMOOTH_SAMPLES, 3)
        resting = np.abs(record["position_m"] - record["position_m"][0]) < 1.5e-4
        begun = int(np.argmax(~resting))
        position[:begun] = np.median(record["position_m"][: max(begun, 1)])
        strokes.append(
            _Driven(
                make_setup(parameters, entry.conditions),
                record.time_s - record.time_s[0],
                np.clip(position - position[0] + entry.conditions.start_offset_m, 0.0, None),
                np.column_stack(pressures_from_rest(record, campaign.atmosphere_pa)),
            )
        )
    return strokes


def identify_alpha(
    campaign: Campaign, parameters: ParameterSet, progress: Show = no_progress
) -> Identified:
    """alpha_m and alpha of charging and discharging from a campaign's fixed-piston strokes.

    Position-driven: friction plays no part.  Each stroke's delays and supply are fitted with them.
    """
    from scipy.optimize import least_squares
    from scipy.signal import savgol_filter

    supply_sd = parameters.value("repeatability.supply_sd")
    strokes = _driven(campaign, parameters)

    def modelled(x: Floats, k: int, error_m: Floats | float = 0.0) -> Floats:
        return strokes[k].pressures_pa(x[:4], x[4 + 3 * k : 7 + 3 * k], supply_sd, error_m)

    calls = itertools.count()

    def residual(x: Floats) -> Floats:
        progress(next(calls), 40 * len(x))
        parts = [
            ((modelled(x, k) - stroke.measured_pa) / 500.0)[::5].ravel()
            for k, stroke in enumerate(strokes)
        ]
        # delays scatter by a few tenths of a millisecond from stroke to stroke and unit to unit
        own = x[4:].reshape(-1, 3) - 1.0
        parts.append((own / np.array([0.36, 0.92, 1.0])).ravel())
        return np.concatenate(parts)

    start = np.ones(4 + 3 * len(strokes))
    steps = np.concatenate([np.full(4, 1e-4), np.full(3 * len(strokes), 1e-2)])
    fit = least_squares(residual, start, x_scale="jac", diff_step=steps, max_nfev=40)
    freedom = max(1, len(fit.fun) - len(fit.x))
    inflation = max(1.0, 2.0 * fit.cost / freedom)
    covariance = np.linalg.pinv(fit.jac.T @ fit.jac) * inflation
    # a flow map known to 1 % carries over to alpha_m, a volume known to 1 % to both
    floor = np.array([0.015, 0.012, 0.015, 0.012])
    source = (
        f"least squares on both pressures of {counted(len(strokes), 'stroke')} with imposed position; "
        "interval includes 1 % of flow and of volume"
    )
    centres = fit.x[:4]
    halves = 1.96 * np.hypot(np.sqrt(np.diag(covariance)[:4]), floor * np.abs(centres))
    estimates = [
        Estimate(f"alpha.{name}", x, x - half, x + half, source)
        for name, x, half in zip(NAMES, centres.tolist(), halves.tolist(), strict=True)
    ]
    shown = [modelled(fit.x, k) for k in range(len(strokes))]
    squares = [(one - stroke.measured_pa) ** 2 for one, stroke in zip(shown, strokes, strict=True)]
    rms_pa = float(np.sqrt(np.mean(squares)))
    # an error of the position is one of the volume: the potentiometer's noise, and the bias of its
    # smoothing (what a second pass would change), carried through the model
    carried = []
    for k, stroke in enumerate(strokes):
        x = stroke.position_m
        noisy = x + _position_error_m(parameters, len(x), k)
        carried.append(modelled(fit.x, k, savgol_filter(noisy, SMOOTH_SAMPLES, 3) - x) - shown[k])
    noise_pa = np.hypot(
        nominal_noise(parameters)["pressure"].sd, np.sqrt(np.mean(np.square(carried)))
    )
    notes = (f"rms of the fit {rms_pa:.0f} Pa",)
    figure = _figure(strokes[0], shown[0])
    return Identified("alpha", tuple(estimates), notes, figure, rms_pa / float(noise_pa))


def _figure(stroke: _Driven, fitted_pa: Floats) -> Figure:
    """Return the figure of one stroke's pressures, measured and fitted [n, 2]."""
    x, lines = stroke.time_s[::10], []
    for k, role in enumerate(("series0", "series1")):
        points, fitted = (BAR * pressures[::10, k] for pressures in (stroke.measured_pa, fitted_pa))
        lines.append(Series(f"P{k + 1} measured", x, points, role, "dots"))
        lines.append(Series(f"P{k + 1} fitted", x, fitted, role))
    panel = Panel("Pressures with imposed position", "bar", lines, height=320)
    return Figure([Stack("time, s", [panel])])

"""Oil damper: small outlet and effective bulk modulus from damper strokes (thesis 3.2).

The thesis set them by hand so that the position follows; here position and oil pressure are fitted
by least squares, with each stroke's scatter of friction, valve delay and supply.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from can_dbc.errors import InputError
from plant import layout as L
from plant.parameters import ParameterSet
from plant.prediction import Predictor, copied
from plant.setup import make_setup
from plant.valve import seconds_to_ns
from sil.campaign import Campaign
from sil.identify.estimate import Curve, Estimate, Floats, Identified, Panel

NAMES = ("damper.A_S", "damper.A_B0", "damper.kappa_effective")
PLACES = (L.A_SMALL, L.A_LARGE, L.KAPPA)


def identify_damper(campaign: Campaign, parameters: ParameterSet) -> Identified:
    """Outlets and bulk modulus from a campaign's strokes with the compressible damper."""
    from scipy.optimize import least_squares

    value = parameters.value
    base = np.array([value(name) for name in NAMES])
    friction = value("repeatability.friction_sd")
    delay = value("repeatability.valve_delay_sd") + value("repeatability.unit_valve_delay_sd")
    supply = value("repeatability.supply_sd")
    prepared = []
    for entry in campaign.strokes:
        c = entry.conditions
        if c.kind != "fixed" or c.load != "damper" or c.damper_model != "compressible":
            continue
        record = campaign.record(entry)
        if "position_m" not in record or "pressure_oil2_pa" not in record:
            continue
        time_s = record.time_s - record.time_s[0]
        opens = min(t for t, _v, d in c.commands if d > 0.34)
        keep = np.flatnonzero((time_s > opens + 0.004) & (time_s < opens + 0.09))[::4]
        quiet = slice(0, max(5, len(record) // 100))
        oil = record["pressure_oil2_pa"]
        measured = np.concatenate(
            [
                record["position_m"][keep] - np.median(record["position_m"][quiet]),
                oil[keep] - np.mean(oil[quiet]) + c.atmosphere_pa,
            ]
        )
        n = len(keep)
        sd = np.concatenate([np.full(n, 2e-5), np.full(n, 2000.0)])
        instants = np.rint(time_s[keep] * 1e9).astype(np.int64)
        predictor = Predictor(instants, tolerance=1e-6)
        prepared.append((make_setup(parameters, c), predictor, measured, sd, time_s[keep]))
    if not prepared:
        raise InputError(
            f"{campaign.folder}: no stroke of the fixed piston with damper, position_m and "
            "pressure_oil2_pa; expected at least one"
        )

    def states(x: Floats, k: int) -> Floats:
        setup, predictor, _measured, _sd, _time = prepared[k]
        own = x[3 + 3 * k : 6 + 3 * k]
        twin = copied(setup)
        for place, factor, start_value in zip(PLACES, x[:3], base, strict=True):
            twin.p[place] = factor * start_value
        for place in (L.F_STATIC_S, L.F_RUN_S, L.BETA_S):
            twin.p[place] *= 1.0 + own[0] * friction
        rise = max(0, twin.timing.rise_ns + seconds_to_ns(own[1] * delay))
        twin.timing = replace(twin.timing, rise_ns=rise)
        twin.p[L.P_SUPPLY] *= 1.0 + own[2] * supply
        return predictor.states(twin)

    def residual(x: Floats) -> Floats:
        parts = []
        for k, (_setup, _predictor, measured, sd, _time) in enumerate(prepared):
            found = states(x, k)
            parts.append((measured - np.concatenate([found[:, L.FX], found[:, L.FOIL]])) / sd)
        parts.append(x[3:])
        return np.concatenate(parts)

    start = np.concatenate([np.ones(3), np.zeros(3 * len(prepared))])
    low = np.concatenate([np.full(3, 0.1), np.full(3 * len(prepared), -6.0)])
    high = np.concatenate([np.full(3, 12.0), np.full(3 * len(prepared), 6.0)])
    fit = least_squares(
        residual, start, bounds=(low, high), diff_step=1e-3, x_scale="jac", max_nfev=20
    )
    freedom = max(1, len(fit.fun) - len(fit.x))
    inflation = max(1.0, 2.0 * fit.cost / freedom)
    covariance = np.linalg.pinv(fit.jac.T @ fit.jac) * inflation
    estimates = []
    for k, name in enumerate(NAMES):
        centre = float(fit.x[k] * base[k])
        half = float(1.96 * np.sqrt(covariance[k, k]) * base[k])
        estimates.append(
            Estimate(
                name,
                centre,
                centre - half,
                centre + half,
                f"least squares on position and oil pressure of {len(prepared)} strokes",
            )
        )
    found = states(fit.x, 0)
    _setup, _predictor, measured, _sd, time_s = prepared[0]
    n = len(time_s)
    panel = Panel(
        "Oil pressure",
        "time, s",
        "pressure, Pa",
        (
            Curve("measured", time_s, measured[n:], "points"),
            Curve("fitted", time_s, found[:, L.FOIL]),
        ),
    )
    rms = float(np.sqrt(2.0 * fit.cost / freedom))
    return Identified("damper", tuple(estimates), (f"standardised rms {rms:.2f}",), (panel,))

"""Friction of the fixed piston: breakaway, F - m a against v, and a whole-record fit beside it.

The thesis's way differentiates a potentiometer twice, and its scatter is wide; the interval says
so, counting strokes, not samples.  The whole-record fit simulates each stroke and fits breakaway,
Coulomb level and slope together with each stroke's own scatter of valve delay and friction.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from can_dbc.errors import InputError
from plant import layout as L
from plant.parameters import ParameterSet
from plant.prediction import Predictor, copied
from plant.setup import Setup, make_setup
from plant.valve import seconds_to_ns
from sil.campaign import Campaign, CampaignStroke, Record
from sil.identify.estimate import Curve, Estimate, Floats, Identified, Panel, interval


def plain_strokes(campaign: Campaign) -> list[tuple[CampaignStroke, Record]]:
    """Unloaded strokes of the fixed piston that start at rest at its beginning."""
    found = []
    for entry in campaign.strokes:
        c = entry.conditions
        if c.kind == "fixed" and c.load == "none" and not c.charged_before:
            record = campaign.record(entry)
            needed = ("position_m", "pressure_1_pa", "pressure_2_pa")
            moved = "position_m" in record and np.ptp(record["position_m"]) > 0.003
            if all(name in record for name in needed) and moved:
                found.append((entry, record))
    if len(found) < 2:
        raise InputError(
            f"{campaign.folder}: {len(found)} unloaded strokes of the fixed piston with both "
            "pressures; expected at least 2"
        )
    return found


def net_force(record: Record, p: Floats, atmosphere_pa: float) -> Floats:
    """Pressure force on the piston P1 A1 - P2 A2 - P_atm A_s [N]; gauge offsets taken at rest."""
    quiet = slice(0, max(5, len(record) // 100))
    one = record["pressure_1_pa"] - np.mean(record["pressure_1_pa"][quiet]) + atmosphere_pa
    two = record["pressure_2_pa"] - np.mean(record["pressure_2_pa"][quiet]) + atmosphere_pa
    return np.asarray(one * p[L.AREA_P] - two * p[L.AREA_P2] - atmosphere_pa * p[L.AREA_S])


def breakaway_s(time_s: Floats, position_m: Floats) -> float:
    """Instant of first motion: the cube root of travel, straight in time, followed back to zero.

    At breakaway the force rises steadily, so the travel grows with the third power of time.
    """
    start = float(np.median(position_m[: max(5, len(position_m) // 100)]))
    travel = position_m - start
    top = float(np.max(travel))
    inside = np.flatnonzero((travel > 0.01 * top) & (travel < 0.12 * top))
    first = np.flatnonzero(travel > 0.15 * top)[0]
    inside = inside[inside < first]
    if len(inside) < 4:
        raise InputError("too few samples between rest and motion; expected 10 kHz")
    root = np.cbrt(travel[inside])
    slope, offset = np.polyfit(time_s[inside], root, 1)
    return float(-offset / slope)


def identify_friction(campaign: Campaign, parameters: ParameterSet) -> Identified:
    """Static and dynamic friction of the fixed piston from a campaign's unloaded strokes."""
    from scipy.signal import savgol_filter

    strokes = plain_strokes(campaign)
    static, slopes, offsets = [], [], []
    speeds, forces = [], []
    for entry, record in strokes:
        p = make_setup(parameters, entry.conditions).p
        time_s = record.time_s - record.time_s[0]
        force = net_force(record, p, campaign.atmosphere_pa)
        begin = breakaway_s(time_s, record["position_m"])
        static.append(float(np.interp(begin, time_s, savgol_filter(force, 15, 2))))
        step = float(np.median(np.diff(time_s)))
        window = 2 * round(0.5 * 0.003 / step) + 1
        velocity = savgol_filter(record["position_m"], window, 3, deriv=1, delta=step)
        acceleration = savgol_filter(record["position_m"], window, 3, deriv=2, delta=step)
        travel = record["position_m"] - record["position_m"][0]
        reach = float(np.max(travel))
        moving = (travel > 0.12 * reach) & (travel < 0.85 * reach) & (velocity > 0.05)
        v = velocity[moving]
        f = (force - p[L.M_S] * acceleration)[moving]
        if len(v) < 10:
            continue
        speeds.append(v)
        forces.append(f)
    if len(speeds) < 2:
        raise InputError(f"{campaign.folder}: too few samples in motion; expected 10 kHz records")
    v, f = np.concatenate(speeds), np.concatenate(forces)
    slope, offset = (float(x) for x in np.polyfit(v, f, 1))
    generator = np.random.default_rng(0)
    for _ in range(400):
        pick = generator.integers(0, len(speeds), len(speeds))
        a, b = np.polyfit(
            np.concatenate([speeds[k] for k in pick]), np.concatenate([forces[k] for k in pick]), 1
        )
        slopes.append(a)
        offsets.append(b)
    mean, low, high = interval(static)
    beta_low, beta_high = (float(x) for x in np.percentile(slopes, [2.5, 97.5]))
    run_low, run_high = (float(x) for x in np.percentile(offsets, [2.5, 97.5]))
    n = len(strokes)
    thesis = (
        Estimate(
            "friction_fixed.F_sf", mean, low, high, f"net force at first motion, {n} strokes"
        ),
        Estimate(
            "friction_fixed.F_rf", offset, run_low, run_high, f"F - m a against v, {n} strokes"
        ),
        Estimate(
            "friction_fixed.beta", slope, beta_low, beta_high, f"F - m a against v, {n} strokes"
        ),
    )
    better = whole_record(strokes, parameters)
    line = np.array([float(np.min(v)), float(np.max(v))])
    notes = (
        f"scatter about the line {np.std(f - slope * v - offset):.0f} N: twice-differentiated position",
        f"breakaway of single strokes {min(static):.1f} to {max(static):.1f} N",
        "values written are those of the whole-record fit",
    )
    panel = Panel(
        "Friction against speed",
        "speed, m/s",
        "F - m a, N",
        (
            Curve("measured", v, f, "points"),
            Curve("F - m a against v", line, slope * line + offset),
            Curve(
                "whole-record fit", line, float(better[2].value) * line + float(better[1].value)  # type: ignore[arg-type]
            ),
        ),
    )
    return Identified("friction", better, notes, (panel,), beside=thesis)


def whole_record(
    strokes: list[tuple[CampaignStroke, Record]], parameters: ParameterSet
) -> tuple[Estimate, ...]:
    """Breakaway, Coulomb level and slope fitted to whole records, with each stroke's own scatter."""
    from scipy.optimize import least_squares

    value = parameters.value
    names = ("friction_fixed.F_sf", "friction_fixed.F_rf", "friction_fixed.beta")
    base = np.array([value(name) for name in names])
    spread = np.array(
        [
            value("repeatability.friction_sd"),
            value("repeatability.valve_delay_sd") + value("repeatability.unit_valve_delay_sd"),
            value("repeatability.supply_sd"),
        ]
    )
    prepared = []
    for entry, record in strokes:
        setup = make_setup(parameters, entry.conditions)
        time_s = record.time_s - record.time_s[0]
        opens = min(t for t, _v, d in entry.conditions.commands if d > 0.34)
        keep = np.flatnonzero((time_s > opens + 0.004) & (time_s < opens + 0.05))[::2]
        instants = np.rint(time_s[keep] * 1e9).astype(np.int64)
        quiet = slice(0, max(5, len(record) // 100))
        atmosphere = entry.conditions.atmosphere_pa
        measured = np.concatenate(
            [record["position_m"][keep] - np.median(record["position_m"][quiet])]
            + [
                record[c][keep] - np.mean(record[c][quiet]) + atmosphere
                for c in ("pressure_1_pa", "pressure_2_pa")
            ]
        )
        n = len(keep)
        sd = np.concatenate([np.full(n, 2e-5), np.full(2 * n, 400.0)])
        prepared.append((setup, Predictor(instants), measured, sd))

    def changed(setup: Setup, shared: Floats, own: Floats) -> Setup:
        twin = copied(setup)
        factor = 1.0 + own[0] * spread[0]
        twin.p[L.F_STATIC_S], twin.p[L.F_RUN_S], twin.p[L.BETA_S] = shared * base * factor
        rise = max(0, twin.timing.rise_ns + seconds_to_ns(own[1] * spread[1]))
        twin.timing = replace(twin.timing, rise_ns=rise)
        twin.p[L.P_SUPPLY] *= 1.0 + own[2] * spread[2]
        return twin

    def residual(x: Floats) -> Floats:
        shared, own = x[:3], x[3:].reshape(-1, 3)
        parts = []
        for (setup, predictor, measured, sd), scatter in zip(prepared, own, strict=True):
            states = predictor.states(changed(setup, shared, scatter))
            predicted = np.concatenate(
                [states[:, L.FX], states[:, L.FP1], states[:, L.FP2]]
            )
            parts.append((measured - predicted) / sd)
        parts.append(x[3:])
        return np.concatenate(parts)

    start = np.concatenate([np.ones(3), np.zeros(3 * len(prepared))])
    low = np.concatenate([np.full(3, 0.05), np.full(3 * len(prepared), -6.0)])
    high = np.concatenate([np.full(3, 20.0), np.full(3 * len(prepared), 6.0)])
    fit = least_squares(
        residual, start, bounds=(low, high), diff_step=1e-3, x_scale="jac", max_nfev=25, method="trf"
    )
    covariance = np.linalg.pinv(fit.jac.T @ fit.jac)
    out = []
    for k, name in enumerate(names):
        centre = float(fit.x[k] * base[k])
        half = float(1.96 * np.sqrt(covariance[k, k]) * base[k])
        out.append(
            Estimate(
                name,
                centre,
                centre - half,
                centre + half,
                f"whole-record fit of {len(prepared)} strokes with their scatter",
            )
        )
    return tuple(out)

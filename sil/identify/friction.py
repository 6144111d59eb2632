"""Friction of the fixed piston: breakaway, F - m a against v, and a whole-record fit.

The thesis's way differentiates a potentiometer twice, and its scatter is wide; the interval says
so, counting strokes, not samples.  The whole-record fit simulates each stroke and fits breakaway,
Coulomb level and slope together with each stroke's own scatter of valve delay and friction.
"""

from __future__ import annotations

import numpy as np

from can_dbc.errors import InputError
from plant.kernel.layout import Parameters
from plant.parameters import ParameterSet
from plant.systems.setup import make_setup
from sil.campaign.campaign import Campaign, CampaignStroke, Record
from sil.fitting.fit import Show, no_progress
from sil.identify.campaign_fit import Fitted, fit_factors
from sil.identify.estimate import Estimate, Floats, Identified, interval
from sil.report.figure import Figure, Panel, Series, Stack


def plain_strokes(campaign: Campaign) -> list[tuple[CampaignStroke, Record]]:
    """Unloaded strokes of the fixed piston that start at rest at its beginning.

    Raises InputError for fewer than two.
    """
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


def _net_force(record: Record, p: Parameters, atmosphere_pa: float) -> Floats:
    """Pressure force on the piston P1 A1 - P2 A2 - P_atm A_s [N]; gauge offsets taken at rest."""
    quiet = slice(0, max(5, len(record) // 100))
    one = record["pressure_1_pa"] - np.mean(record["pressure_1_pa"][quiet]) + atmosphere_pa
    two = record["pressure_2_pa"] - np.mean(record["pressure_2_pa"][quiet]) + atmosphere_pa
    return np.asarray(one * p.area_p - two * p.area_p2 - atmosphere_pa * p.area_s)


def breakaway_s(time_s: Floats, position_m: Floats) -> tuple[float, float]:
    """Instant of first motion and its standard error [s], from the beginning of the travel.

    At breakaway the friction falls at once from static to sliding while the force goes on rising:
    the travel begins as a/2 t^2 + j/6 t^3 after that instant.  How much of the travel is looked at
    moves the instant; that belongs to the error as much as the potentiometer's steps.
    """
    found = [_beginning(time_s, position_m, share) for share in (0.08, 0.12, 0.18)]
    instants = [instant for instant, _error in found]
    return instants[1], float(np.hypot(found[1][1], np.ptp(instants)))


def _beginning(time_s: Floats, position_m: Floats, share: float) -> tuple[float, float]:
    """Instant and its standard error of a/2 t^2 + j/6 t^3 fitted to the first share of the travel."""
    from scipy.optimize import least_squares

    start = float(np.median(position_m[: max(5, len(position_m) // 100)]))
    travel = position_m - start
    top = float(np.max(travel))
    first = int(np.flatnonzero(travel > share * top)[0])
    inside = np.arange(max(0, first - 120), first + 1)
    if first < 20 or np.count_nonzero(travel[inside] > 0.01 * top) < 4:
        raise InputError("too few samples between rest and motion; expected 10 kHz")
    t, x = time_s[inside], travel[inside]
    end = float(t[-1])

    def residual(q: Floats) -> Floats:
        late = np.maximum(t - q[0], 0.0)
        return np.asarray((0.5 * q[1] * late**2 + q[2] * late**3 / 6.0 - x) / 2e-5)

    guess = np.array([end - 0.006, 20.0, 1e4])
    fit = least_squares(
        residual,
        guess,
        bounds=([float(t[0]), 0.0, 0.0], [end, 1e4, 1e8]),
        x_scale=[1e-3, 10.0, 1e4],
    )
    covariance = np.linalg.pinv(fit.jac.T @ fit.jac) * max(1.0, 2.0 * fit.cost / (len(x) - 3))
    return float(fit.x[0]), float(np.sqrt(covariance[0, 0]))


def identify_friction(
    campaign: Campaign, parameters: ParameterSet, progress: Show = no_progress
) -> Identified:
    """Return static and dynamic friction of the fixed piston from a campaign's unloaded strokes.

    Raises InputError for too few strokes or samples.
    """
    from scipy.signal import savgol_filter

    strokes = plain_strokes(campaign)
    static, doubts, slopes, offsets = [], [], [], []
    speeds, forces = [], []
    for entry, record in strokes:
        p = make_setup(parameters, entry.conditions).p
        time_s = record.time_s - record.time_s[0]
        force = _net_force(record, p, campaign.atmosphere_pa)
        begin, doubt = breakaway_s(time_s, record["position_m"])
        step = float(np.median(np.diff(time_s)))
        static.append(float(np.interp(begin, time_s, savgol_filter(force, 15, 2))))
        rising = float(np.interp(begin, time_s, savgol_filter(force, 15, 2, deriv=1, delta=step)))
        doubts.append(abs(rising) * doubt)
        window = 2 * round(0.5 * 0.003 / step) + 1
        velocity = savgol_filter(record["position_m"], window, 3, deriv=1, delta=step)
        acceleration = savgol_filter(record["position_m"], window, 3, deriv=2, delta=step)
        travel = record["position_m"] - record["position_m"][0]
        reach = float(np.max(travel))
        moving = (travel > 0.12 * reach) & (travel < 0.85 * reach) & (velocity > 0.05)
        v = velocity[moving]
        f = (force - p.m_s * acceleration)[moving]
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
    # the instant is not known better than its fit, the same way in every stroke: no averaging out
    half = float(np.hypot(high - mean, 1.96 * np.mean(doubts)))
    low, high = mean - half, mean + half
    beta_low, beta_high = (float(x) for x in np.percentile(slopes, [2.5, 97.5]))
    run_low, run_high = (float(x) for x in np.percentile(offsets, [2.5, 97.5]))
    n = len(strokes)
    thesis = (
        Estimate("friction_fixed.F_sf", mean, low, high, f"net force at first motion, {n} strokes"),
        Estimate(
            "friction_fixed.F_rf", offset, run_low, run_high, f"F - m a against v, {n} strokes"
        ),
        Estimate(
            "friction_fixed.beta", slope, beta_low, beta_high, f"F - m a against v, {n} strokes"
        ),
    )
    fitted = _whole_record(campaign, strokes, parameters, progress)
    better = fitted.estimates
    line = np.array([float(np.min(v)), float(np.max(v))])
    notes = (
        f"scatter about the line {np.std(f - slope * v - offset):.0f} N: twice-differentiated position",
        f"breakaway of single strokes {min(static):.1f} to {max(static):.1f} N",
        "values written are those of the whole-record fit",
    )
    fit = float(better[2].value) * line + float(better[1].value)  # type: ignore[arg-type]
    order = np.argsort(v, kind="stable")
    series = [
        Series("measured", v[order], f[order], "measured", "dots"),
        Series("F - m a against v", line, slope * line + offset, "before"),
        Series("whole-record fit", line, fit, "after"),
    ]
    panel = Panel("F - m a", "N", series, height=320)
    figure = Figure([Stack("speed, m/s", [panel], "Friction against speed")])
    return Identified("friction", better, notes, figure, fitted.over_noise, thesis)


def _whole_record(
    campaign: Campaign,
    strokes: list[tuple[CampaignStroke, Record]],
    parameters: ParameterSet,
    progress: Show,
) -> Fitted:
    return fit_factors(
        campaign,
        [entry for entry, _record in strokes],
        parameters,
        {
            "friction_fixed.F_sf": (Parameters.f_static_s,),
            "friction_fixed.F_rf": (Parameters.f_run_s,),
            "friction_fixed.beta": (Parameters.beta_s,),
        },
        ("friction",),
        f"whole-record fit of {len(strokes)} strokes with their scatter",
        progress,
    )

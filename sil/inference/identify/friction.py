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
from sil.campaign.campaign import Campaign, CampaignStroke, Floats, Record
from sil.files.quantity import counted
from sil.inference.fit import Show, no_progress
from sil.inference.identify.campaign_fit import fit_factors
from sil.inference.identify.estimate import Estimate, Identified
from sil.report.figure import Figure, Panel, Series, Stack


def plain_strokes(campaign: Campaign) -> list[tuple[CampaignStroke, Record]]:
    """Unloaded strokes of the fixed piston that start at rest at its beginning.

    Raises InputError for fewer than two.
    """
    found = []
    needed = ("position_m", "pressure_1_pa", "pressure_2_pa")
    for entry in campaign.strokes:
        c = entry.conditions
        if c.kind == "fixed" and c.load == "none" and not c.charged_before:
            record = campaign.record(entry)
            if all(name in record for name in needed) and np.ptp(record["position_m"]) > 0.003:
                found.append((entry, record))
    if len(found) < 2:
        raise InputError(
            f"{campaign.folder}: {len(found)} unloaded strokes of the fixed piston with both "
            "pressures; expected at least 2"
        )
    return found


def pressures_from_rest(record: Record, atmosphere_pa: float) -> list[Floats]:
    """Return both pressures [n] in Pa, gauge offsets taken off at rest."""
    quiet = slice(0, max(5, len(record) // 100))
    pressures = (record[column] for column in ("pressure_1_pa", "pressure_2_pa"))
    return [pressure - np.mean(pressure[quiet]) + atmosphere_pa for pressure in pressures]


def _net_force(record: Record, p: Parameters, atmosphere_pa: float) -> Floats:
    """Return the pressure force on the piston P1 A1 - P2 A2 - P_atm A_s [N]."""
    one, two = pressures_from_rest(record, atmosphere_pa)
    return np.asarray(one * p.area_p - two * p.area_p2 - atmosphere_pa * p.area_s)


def breakaway_s(time_s: Floats, position_m: Floats) -> tuple[float, float]:
    """Instant of first motion and its standard error [s], from the beginning of the travel.

    At breakaway the friction falls at once from static to sliding while the force goes on rising:
    the travel begins as a/2 t^2 + j/6 t^3 after that instant.  How much of the travel is looked at
    moves the instant; that belongs to the error as much as the potentiometer's steps.
    """
    found = [_beginning(time_s, position_m, share) for share in (0.08, 0.12, 0.18)]
    instants, errors = zip(*found, strict=True)
    return instants[1], float(np.hypot(errors[1], np.ptp(instants)))


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

    limits = ([float(t[0]), 0.0, 0.0], [end, 1e4, 1e8])
    guess = np.array([end - 0.006, 20.0, 1e4])
    fit = least_squares(residual, guess, bounds=limits, x_scale=[1e-3, 10.0, 1e4])
    covariance = np.linalg.pinv(fit.jac.T @ fit.jac) * max(1.0, 2.0 * fit.cost / (len(x) - 3))
    return float(fit.x[0]), float(np.sqrt(covariance[0, 0]))


def identify_friction(
    campaign: Campaign, parameters: ParameterSet, progress: Show = no_progress
) -> Identified:
    """Return static and dynamic friction of the fixed piston from a campaign's unloaded strokes.

    Raises InputError for too few strokes or samples.
    """
    from scipy.signal import savgol_filter
    from scipy.stats import t as student

    strokes = plain_strokes(campaign)
    static, doubts, speeds, forces = [], [], [], []
    for entry, record in strokes:
        p = make_setup(parameters, entry.conditions).p
        time_s, position = record.time_s - record.time_s[0], record["position_m"]
        force = _net_force(record, p, campaign.atmosphere_pa)
        begin, doubt = breakaway_s(time_s, position)
        step = float(np.median(np.diff(time_s)))
        static.append(float(np.interp(begin, time_s, savgol_filter(force, 15, 2))))
        rising = float(np.interp(begin, time_s, savgol_filter(force, 15, 2, deriv=1, delta=step)))
        doubts.append(abs(rising) * doubt)
        window = 2 * round(0.5 * 0.003 / step) + 1
        velocity, acceleration = (
            savgol_filter(position, window, 3, deriv=order, delta=step) for order in (1, 2)
        )
        travel = position - position[0]
        reach = float(np.max(travel))
        moving = (travel > 0.12 * reach) & (travel < 0.85 * reach) & (velocity > 0.05)
        if np.count_nonzero(moving) >= 10:
            speeds.append(velocity[moving])
            forces.append((force - p.m_s * acceleration)[moving])
    if len(speeds) < 2:
        raise InputError(f"{campaign.folder}: too few samples in motion; expected 10 kHz records")
    v, f = np.concatenate(speeds), np.concatenate(forces)
    slope, offset = (float(x) for x in np.polyfit(v, f, 1))
    generator = np.random.default_rng(0)
    lines = []
    for _ in range(400):
        pick = generator.integers(0, len(speeds), len(speeds))
        some_v, some_f = (np.concatenate([parts[k] for k in pick]) for parts in (speeds, forces))
        lines.append(np.polyfit(some_v, some_f, 1))
    n, mean = len(strokes), float(np.mean(static))
    scatter = float(student.ppf(0.975, n - 1) * np.std(static, ddof=1) / n**0.5)
    # the instant is not known better than its fit, the same way in every stroke: no averaging out
    half = float(np.hypot(scatter, 1.96 * np.mean(doubts)))
    lows, highs = np.percentile(lines, [2.5, 97.5], axis=0).tolist()
    about = f"F - m a against v, {counted(n, 'stroke')}"
    first = f"net force at first motion, {counted(n, 'stroke')}"
    thesis = (
        Estimate("friction_fixed.F_sf", mean, mean - half, mean + half, first),
        Estimate("friction_fixed.F_rf", offset, lows[1], highs[1], about),
        Estimate("friction_fixed.beta", slope, lows[0], highs[0], about),
    )
    factors = {
        "friction_fixed.F_sf": Parameters.f_static_s,
        "friction_fixed.F_rf": Parameters.f_run_s,
        "friction_fixed.beta": Parameters.beta_s,
    }
    entries = [entry for entry, _record in strokes]
    fitted, over_noise = fit_factors(
        campaign, entries, parameters, factors, known=("friction",), progress=progress
    )
    _static, level, rate = (item.numbers[0] for item in fitted)
    notes = (
        f"scatter about the line {np.std(f - slope * v - offset):.0f} N: twice-differentiated position",
        f"breakaway of single strokes {min(static):.1f} to {max(static):.1f} N",
        "values written are those of the whole-record fit",
    )
    ends = np.array([float(np.min(v)), float(np.max(v))])
    order = np.argsort(v, kind="stable")
    series = [
        Series("measured", v[order], f[order], "measured", "dots"),
        Series("F - m a against v", ends, slope * ends + offset, "before"),
        Series("whole-record fit", ends, rate * ends + level, "after"),
    ]
    panel = Panel("F - m a", "N", series, height=320)
    figure = Figure([Stack("speed, m/s", [panel], "Friction against speed")])
    return Identified("friction", fitted, notes, figure, over_noise, thesis)

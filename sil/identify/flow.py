"""Flow maps from fill and empty records of a resting volume (thesis 3.1.4).

The pressure is differentiated, epsilon = V P' / (R alpha_m), and two polynomials a direction are
fitted, joined smoothly, with their root at the supply and at the atmosphere.  What pressures alone
can determine is the product alpha_m epsilon: alpha_m is taken from the parameter set, which the output says.
The largest volume is left out of the fit and predicted.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from can_dbc.errors import InputError
from plant.kernel.layout import FIXED, Parameters
from plant.kernel.packing import flow_coefficients
from plant.parameters import ParameterSet
from plant.systems.driven import chamber_along
from plant.systems.setup import make_setup
from plant.systems.stroke import valve_moves
from sil.campaign.campaign import Campaign, Record
from sil.fitting.observations import air_noise_pa
from sil.identify.estimate import Estimate, Floats, Identified, Show, no_progress
from sil.report.figure import Figure, Panel, Series, Stack

SMOOTH_S = 0.004
HELD_PA = 0.5e5
"""A piston pressed against its collar by more than this stays there."""

WALK_S = 0.015
"""Time in which a pressed piston reaches its collar."""

SETTLE_S = 0.0015


@dataclass(frozen=True)
class RestRecord:
    """One chamber at rest while its valve does not move: instants, pressure, volume, direction."""

    name: str
    time_s: Floats
    pressure_pa: Floats
    volume_m3: float
    charging: bool
    supply_pa: float


def rest_records(campaign: Campaign, parameters: ParameterSet) -> list[RestRecord]:
    """All stretches of the campaign in which a chamber's volume and valve do not move."""
    found = []
    for entry in campaign.strokes:
        record = campaign.record(entry)
        if "position_m" not in record:
            continue
        conditions = entry.conditions
        setup = make_setup(parameters, conditions)
        time_s = record.time_s - record.time_s[0]
        position = record["position_m"]
        tail = np.median(position[-max(3, len(position) // 50) :])
        away = np.flatnonzero(np.abs(position - tail) > 1.5e-4)
        begin = time_s[away[-1]] + SETTLE_S if len(away) else time_s[0]
        moves = valve_moves(setup, int(time_s[-1] * 1e9))
        p = setup.p
        for index, chamber in enumerate(conditions.chambers):
            column = f"pressure_{chamber}_pa"
            if column not in record:
                continue
            volume = resting_volume(conditions.kind, chamber, float(tail), p)
            if volume is None:
                continue
            edges = [0.0] + [t * 1e-9 for t, which, _u, _s in moves if which == index]
            edges.append(float(time_s[-1]))
            open_now = chamber in conditions.charged_before
            states = [open_now] + [bool(u) for _t, which, u, _s in moves if which == index]
            for start, end, charging in zip(edges, edges[1:], states, strict=False):
                inside = (time_s >= max(start + SETTLE_S, begin)) & (time_s <= end - 1e-4)
                if charging and conditions.kind != "fixed":
                    inside &= time_s > loose_until(record, time_s, chamber, inside) + WALK_S
                pressure = record[column][inside]
                if len(pressure) < 60 or np.ptp(pressure) < 0.3e5:
                    continue
                found.append(
                    RestRecord(
                        f"{entry.file} {chamber} {'filling' if charging else 'emptying'}",
                        time_s[inside],
                        pressure,
                        volume,
                        charging,
                        conditions.supply_pressure_pa,
                    )
                )
    return found


def loose_until(record: Record, time_s: Floats, driving: str, inside: NDArray[np.bool_]) -> float:
    """Last instant inside at which a neighbour's pressure may move the driving piston [s], or -1."""
    free = np.zeros(len(time_s), dtype=bool)
    for name in ("B", "F") if driving == "N" else ("N",):
        column = f"pressure_{name}_pa"
        if column in record:
            free |= record[f"pressure_{driving}_pa"] - record[column] < HELD_PA
    rows = np.flatnonzero(free & inside)
    return float(time_s[rows[-1]]) if len(rows) else -1.0


def resting_volume(kind: str, chamber: str, position: float, p: Parameters) -> float | None:
    """Volume of a chamber while everything rests after the motion; None where it is not known."""
    if kind == "fixed":
        if chamber == "1":
            return float(p.vol_b + p.area_p * position)
        return float(p.vol_n - p.area_p2 * position)
    driving = {"N-B": "B", "N-F": "F", "B-N": "N", "F-N": "N"}[kind]
    if chamber != driving:
        return None
    if chamber == "N":
        return float(p.vol_n)
    outer = p.vol_b if chamber == "B" else p.vol_f
    walked = p.x_free + abs(position)
    return float(outer + p.area_p * walked + p.area_s * abs(position))


def slope(record: RestRecord) -> tuple[Floats, Floats]:
    """Pressure and its rate, by a moving parabola; the ends are left out.

    [n] in Pa and in Pa/s.
    """
    from scipy.signal import savgol_filter

    step, window = smoothing(record)
    if len(record.pressure_pa) <= window + 4:
        return np.zeros(0), np.zeros(0)
    smooth = savgol_filter(record.pressure_pa, window, 2)
    rate = savgol_filter(record.pressure_pa, window, 2, deriv=1, delta=step)
    half = window // 2
    return smooth[half:-half], rate[half:-half]


def smoothing(record: RestRecord) -> tuple[float, int]:
    """Return a record's sampling step [s] and the samples of the moving parabola."""
    step = float(np.median(np.diff(record.time_s)))
    return step, max(7, 2 * round(0.5 * SMOOTH_S / step) + 1)


def rate_misfit(record: RestRecord, parameters: ParameterSet, campaign: Campaign) -> float:
    """Return the mean square of measured minus predicted rate over the gauge's noise in it.

    Both rates by `slope`, so that its smoothing cancels.
    """
    from scipy.signal import savgol_coeffs

    _smooth, measured = slope(record)
    if not len(measured):
        return 1.0
    predicted = replace(record, pressure_pa=predict(record, parameters, campaign))
    step, window = smoothing(record)
    weights = savgol_coeffs(window, 2, deriv=1, delta=step)
    noise_pa_s = air_noise_pa(parameters) * float(np.linalg.norm(weights))
    return float(np.mean(((measured - slope(predicted)[1]) / noise_pa_s) ** 2))


def two_polynomials(
    x: Floats, y: Floats, split: float, root: float, near: int, far: int
) -> tuple[Floats, Floats]:
    """Two polynomials joined with value and slope at `split`; the one next to `root` vanishes there.

    near, far: degrees of the one that ends at the root and of the other.  Least squares with the
    three conditions exact.  Returns ascending coefficients (near, far).

    x: [n] pressure ratios, y: [n] in K kg/(s Pa).
    """
    is_near = (x >= split) if root > split else (x <= split)
    rows_near = np.vander(x[is_near], near + 1, increasing=True)
    rows_far = np.vander(x[~is_near], far + 1, increasing=True)
    n = near + far + 2
    design = np.zeros((len(x), n))
    design[: len(rows_near), : near + 1] = rows_near
    design[len(rows_near) :, near + 1 :] = rows_far
    target = np.concatenate([y[is_near], y[~is_near]])

    def powers(at: float, degree: int, derivative: bool) -> Floats:
        k = np.arange(degree + 1)
        if derivative:
            return np.where(k > 0, k * at ** np.maximum(k - 1, 0), 0.0)
        return at ** k.astype(float)

    zero = np.zeros
    conditions = np.array(
        [
            np.concatenate([powers(root, near, False), zero(far + 1)]),
            np.concatenate([powers(split, near, False), -powers(split, far, False)]),
            np.concatenate([powers(split, near, True), -powers(split, far, True)]),
        ]
    )
    # solve in the null space of the conditions (their right-hand sides are zero)
    _u, _s, vt = np.linalg.svd(conditions)
    basis = vt[3:].T
    scale = np.max(np.abs(y)) or 1.0
    reduced, *_ = np.linalg.lstsq(design @ basis, target / scale, rcond=None)
    full = basis @ reduced * scale
    return full[: near + 1], full[near + 1 :]


def identify_flow(
    campaign: Campaign, parameters: ParameterSet, progress: Show = no_progress
) -> Identified:
    """Both flow maps of a campaign with fill and empty records at rest.

    Raises InputError when a direction is missing, or no second volume is there to check on.
    """
    records = rest_records(campaign, parameters)
    value = parameters.value
    gas = value("gas.R_air")
    estimates: list[Estimate] = []
    notes: list[str] = []
    stacks: list[Stack] = []
    changes: dict[str, tuple[float, ...]] = {}
    for number, charging in enumerate((True, False)):
        progress(number, 2)
        word = "filling" if charging else "emptying"
        chosen = [r for r in records if r.charging == charging]
        if not chosen:
            raise InputError(
                f"{campaign.folder}: no record of {word} at rest; expected a resting volume filled "
                "and emptied"
            )
        largest = max(r.volume_m3 for r in chosen)
        fitted = [r for r in chosen if r.volume_m3 < 0.8 * largest] or chosen
        alpha = value("alpha.alpha_m1" if charging else "alpha.alpha_m2")
        xs, ys = [], []
        for record in fitted:
            pressure, rate = slope(record)
            reference = record.supply_pa if charging else campaign.atmosphere_pa
            sign = 1.0 if charging else -1.0
            xs.append(pressure / reference)
            scale = record.volume_m3 / (gas * alpha) / reference
            ys.append(sign * scale * rate)
        x, y = np.concatenate(xs), np.concatenate(ys)
        if len(x) < 50:
            raise InputError(f"{campaign.folder}: {word} records too short; expected 50 samples")
        if charging:
            split, section = value("flow_charge.y_split"), "flow_charge"
            low, high = best_degrees(x, y, split, 1.0, 4, 3)
        else:
            split, section = value("flow_discharge.z_split"), "flow_discharge"
            low, high = best_degrees(x, y, split, 1.0, 4, 2)
        fit = np.where(
            (x >= split) == charging, np.polyval(low[::-1], x), np.polyval(high[::-1], x)
        )
        scatter = float(np.std(y - fit))
        band = 100.0 * scatter / float(np.mean(np.abs(y))) / max(1.0, (len(x) / 40) ** 0.5) * 1.96
        source = (
            f"identified from {len(fitted)} records of {word}, alpha_m {alpha:g} assumed; "
            f"95 % band of the mean flow +-{band:.2f} %"
        )
        for key, coefficients in (("c_low", low), ("c_high", high)):
            path = f"{section}.{key}"
            estimates.append(Estimate(path, tuple(coefficients), None, None, source))
            changes[path] = tuple(coefficients)
        if charging:
            changes["flow_charge.y_min"] = (float(np.min(x)),)
        notes.append(f"{word}: {len(x)} points from {len(fitted)} records, scatter {scatter:.2e}")
        order = np.argsort(x)
        points, line = y[order][::7], fit[order][::7]
        lines = [
            Series("measured", x[order][::7], points, "measured", "dots"),
            Series("two polynomials", x[order][::7], line, "after"),
        ]
        panel = Panel("flow / reference pressure", "K kg/(s Pa)", lines, height=320)
        axis = "P / P_s" if charging else "P / P_atm"
        stacks.append(Stack(axis, [panel], f"Flow, {word}", width=6.4))
    found = parameters.override(
        {path: list(v) for path, v in changes.items() if path[-5:] != "y_min"}
    )
    notes += checks(records, found, campaign)
    over_noise = float(np.sqrt(np.mean([rate_misfit(r, found, campaign) for r in records])))
    return Identified("flow", tuple(estimates), tuple(notes), Figure(stacks), over_noise)


def best_degrees(
    x: Floats, y: Floats, split: float, root: float, near_most: int, far_most: int
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return the degrees with the least mean square error on every third point left out, padded to the map.

    x: [n] pressure ratios, y: [n] in K kg/(s Pa). Raises ValueError for no degrees.
    """
    held = np.arange(len(x)) % 3 == 0
    best: tuple[float, int, int] | None = None
    for near in range(2, near_most + 1):
        for far in range(1, far_most + 1):
            a, b = two_polynomials(x[~held], y[~held], split, root, near, far)
            is_near = (x[held] >= split) if root > split else (x[held] <= split)
            error = np.where(is_near, np.polyval(a[::-1], x[held]), np.polyval(b[::-1], x[held]))
            mse = float(np.mean((error - y[held]) ** 2))
            if best is None or mse < 0.995 * best[0]:
                best = (mse, near, far)
    if best is None:
        raise ValueError("no degrees to choose from")
    a, b = two_polynomials(x, y, split, root, best[1], best[2])
    near_full = tuple(a) + (0.0,) * (near_most + 1 - len(a))
    far_full = tuple(b) + (0.0,) * (far_most + 1 - len(b))
    return near_full, far_full


def checks(records: list[RestRecord], found: ParameterSet, campaign: Campaign) -> list[str]:
    """Every record predicted with the identified map; the volumes that were not fitted named."""
    lines = []
    for charging in (True, False):
        chosen = [r for r in records if r.charging == charging]
        largest = max(r.volume_m3 for r in chosen)
        smallest = min(r.volume_m3 for r in chosen)
        for record in chosen:
            if record.volume_m3 < 0.8 * largest:
                continue
            predicted = predict(record, found, campaign)
            error = float(np.sqrt(np.mean((predicted - record.pressure_pa) ** 2)))
            ratio = record.volume_m3 / smallest
            lines.append(
                f"check {record.name}: {ratio:.1f} times the smallest volume, rms {error:.0f} Pa"
            )
    return lines


def predict(record: RestRecord, parameters: ParameterSet, campaign: Campaign) -> Floats:
    """Pressure of a resting record by a parameter set's maps, from its first (smoothed) value.

    Result [n] in Pa.
    """
    from plant.kernel.packing import Load, pack

    p = pack(
        parameters,
        FIXED,
        supply_pressure_pa=record.supply_pa,
        atmosphere_pa=campaign.atmosphere_pa,
        load=Load(),
    )
    out = np.zeros(len(record.time_s))
    head = np.polyfit(record.time_s[:30] - record.time_s[0], record.pressure_pa[:30], 2)
    position = 1.0 if record.charging else 0.0
    chamber_along(
        record.time_s,
        np.full(len(out), record.volume_m3),
        float(head[-1]),
        np.array([[0.0, position, 0.0]]),
        p.array,
        flow_coefficients(parameters),
        out,
    )
    return out

"""Flow maps from fill and empty records of a resting volume (thesis 3.1.4).

The pressure is differentiated, epsilon = V P' / (R alpha_m), and two polynomials a direction are
fitted, joined smoothly, with their root at the supply and at the atmosphere. Pressures alone determine
the product alpha_m epsilon: alpha_m is taken from the parameter set, which the output says.
The largest volume is left out of the fit and predicted.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from can_dbc.errors import InputError
from plant.kernel.layout import FIXED, Parameters
from plant.kernel.packing import Load, flow_coefficients, pack
from plant.parameters import ParameterSet
from plant.systems.driven import chamber_along
from plant.systems.setup import make_setup
from plant.systems.stroke import valve_moves
from sil.campaign.campaign import Campaign, Floats, Record
from sil.files.quantity import counted
from sil.inference.campaign.observations import nominal_noise
from sil.inference.fit import Show, no_progress
from sil.inference.identify.estimate import Identified, ParameterEstimate
from sil.report.figure import Figure, Panel, Series, Stack

Polynomial = tuple[float, ...]
"""Ascending coefficients."""


@dataclass(frozen=True)
class RestRecord:
    """One chamber at rest while its valve does not move: instants, pressure, volume, direction."""

    name: str
    time_s: Floats
    pressure_pa: Floats
    volume_m3: float
    charging: bool
    supply_pa: float

    @property
    def smoothing(self) -> tuple[float, int]:
        """Sampling step [s], and samples of the moving parabola, over 4 ms."""
        step = float(np.median(np.diff(self.time_s)))
        return step, max(7, 2 * round(0.5 * 0.004 / step) + 1)


def _rest_records(campaign: Campaign, parameters: ParameterSet) -> list[RestRecord]:
    """Return all stretches of the campaign in which a chamber's volume and valve do not move."""
    stretches, settle_s = [], 0.0015
    for entry in campaign.strokes:
        record, conditions = campaign.record(entry), entry.conditions
        if "position_m" not in record:
            continue
        setup = make_setup(parameters, conditions)
        time_s = record.time_s - record.time_s[0]
        position = record["position_m"]
        tail = float(np.median(position[-max(3, len(position) // 50) :]))
        away = np.flatnonzero(np.abs(position - tail) > 1.5e-4)
        begin = time_s[away[-1]] + settle_s if len(away) else time_s[0]
        moves = valve_moves(setup, int(time_s[-1] * 1e9))
        for index, chamber in enumerate(conditions.chambers):
            column = f"pressure_{chamber}_pa"
            volume = _resting_volume(conditions.kind, chamber, tail, setup.p)
            if column not in record or volume is None:
                continue
            switches = [(t * 1e-9, bool(u)) for t, which, u, _s in moves if which == index]
            edges = [0.0, *(t for t, _u in switches), float(time_s[-1])]
            states = [chamber in conditions.charged_before, *(u for _t, u in switches)]
            for (start, end), charging in zip(itertools.pairwise(edges), states, strict=True):
                inside = (time_s >= max(start + settle_s, begin)) & (time_s <= end - 1e-4)
                if charging and conditions.kind != "fixed":
                    # a pressed piston reaches its collar within 15 ms
                    inside &= time_s > _loose_until(record, time_s, chamber, inside) + 0.015
                pressure = record[column][inside]
                if len(pressure) >= 60 and np.ptp(pressure) >= 0.3e5:
                    name = f"{entry.file} {chamber} {DIRECTIONS[charging][0]}"
                    supply_pa = conditions.supply_pressure_pa
                    stretches.append(
                        RestRecord(name, time_s[inside], pressure, volume, charging, supply_pa)
                    )
    return stretches


def _loose_until(record: Record, time_s: Floats, driving: str, inside: NDArray[np.bool_]) -> float:
    """Last instant inside at which a neighbour's pressure may move the driving piston [s], or -1."""
    free = np.zeros(len(time_s), dtype=bool)
    for name in ("B", "F") if driving == "N" else ("N",):
        column = f"pressure_{name}_pa"
        if column in record:
            # a piston pressed against its collar by more than 0.5 bar stays there
            free |= record[f"pressure_{driving}_pa"] - record[column] < 0.5e5
    rows = np.flatnonzero(free & inside)
    return float(time_s[rows[-1]]) if len(rows) else -1.0


def _resting_volume(kind: str, chamber: str, position: float, p: Parameters) -> float | None:
    """Volume of a chamber while everything rests after the motion; None where it is not known."""
    if kind == "fixed":
        one, two = p.vol_b + p.area_p * position, p.vol_n - p.area_p2 * position
        return float(one if chamber == "1" else two)
    if chamber != ("N" if kind[0] != "N" else kind[-1]):
        return None
    if chamber == "N":
        return float(p.vol_n)
    outer = p.vol_b if chamber == "B" else p.vol_f
    return float(outer + p.area_p * (p.x_free + abs(position)) + p.area_s * abs(position))


def _slope(record: RestRecord) -> tuple[Floats, Floats]:
    """Return pressure [Pa] and its rate [Pa/s], by a moving parabola; the ends are left out."""
    from scipy.signal import savgol_filter

    step, window = record.smoothing
    if len(record.pressure_pa) <= window + 4:
        return np.zeros(0), np.zeros(0)
    inside = slice(window // 2, -(window // 2))
    smooth = savgol_filter(record.pressure_pa, window, 2)
    rate = savgol_filter(record.pressure_pa, window, 2, deriv=1, delta=step)
    return smooth[inside], rate[inside]


def _rate_misfit(record: RestRecord, parameters: ParameterSet, campaign: Campaign) -> float:
    """Return the mean square of measured minus predicted rate, both by `_slope`, over the gauge's noise in it."""
    from scipy.signal import savgol_coeffs

    measured = _slope(record)[1]
    if not len(measured):
        return 1.0
    predicted = replace(record, pressure_pa=_predict(record, parameters, campaign))
    step, window = record.smoothing
    weights = savgol_coeffs(window, 2, deriv=1, delta=step)
    noise_pa_s = nominal_noise(parameters)["pressure"].sd * float(np.linalg.norm(weights))
    return float(np.mean(((measured - _slope(predicted)[1]) / noise_pa_s) ** 2))


def _near_root(x: Floats, split: float) -> NDArray[np.bool_]:
    """Return which pressure ratios are on the root's side (at 1) of the joint."""
    return np.asarray(x >= split if split < 1.0 else x <= split)


def _evaluate(x: Floats, split: float, near: Polynomial, far: Polynomial) -> Floats:
    return np.where(_near_root(x, split), np.polyval(near[::-1], x), np.polyval(far[::-1], x))


def two_polynomials(
    x: Floats, y: Floats, split: float, near: int, far: int
) -> tuple[Polynomial, Polynomial]:
    """Fit two polynomials joined with value and slope at `split`; the near one vanishes at 1.

    x: [n] pressure ratios, y: [n] in K kg/(s Pa); near, far: degrees. Least squares, the conditions
    exact. Returns ascending coefficients (near, far).
    """
    is_near = _near_root(x, split)
    rows_near = np.vander(x[is_near], near + 1, increasing=True)
    rows_far = np.vander(x[~is_near], far + 1, increasing=True)
    design = np.zeros((len(x), near + far + 2))
    design[: len(rows_near), : near + 1] = rows_near
    design[len(rows_near) :, near + 1 :] = rows_far
    target = np.concatenate([y[is_near], y[~is_near]])

    def powers(at: float, degree: int) -> Floats:
        return at ** np.arange(degree + 1.0)

    def slopes(at: float, degree: int) -> Floats:
        k = np.arange(degree + 1)
        return np.where(k > 0, k * at ** np.maximum(k - 1, 0), 0.0)

    conditions = [np.concatenate([powers(1.0, near), np.zeros(far + 1)])]
    conditions += [np.concatenate([of(split, near), -of(split, far)]) for of in (powers, slopes)]
    # solve in the null space of the conditions (their right-hand sides are zero)
    basis = np.linalg.svd(np.array(conditions))[2][3:].T
    scale = np.max(np.abs(y)) or 1.0
    reduced, *_ = np.linalg.lstsq(design @ basis, target / scale, rcond=None)
    full = (basis @ reduced * scale).tolist()
    return tuple(full[: near + 1]), tuple(full[near + 1 :])


def _best_degrees(
    x: Floats, y: Floats, split: float, near_most: int, far_most: int
) -> tuple[Polynomial, Polynomial]:
    """Return the polynomials with the least error on every third point, padded to the most degrees."""
    third = np.arange(len(x)) % 3 == 0
    best, degrees = np.inf, (2, 1)
    for near, far in itertools.product(range(2, near_most + 1), range(1, far_most + 1)):
        pair = two_polynomials(x[~third], y[~third], split, near, far)
        mse = float(np.mean((_evaluate(x[third], split, *pair) - y[third]) ** 2))
        if mse < 0.995 * best:
            best, degrees = mse, (near, far)
    a, b = two_polynomials(x, y, split, *degrees)
    return a + (0.0,) * (near_most + 1 - len(a)), b + (0.0,) * (far_most + 1 - len(b))


DIRECTIONS = {
    True: ("filling", "P / P_s", "alpha_m1", "flow_charge", "y_split", (4, 3)),
    False: ("emptying", "P / P_atm", "alpha_m2", "flow_discharge", "z_split", (4, 2)),
}
"""By whether a chamber is charged: word, axis, names of alpha_m, section and joint, most degrees."""


def identify_flow(
    campaign: Campaign, parameters: ParameterSet, progress: Show = no_progress
) -> Identified:
    """Identify both flow maps from a campaign with fill and empty records at rest.

    Raises InputError when a direction is missing, or no second volume is there to check on.
    """
    records = _rest_records(campaign, parameters)
    estimates: list[ParameterEstimate] = []
    notes: list[str] = []
    stacks: list[Stack] = []
    for number, charging in enumerate(DIRECTIONS):
        progress(number, 2)
        pair, note, stack = _identify_direction(charging, records, campaign, parameters)
        estimates += pair
        notes.append(note)
        stacks.append(stack)
    identified = parameters.override({item.path: list(item.numbers) for item in estimates})
    notes += _checks(records, identified, campaign)
    misfits = [_rate_misfit(record, identified, campaign) for record in records]
    over_noise = float(np.sqrt(np.mean(misfits)))
    return Identified("flow", tuple(estimates), tuple(notes), Figure(stacks), over_noise)


def _identify_direction(
    charging: bool, records: list[RestRecord], campaign: Campaign, parameters: ParameterSet
) -> tuple[list[ParameterEstimate], str, Stack]:
    """Return the estimates of one direction, a note on them and their figure."""
    word, axis, alpha_m, section, joint, degrees = DIRECTIONS[charging]
    chosen = [r for r in records if r.charging == charging]
    if not chosen:
        expected = "expected a resting volume filled and emptied"
        raise InputError(f"{campaign.folder}: no record of {word} at rest; {expected}")
    largest = max(r.volume_m3 for r in chosen)
    fitted = [r for r in chosen if r.volume_m3 < 0.8 * largest] or chosen
    alpha = parameters.value(f"alpha.{alpha_m}")
    xs, ys = [], []
    for record in fitted:
        pressure, rate = _slope(record)
        reference = record.supply_pa if charging else campaign.atmosphere_pa
        scale = record.volume_m3 / (parameters.value("gas.R_air") * alpha) / reference
        xs.append(pressure / reference)
        ys.append((1.0 if charging else -1.0) * scale * rate)
    x, y = np.concatenate(xs), np.concatenate(ys)
    if len(x) < 50:
        raise InputError(f"{campaign.folder}: {word} records too short; expected 50 samples")
    split = parameters.value(f"{section}.{joint}")
    near, far = _best_degrees(x, y, split, *degrees)
    fit = _evaluate(x, split, near, far)
    scatter = float(np.std(y - fit))
    band = 100.0 * scatter / float(np.mean(np.abs(y))) / max(1.0, (len(x) / 40) ** 0.5) * 1.96
    count = counted(len(fitted), "record")
    source = (
        f"identified from {count} of {word}, alpha_m {alpha:g} assumed; "
        f"95 % band of the mean flow +-{band:.2f} %"
    )
    estimates = [
        ParameterEstimate(f"{section}.{key}", coefficients, None, None, source)
        for key, coefficients in (("c_low", near), ("c_high", far))
    ]
    note = f"{word}: {counted(len(x), 'point')} from {count}, scatter {scatter:.2e}"
    rows = np.argsort(x)[::7]
    lines = [
        Series("measured", x[rows], y[rows], "measured", "dots"),
        Series("two polynomials", x[rows], fit[rows], "after"),
    ]
    panel = Panel("flow / reference pressure", "K kg/(s Pa)", lines, height=320)
    return estimates, note, Stack(axis, [panel], f"Flow, {word}", width=6.4)


def _checks(records: list[RestRecord], model: ParameterSet, campaign: Campaign) -> list[str]:
    """Predict the records of the largest volumes, which were not fitted, with the identified map."""
    lines = []
    for charging in DIRECTIONS:
        chosen = [r for r in records if r.charging == charging]
        volumes = [r.volume_m3 for r in chosen]
        for record in chosen:
            if record.volume_m3 >= 0.8 * max(volumes):
                error = _predict(record, model, campaign) - record.pressure_pa
                lines.append(
                    f"check {record.name}: {record.volume_m3 / min(volumes):.1f} times the smallest "
                    f"volume, rms {np.sqrt(np.mean(error**2)):.0f} Pa"
                )
    return lines


def _predict(record: RestRecord, parameters: ParameterSet, campaign: Campaign) -> Floats:
    """Return the pressure of a resting record by a set's maps, from its first (smoothed) value."""
    supply_pa, atmosphere_pa = record.supply_pa, campaign.atmosphere_pa
    p = pack(
        parameters, FIXED, supply_pressure_pa=supply_pa, atmosphere_pa=atmosphere_pa, load=Load()
    )
    out = np.zeros(len(record.time_s))
    volumes = np.full(len(out), record.volume_m3)
    head = np.polyfit(record.time_s[:30] - record.time_s[0], record.pressure_pa[:30], 2)
    valve = np.array([[0.0, 1.0 if record.charging else 0.0, 0.0]])
    maps = flow_coefficients(parameters)
    chamber_along(record.time_s, volumes, float(head[-1]), valve, p.array, maps, out)
    return out

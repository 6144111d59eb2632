"""Records of a body of which driving force and position are known: read, checked, filtered.

Speed, acceleration and force go through one Gaussian filter: what is linear in the balance of
forces holds for filtered signals as it does for raw ones. Samples close to rest and to the ends of
a record are left out. What is odd about a record is a finding; what forbids any conclusion from it
is a doubt.
Checked by: tests/unit/sil/inference/force/test_diagnosis.py
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from msgspec import Meta, Struct
from numpy.typing import NDArray

from can_dbc.errors import InputError
from can_dbc.typed_toml import convert, read_toml
from plant.effects.force_term import Motion
from sil.campaign.campaign import (
    ColumnMap,
    Floats,
    Rate,
    Record,
    Recorder,
    Text,
    check_files,
    column_maps,
    read_record,
)
from sil.campaign.tables import Decimal
from sil.files.quantity import counted
from sil.inference.campaign.noise import noise_of
from sil.inference.force.checks import odd_channels

FEWEST_STROKES = 4
"""With fewer strokes, blocks of time are held out instead."""
FEWEST_SAMPLES = 200
RADIUS = 7.0
"""Reach of the filter in standard deviations: cut shorter, its derivatives are not those of one filter."""
ROTARY = {"N": "N m", "kg": "kg m^2", "N s/m": "N m s", "N/m": "N m", "N/Pa": "N m/Pa", "m": "rad"}


class Body(Struct, frozen=True, forbid_unknown_fields=True):
    """The [body] of campaign.toml.

    mass_kg: what moves; fitted if it is not stated.
    piston_area_m2: under pressure_pa, negative if that pushes towards decreasing position.
    slow_m_s: slower samples are left out; without it, 5 % of the usual largest speed.
    """

    mass_kg: Annotated[float, Meta(ge=0.0, le=1e6)] | None = None
    piston_area_m2: Annotated[float, Meta(ge=-10.0, le=10.0)] = 0.0
    area_2_m2: Annotated[float, Meta(ge=-10.0, le=10.0)] = 0.0
    """Area under pressure_2_pa, counted as piston_area_m2: negative if it pushes towards -."""
    slow_m_s: Annotated[float, Meta(ge=0.0, le=1e3)] | None = None
    smooth_s: Annotated[float, Meta(ge=0.0, le=10.0)] | None = None
    """Standard deviation of the filter; without it, found from the noise of the position."""


class RecordedMotion(Struct, frozen=True, forbid_unknown_fields=True):
    """One [[stroke]] of campaign.toml.

    file: with one stroke or many, beside campaign.toml.
    label: free text.
    """

    file: Text
    label: str = ""


class ForceRig(Struct, frozen=True, forbid_unknown_fields=True):
    """The keys of campaign.toml with rig = "force".

    name: of the campaign, in results.
    rig: of what is measured: driving force and position of any body.
    stroke: the files.
    sample_rate_hz: at which samples are compared; without it, that of the slowest file.
    columns: ours = "theirs", or the table below, for files with other names or units.
    decimal: the decimal sign, for files that do not show it.
    """

    name: Text
    rig: Literal["force"]
    stroke: Annotated[list[RecordedMotion], Meta(min_length=1)]
    sample_rate_hz: Rate | None = None
    columns: dict[str, Text | ColumnMap] = {}
    decimal: Decimal | None = None
    body: Body = Body()


@dataclass(frozen=True)
class Recorded:
    """All samples of a campaign, and which of them are judged.

    raw: position, force and pressure as measured (less a delay that is taken off), speed and
    acceleration filtered, all [n]; its block is the number of the group of strokes that is held out
    together. recorded_n: the force without what pressures add to it, in N; all of it where no force is
    recorded, [n]. starts: first sample of each part of a file without gaps; judged: [n]; stroke: [n];
    width: of the filter, in samples; step_s: sampling step; force_sd_n, position_sd_m: noise of a
    sample; stride: distance of judged samples.
    """

    name: str
    raw: Motion
    recorded_n: Floats
    starts: NDArray[np.int64]
    judged: NDArray[np.bool_]
    stroke: NDArray[np.int64]
    width: float
    step_s: float
    force_sd_n: float
    position_sd_m: float
    held_out: str
    body: Body
    units: Mapping[str, str]
    findings: tuple[str, ...]
    doubts: tuple[str, ...]
    stride: int

    def filtered(self, values: Floats, order: int = 0) -> Floats:
        """Return values [n], or [n, k], or their derivative by time, filtered: [n] per s^order."""
        return smoothed(values, self.width, order) / self.step_s**order

    def gain_of(self, order: int) -> float:
        """Return the noise of a filtered derivative per noise of a sample [1/s^order]."""
        return float(np.linalg.norm(kernel(self.width, order))) / self.step_s**order

    def away_from_ends(self, steps: float) -> NDArray[np.bool_]:
        """Return which samples [n], moved by so many steps, the filter keeps from the ends of their part."""
        return away_from_ends(self.starts, len(self.judged), self.width, int(np.ceil(steps)))

    def balance_sd_n(self, mass: float, viscous: float) -> float:
        """Return the standard deviation of the noise of a filtered balance of forces [N]."""
        w = [kernel(self.width, order) / self.step_s**order for order in range(3)]
        position = float(np.linalg.norm(mass * w[2] + viscous * w[1])) * self.position_sd_m
        return float(np.hypot(float(np.linalg.norm(w[0])) * self.force_sd_n, position))


def description(path: str | Path) -> Path:
    """Return the campaign.toml of a folder, or the file itself."""
    folder = Path(path)
    return folder if folder.suffix == ".toml" else folder / "campaign.toml"


def is_force_rig(path: str | Path) -> bool:
    """Return whether a campaign describes a rig known by force and position alone."""
    file = description(path)
    return file.is_file() and read_toml(file).get("rig") == "force"


def kernel(width: float, order: int) -> Floats:
    """Return the weights [m] of the Gaussian filter of this width, in samples, or a derivative."""
    impulse = np.zeros(2 * int(np.ceil(RADIUS * width)) + 3)
    impulse[len(impulse) // 2] = 1.0
    return smoothed(impulse, width, order)


def smoothed(values: Floats, width: float, order: int = 0) -> Floats:
    """Return values [n], or [n, k], or a derivative per step^order, filtered along the first axis."""
    from scipy.ndimage import gaussian_filter1d

    return np.asarray(
        gaussian_filter1d(values, width, axis=0, order=order, truncate=RADIUS, mode="nearest")
    )


# --- reading ----------------------------------------------------------------------------------
def read_motion(path: str | Path) -> Recorded:
    """Read a campaign with rig = "force".

    Raises InputError naming file and key or column: one that is missing, a value that is not a
    number, a body that never moves.
    """
    file = description(path)
    rig = convert(read_toml(file), ForceRig, str(file))
    check_files([entry.file for entry in rig.stroke], file)
    recorder = Recorder(column_maps(rig.columns), decimal=rig.decimal)
    records = [read_record(file.parent / entry.file, recorder) for entry in rig.stroke]
    rotary = any("angle_rad" in record for record in records)
    usual = [float(np.median(np.diff(record.time_s))) for record in records]
    step = max(1.0 / rig.sample_rate_hz if rig.sample_rate_hz else 0.0, *usual)
    findings: list[str] = []
    doubts: list[str] = []
    parts: list[Floats] = []
    noise: list[tuple[float, float]] = []
    for record, own_step in zip(records, usual, strict=True):
        signals = _signals(record, rig.body)
        if own_step < 0.99 * step:
            rates = f"{1.0 / own_step:.4g} samples a second, compared at {1.0 / step:.4g}"
            why = "by sample_rate_hz, or the slowest file"
            findings.append(f"{record.path.name}: {rates}: {why}")
        if record.dialect:
            findings.append(f"{record.path.name}: read as {record.dialect}")
        # a stuck force is hidden by the pressures that are added to it
        checked = signals[[0, 3, 2]]
        sds = noise_of(signals[1], record.time_s), noise_of(signals[0], record.time_s)
        for rows in _parts(record, findings):
            if (record.time_s[rows[-1]] - record.time_s[rows[0]]) / step < 50.0:
                continue
            doubts += odd_channels(record.path.name, checked[:, rows], int(rows[0]))
            parts.append(_even(record.time_s[rows], signals[:, rows], step))
            noise.append(sds)
    if not parts:
        raise InputError(
            f"{file}: at {1.0 / step:.4g} samples a second (by sample_rate_hz, or the slowest file) no part "
            f"without a gap lasts 50 samples; expected longer strokes, or another sample_rate_hz"
        )
    return _judged(rig, parts, step, noise, rotary, findings, doubts)


def _signals(record: Record, body: Body) -> Floats:
    """Return position, driving force, pressure (NaN without) and recorded force of a record: [4, n]."""
    path = record.path
    position, force = (
        next((record[name] for name in names if name in record), None)
        for names in (("position_m", "angle_rad"), ("force_n", "torque_n_m"))
    )
    if position is None:
        raise InputError(f"{path}: no position_m; expected position and a driving force")
    areas = {"pressure_pa": body.piston_area_m2, "pressure_2_pa": body.area_2_m2}
    for name, area in areas.items():
        if area and name not in record:
            raise InputError(f"{path}: no {name}, whose area is stated in [body]")
    if force is None and not any(areas.values()):
        what = "no force_n, and no pressure_pa with piston_area_m2"
        raise InputError(f"{path}: {what}; expected a driving force")
    recorded = np.zeros(len(record)) if force is None else force
    driving = recorded + sum(area * record[name] for name, area in areas.items() if area)
    if len(record) < FEWEST_SAMPLES:
        raise InputError(f"{path}: {len(record)} samples; expected at least {FEWEST_SAMPLES}")
    pressure = record["pressure_pa"] if "pressure_pa" in record else np.full(len(record), np.nan)
    if "pressure_2_pa" in record:
        pressure = pressure - record["pressure_2_pa"]
    return np.vstack([position, driving, pressure, driving if force is None else force])


def _parts(record: Record, findings: list[str]) -> list[NDArray[np.int64]]:
    """Return the rows of each part without gaps; gaps are added to the findings."""
    steps = np.diff(record.time_s)
    gaps = np.flatnonzero(steps > 8.0 * np.median(steps))
    if len(gaps):
        findings.append(
            f"{record.path.name}: time_s: {counted(len(gaps), 'gap')}, the first of {steps[gaps[0]]:.3g} s at "
            f"{record.time_s[gaps[0]]:.4g} s; nothing is concluded across them"
        )
    return np.split(np.arange(len(record)), gaps + 1)


def _even(time_s: Floats, signals: Floats, step: float) -> Floats:
    """Return signals [k, n] at one step: [k, m]."""
    from scipy.interpolate import make_interp_spline

    if np.max(np.abs(np.diff(time_s) - step)) <= 0.01 * step:
        return signals
    grid = np.arange(time_s[0], time_s[-1], step)
    even = np.full((len(signals), len(grid)), np.nan)
    there = ~np.isnan(signals[:, 0])  # a rig without pressure has none at all
    even[there] = make_interp_spline(time_s, signals[there].T, k=3)(grid).T
    return even


def _judged(
    rig: ForceRig,
    parts: list[Floats],
    step: float,
    noise: Sequence[tuple[float, float]],
    rotary: bool,
    findings: list[str],
    doubts: list[str],
) -> Recorded:
    """Return the parts [4, m] as one record: filtered, its strokes found, slow samples left out; noise: of each part."""
    from scipy.ndimage import binary_dilation

    counts = [part.shape[1] for part in parts]
    starts = np.cumsum([0, *counts[:-1]])
    smooth_s = rig.body.smooth_s
    position_sd = _joint_noise(noise, counts)[1]
    width = _width(parts, position_sd) if smooth_s is None else max(1.0, smooth_s / step)
    x, f, p, recorded_n = np.concatenate(parts, axis=1)
    v, a = (
        np.concatenate([smoothed(part[0], width, order) for part in parts]) / step**order
        for order in (1, 2)
    )
    fast = float(np.quantile(np.abs(v), 0.99))
    slow = 0.05 * fast if rig.body.slow_m_s is None else rig.body.slow_m_s
    moving = np.abs(v) > slow
    judged = moving & away_from_ends(starts, len(x), width)
    # A quick turn passes all that is slow between two samples: force and acceleration have steps and
    # pulses there that single samples do not show. Near rest and turns friction is not what the speed says
    turns = np.append(v[1:] * v[:-1] < 0.0, False)
    turns[starts[1:] - 1] = False
    mixed = ~moving | turns | np.roll(turns, 1)
    away = judged & ~binary_dilation(mixed, iterations=int(np.ceil(2.0 * width)))
    if 3 * np.count_nonzero(away) > np.count_nonzero(judged):
        judged = away
    if np.count_nonzero(judged) < 0.5 * FEWEST_SAMPLES:
        why = "hardly moves, or slow_m_s or smooth_s of [body] is too large"
        raise InputError(f"{rig.name}: position_m: {why}; expected strokes")
    # filtered samples next to each other say the same
    stride = max(1, int(0.6 * width))
    judged &= np.arange(len(judged)) % stride == 0
    stroke = _strokes(v, moving, starts)
    kept = np.unique(stroke[judged])
    order, count, held_out = np.arange(len(x)), len(x), "blocks of time"
    if len(kept) >= FEWEST_STROKES:
        held_out = "strokes"
        pairs = len(kept) >= 2 * FEWEST_STROKES  # there and back
        order = np.searchsorted(kept, stroke) // (2 if pairs else 1)
        count = int(order[judged].max()) + 1
    folds = 24  # at most
    block = order * folds // max(folds, count)
    pressure = None if np.isnan(p).any() else p
    force_sd, position_sd = _joint_noise(noise, np.add.reduceat(judged.astype(int), starts))
    return Recorded(
        name=rig.name,
        raw=Motion(f, v, a, x, pressure, block.astype(np.int64)),
        recorded_n=recorded_n,
        starts=starts,
        judged=judged,
        stroke=stroke,
        width=width,
        step_s=step,
        force_sd_n=force_sd,
        position_sd_m=position_sd,
        held_out=held_out,
        body=rig.body,
        units=ROTARY if rotary else {},
        findings=tuple(findings),
        doubts=tuple(doubts),
        stride=stride,
    )


def _joint_noise(
    noise: Sequence[tuple[float, float]], counts: Sequence[int] | NDArray[np.int64]
) -> tuple[float, float]:
    """Return the noise of force and position of parts that contribute so many samples."""
    force_sd, position_sd = np.sqrt(np.average(np.square(noise), axis=0, weights=counts))
    return float(force_sd), float(position_sd)


def away_from_ends(
    starts: NDArray[np.int64], count: int, width: float, steps: int = 0
) -> NDArray[np.bool_]:
    """Return which of `count` samples [n] are the filter's reach and `steps` from the ends of their part."""
    reach = int(np.ceil(RADIUS * width)) + steps
    away = np.zeros(count, dtype=bool)
    for first, last in zip(starts, [*starts[1:], count], strict=True):
        away[first + reach : max(last - reach, 0)] = True
    return away


def _strokes(v: Floats, moving: NDArray[np.bool_], starts: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the number of the stroke of every sample: a new one where the motion turns."""
    is_start = np.isin(np.arange(len(v)), starts)
    rows = np.flatnonzero(moving | is_start)
    turned = np.zeros(len(v), dtype=np.int64)
    sign = np.sign(v[rows])
    turned[rows[1:]] = (sign[1:] != sign[:-1]) | is_start[rows[1:]]
    return np.cumsum(turned)


def _width(parts: list[Floats], position_sd: float, least: float = 1.5) -> float:
    """Return the narrowest filter that leaves little noise of acceleration, in samples, at least `least`.

    From half a percent to 5 % of the usual time between turns: between vibrations and motion.
    """
    width, count = least, sum(part.shape[1] for part in parts)
    while True:
        shares = []
        turns = 1
        for order in (1, 2):
            values = np.concatenate([smoothed(part[0], width, order) for part in parts])
            noise = position_sd * float(np.linalg.norm(kernel(width, order)))
            shares.append(noise / max(float(np.sqrt(np.mean(values**2))), 1e-300))
            if order == 1:
                level = np.sign(values[np.abs(values) > 0.1 * np.quantile(np.abs(values), 0.99)])
                turns += int(np.count_nonzero(np.diff(level)))
        wider = 1.25 * width
        enough = width >= 0.005 * count / turns and max(shares) <= 0.02
        if enough or wider > max(least, 0.05 * count / turns):
            return width
        width = wider

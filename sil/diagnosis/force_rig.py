"""Other actuators, known by driving force and position alone: which friction acts on them.

One body: D = M a + F_C sgn v + d v + F_0 + what a cause adds, with D the measured driving force.
Speed and acceleration come from the position by local polynomials; D goes through the same filter,
so both sides are delayed and smoothed alike. Every hypothesis is linear but for one shape
parameter, which is searched on a grid; blocks of time are held out in turn. The noise of force and
position is what the filter removes; carried through the balance it is the yardstick of the residual.

Source: inverse dynamic identification, e.g. Gautier, Janot, Vandanjon 2013.
Checked by: tests/unit/sil/diagnosis/test_force_rig.py
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from msgspec import Meta, Struct

from can_dbc.errors import InputError
from can_dbc.typed_toml import convert, read_toml
from plant.effects import CATALOGUE
from plant.effects.force_term import ForceTerm, Motion
from sil.campaign.campaign import ColumnMap, Floats, Rate, Text, column_maps, read_record
from sil.diagnosis.causes import Cause, diagnosis_json
from sil.diagnosis.checks import longest_run
from sil.diagnosis.intervals import Interval
from sil.diagnosis.residuals import Gain
from sil.diagnosis.verdict import SUREST, UNNAMED
from sil.fitting.floor import EXPLAINED

BODY = (("coulomb_n", "N"), ("viscous_n_s_m", "N s/m"), ("offset_n", "N"), ("mass_kg", "kg"))
BLOCKS = 24
LEAST_GAIN = 0.03
"""A cause must take this share of the held-out misfit away ..."""
SURE = 3.0
"""... by this many standard errors over the held-out blocks."""
LEAST_NOISE = 1e-6
"""A noise below this share of the driving force cannot be estimated from the record."""
STUCK_SHARE = 0.05
"""A driving force that repeats one value over this share of a record's motion is stuck."""

DETECTABILITY = (
    "with driving force and position alone: causes in the force balance; an offset may be a constant "
    "force or Coulomb friction that differs with direction"
)

TERMS: dict[str, ForceTerm] = {
    name: item.force for name, item in CATALOGUE.items() if item.force is not None
}
"""Effects that a force balance alone can show."""


class Body(Struct, frozen=True, forbid_unknown_fields=True):
    """The [body] of campaign.toml."""

    mass_kg: Annotated[float, Meta(ge=0.0, le=1e6)] | None = None
    piston_area_m2: Annotated[float, Meta(ge=-10.0, le=10.0)] = 0.0
    slow_m_s: Annotated[float, Meta(ge=0.0, le=1e3)] | None = None
    """Slower samples are left out; without it, 5 % of the highest speeds."""
    smooth_s: Annotated[float, Meta(ge=0.0, le=10.0)] = 0.02


class RecordedMotion(Struct, frozen=True, forbid_unknown_fields=True):
    """One [[stroke]] of campaign.toml."""

    file: Text
    label: str = ""


class ForceRig(Struct, frozen=True, forbid_unknown_fields=True):
    """The keys of campaign.toml with rig = "force"."""

    name: Text
    rig: Literal["force"]
    sample_rate_hz: Rate
    stroke: Annotated[list[RecordedMotion], Meta(min_length=1)]
    columns: dict[str, Text | ColumnMap] = {}
    body: Body = Body()


@dataclass(frozen=True)
class Tried:
    """A hypothesis, fitted.

    names, shapes: [k] causes and their shape parameters; values, deviations: [k] their coefficients
    with standard deviations; body, body_deviations: [3 or 4] parameters of the body in the order of
    BODY, without the mass if it is stated; squares: held-out sum of squares of each block of time
    [N^2]; residual_n: [n] of the fit to all blocks [N].
    """

    names: tuple[str, ...]
    shapes: tuple[float, ...]
    values: Floats
    deviations: Floats
    body: Floats
    body_deviations: Floats
    squares: Floats
    residual_n: Floats

    @property
    def total(self) -> float:
        """Held-out sum of squares [N^2]."""
        return float(self.squares.sum())


def _description(path: str | Path) -> Path:
    """Return the campaign.toml of a folder, or the file itself."""
    folder = Path(path)
    return folder if folder.suffix == ".toml" else folder / "campaign.toml"


def is_force_rig(path: str | Path) -> bool:
    """Return whether a campaign describes a rig known by force and position alone."""
    file = _description(path)
    return file.is_file() and read_toml(file).get("rig") == "force"


def _read_motion(path: str | Path) -> tuple[str, Motion, float | None]:
    """Return name, moving samples and stated mass of a campaign with rig = "force".

    Raises InputError naming file and key or column: one that is missing, a value that is not a
    number, a force that is stuck, a body that never moves.
    """
    file = _description(path)
    rig = convert(read_toml(file), ForceRig, str(file))
    columns, mass = column_maps(rig.columns), rig.body.mass_kg
    parts = [
        _moving(file.parent / entry.file, columns, rig.body, rig.sample_rate_hz)
        for entry in rig.stroke
    ]
    table = np.concatenate([samples for samples, _variances in parts])
    first = np.cumsum([0, *(samples[-1, 5] + 1 for samples, _variances in parts)])
    lengths = [len(samples) for samples, _variances in parts]
    block = (table[:, 5] + np.repeat(first[:-1], lengths)).astype(np.int64)
    force, speed, acceleration, position, pressure = table[:, :5].T
    motion = Motion(
        force,
        speed,
        acceleration,
        position,
        None if np.isnan(pressure).any() else pressure,
        block,
        rig.sample_rate_hz,
        0.0,
    )
    variances = np.average([v for _samples, v in parts], axis=0, weights=lengths)
    plain, target = balance(motion, mass)
    found = np.linalg.lstsq(plain, target, rcond=None)[0]
    scales = np.array([1.0, found[1], found[3] if mass is None else mass])
    noise = float(np.sqrt(np.sum(scales**2 * variances)))
    return rig.name, replace(motion, noise_n=noise), mass


def _moving(
    path: Path, columns: Mapping[str, ColumnMap], body: Body, rate: float
) -> tuple[Floats, Floats]:
    """Return one file's moving samples and the noise variances of force, speed and acceleration.

    Samples [n, 6]: force [N], speed [m/s], acceleration [m/s^2], position [m], pressure [Pa, NaN
    without], block of time. Raises InputError as `_read_motion` does.
    """
    record = read_record(path, columns)
    area = body.piston_area_m2
    if "position_m" not in record:
        raise InputError(f"{path}: no position_m; expected position and a driving force")
    if "force_n" not in record and not (area and "pressure_pa" in record):
        raise InputError(
            f"{path}: no force_n, and no pressure_pa with piston_area_m2; expected a driving force"
        )
    steps = np.diff(record.time_s)
    grid = np.arange(record.time_s[0], record.time_s[-1], max(1.0 / rate, float(np.median(steps))))
    if len(grid) < 200:
        raise InputError(f"{path}: {len(record.time_s)} samples; expected at least 200")

    def even(column: str) -> Floats:
        return np.interp(grid, record.time_s, record[column])

    force = even("force_n") if "force_n" in record else np.zeros(len(grid))
    pressure = even("pressure_pa") if "pressure_pa" in record else np.full(len(grid), np.nan)
    if area:
        force = force + area * pressure
    step = float(grid[1] - grid[0])
    half = max(2, round(0.5 * body.smooth_s / step))
    position = even("position_m")
    x, v, a = (
        scale * local_polynomial(position, half, order) / step**order
        for order, scale in ((0, 1.0), (1, 1.0), (2, 2.0))
    )
    d = local_polynomial(force, half, 0)
    fast = float(np.quantile(np.abs(v), 0.99))
    slow = 0.05 * fast if body.slow_m_s is None else body.slow_m_s
    keep = np.abs(v) > slow
    keep[: 2 * half] = keep[-2 * half :] = False
    if np.count_nonzero(keep) < 100:
        raise InputError(f"{path}: position_m: hardly moves; expected strokes")
    held = longest_run(np.diff(force[keep]) == 0.0)
    if held > STUCK_SHARE * np.count_nonzero(keep):
        raise InputError(
            f"{path}: the driving force keeps one value over {held + 1} samples in motion; "
            "expected a sensor that is not stuck"
        )
    block = np.floor(np.arange(len(grid)) * BLOCKS / len(grid))
    w = [np.linalg.norm(_weights(half, order)) for order in range(3)]
    force_sd, position_sd = (
        _spread_of((raw - smooth)[keep]) / np.sqrt(1.0 - _weights(half, 0)[half])
        for raw, smooth in ((force, d), (position, x))
    )
    deviations = (w[0] * force_sd, w[1] * position_sd / step, 2.0 * w[2] * position_sd / step**2)
    return np.column_stack([d, v, a, x, pressure, block])[keep], np.array(deviations) ** 2


def _spread_of(values: Floats) -> float:
    """Return the standard deviation of values [n] by their median deviation: jumps count little."""
    return float(1.4826 * np.median(np.abs(values - np.median(values))))


def _weights(half: int, order: int) -> Floats:
    """Return the weights [2 half + 1] of a local cubic's coefficient of t^order."""
    t = np.arange(-half, half + 1, dtype=np.float64)
    return np.asarray(np.linalg.pinv(np.vander(t, 4, increasing=True))[order])


def local_polynomial(values: Floats, half: int, order: int) -> Floats:
    """Return the coefficient of t^order [n, per step^order] of a cubic around each of values [n]."""
    padded = np.pad(values, half, mode="edge")
    return np.asarray(np.convolve(padded, _weights(half, order)[::-1], mode="valid"))


# --- hypotheses -------------------------------------------------------------------------------
def balance(
    motion: Motion,
    mass_kg: float | None,
    names: tuple[str, ...] = (),
    shapes: tuple[float, ...] = (),
) -> tuple[Floats, Floats]:
    """Return the columns [n, k] of a force balance and its target [n] in N.

    First the 3 or 4 columns of the plain body in the order of BODY, then those of the causes.
    """
    v, target = motion.speed_m_s, motion.force_n
    columns = [np.sign(v), v, np.ones(len(v))]
    if mass_kg is None:
        columns.append(motion.acceleration_m_s2)
    else:
        target = target - mass_kg * motion.acceleration_m_s2
    columns += [TERMS[n].feature(motion, s) for n, s in zip(names, shapes, strict=True)]
    return np.column_stack(columns), target


def _attempt(
    names: tuple[str, ...], shapes: tuple[float, ...], motion: Motion, mass_kg: float | None
) -> Tried:
    """Fit a hypothesis with every block held out in turn; deviations from the blocks."""
    columns, target = balance(motion, mass_kg, names, shapes)
    scale = np.sqrt(np.mean(columns**2, axis=0)) + 1e-300
    columns = columns / scale
    rows = [motion.block == number for number in np.unique(motion.block)]
    grams = [columns[r].T @ columns[r] for r in rows]
    sides = [columns[r].T @ target[r] for r in rows]
    gram, side = sum(grams), sum(sides)
    guard = 1e-9 * np.trace(gram) * np.eye(len(gram))
    solutions = [
        np.linalg.solve(gram - g + guard, side - s) for g, s in zip(grams, sides, strict=True)
    ]
    squares = [
        float(np.sum((target[r] - columns[r] @ without) ** 2))
        for r, without in zip(rows, solutions, strict=True)
    ]
    values = np.linalg.solve(gram + guard, side)
    count = len(rows)
    # jackknife over blocks: neighbouring samples are not independent
    spread = np.sqrt((count - 1) / count * np.sum((np.array(solutions) - values) ** 2, axis=0))
    residual = target - columns @ values
    values, spread = values / scale, spread / scale
    k = len(values) - len(names)
    return Tried(
        names, shapes, values[k:], spread[k:], values[:k], spread[:k], np.array(squares), residual
    )


def _best_of(names: tuple[str, ...], motion: Motion, mass_kg: float | None) -> Tried:
    """Return a hypothesis with its best shape by its held-out squares."""
    grids = [TERMS[name].shapes(motion) for name in names]
    tried = [_attempt(names, shapes, motion, mass_kg) for shapes in itertools.product(*grids)]
    return min(tried, key=lambda item: item.total)


def _physical(item: Tried) -> bool:
    """Return whether every coefficient has a physical sign and an interval without zero."""
    return all(
        (TERMS[name].sign == 0 or value > 0.0) and abs(value) >= 2.0 * deviation
        for name, value, deviation in zip(item.names, item.values, item.deviations, strict=True)
    )


def gains(item: Tried, other: Tried) -> tuple[float, float]:
    """Return the share of the other's held-out squares removed, and that in standard errors."""
    differences = other.squares - item.squares
    error = float(np.std(differences, ddof=1) * np.sqrt(len(differences))) + 1e-300
    return float(differences.sum() / other.total), float(differences.sum() / error)


def _dependence(residual_n: Floats, motion: Motion) -> tuple[str, float]:
    """Return what a residual depends on most, and the share of its squares that this explains.

    By the means over 24 bins of speed, position and time.
    """
    found: dict[str, float] = {}
    axes = {
        "speed": motion.speed_m_s,
        "position": motion.position_m,
        "time": motion.block.astype(np.float64),
    }
    for name, values in axes.items():
        edges = np.quantile(values, np.linspace(0.0, 1.0, BLOCKS + 1)[1:-1])
        which = np.searchsorted(edges, values)
        counts = np.maximum(np.bincount(which, minlength=BLOCKS), 1)
        means = np.bincount(which, residual_n, BLOCKS) / counts
        found[name] = float(np.sum(means[which] ** 2) / np.sum(residual_n**2))
    return max(found.items(), key=lambda item: item[1])


@dataclass(frozen=True)
class ForceDiagnosis:
    """What was found on a rig known by force and position alone.

    leader: the hypothesis accepted (the plain body if no cause is); refused: why a cause is not
    claimed; doubts: why nothing can be concluded.
    """

    name: str
    motion: Motion
    plain: Tried
    leader: Tried
    singles: Mapping[str, Tried]
    refused: Mapping[str, str]
    mass_kg: float | None
    doubts: tuple[str, ...] = ()

    def error(self, item: Tried) -> float:
        """Return the relative force error: held-out rms over the rms of the driving force."""
        return float(np.sqrt(item.total / np.sum(self.motion.force_n**2)))

    def rms_n(self, item: Tried) -> float:
        """Return the held-out rms [N]."""
        return float(np.sqrt(item.total / len(self.motion.force_n)))

    def over_noise(self, item: Tried) -> float:
        """Return the held-out rms over the noise of the force balance; 1 = explained."""
        return self.rms_n(item) / max(self.motion.noise_n, 1e-300)

    @property
    def verdict(self) -> str:
        """One of the verdicts of a diagnosis.

        A residual beyond the noise is never consistent, and a named cause must remove it.
        """
        if self.doubts:
            return "cannot_tell"
        if self.over_noise(self.leader) > EXPLAINED:
            return UNNAMED
        return "named" if self.leader.names else "consistent"

    def body(self) -> dict[str, Interval]:
        """Return the body's fitted parameters."""
        pairs = zip(self.leader.body.tolist(), self.leader.body_deviations.tolist(), strict=True)
        return {
            name: Interval.normal(value, deviation, unit)
            for (name, unit), (value, deviation) in zip(BODY, pairs, strict=False)
        }

    def causes(self) -> list[Cause]:
        """Return the causes claimed, most probable first; last one that no named cause explains."""
        found: list[Cause] = []
        before, after = self.error(self.plain), self.error(self.leader)
        pairs = zip(self.leader.values, self.leader.deviations, strict=True)
        for name, (value, deviation) in zip(self.leader.names, pairs, strict=True):
            rest = [n for n in self.leader.names if n != name]
            taken, sure = gains(self.leader, self.singles[rest[0]] if rest else self.plain)
            form = TERMS[name]
            found.append(
                Cause(
                    name,
                    CATALOGUE[name].cause_class,
                    min(SUREST, 1.0 - 0.5 * float(np.exp(-0.5 * (sure - 2.0)))),
                    {form.parameter: Interval.normal(value, deviation, form.unit)},
                    f"{form.what}: {value:.3g} {form.unit}; removes {taken:.1%} of the squared force "
                    f"error of held-out blocks, {sure:.1f} standard errors; relative force error "
                    f"{before:.2%} before, {after:.2%} after",
                )
            )
        found.sort(key=lambda cause: -cause.probability)
        if self.verdict == UNNAMED:
            found.append(self._unexplained())
        return found

    def _unexplained(self) -> Cause:
        """Return the cause of a residual that neither noise nor a named cause explains."""
        noise = self.motion.noise_n
        blocks = self.leader.squares / np.unique(self.motion.block, return_counts=True)[1]
        error = 1.96 * float(np.std(blocks, ddof=1) / np.sqrt(len(blocks)))
        mean = self.rms_n(self.leader) ** 2 - noise**2
        low, value, high = (max(0.0, mean + e) ** 0.5 for e in (-error, 0.0, error))
        on, share = _dependence(self.leader.residual_n, self.motion)
        return Cause(
            UNNAMED,
            "friction" if on == "speed" else "mechanics",
            SUREST,
            {"force_rms_n": Interval(value, low, high, "N")},
            f"a force of {value:.3g} N rms that no named cause explains: the held-out residual is "
            f"{self.over_noise(self.leader):.3g} times the noise of {noise:.3g} N; {on} explains "
            f"{share:.0%} of it",
        )

    def findings(self) -> list[str]:
        """Return why nothing can be concluded, and why causes are not claimed."""
        return [*self.doubts, *(f"{name}: {why}" for name, why in self.refused.items())]

    def as_json(self) -> dict[str, Any]:
        """Return the object that diagnosis.json holds."""
        before, after = self.rms_n(self.plain), self.rms_n(self.leader)
        gain = Gain(
            ("every block of time in turn",),
            {"force_n": (before, after)},
            self.over_noise(self.plain),
            self.over_noise(self.leader),
        )
        return diagnosis_json(
            self.name,
            self.verdict,
            [] if self.doubts else self.causes(),
            self.findings(),
            f"at least {LEAST_GAIN:.0%} of the held-out squares and {SURE:g} standard errors over "
            f"blocks; explained: a residual of at most {EXPLAINED:g} times the noise",
            gain=gain.as_json(),
            body={name: item.as_json() for name, item in self.body().items()},
            noise_n=self.motion.noise_n,
            detectability=DETECTABILITY,
        )


def diagnose_force(path: str | Path) -> ForceDiagnosis:
    """Diagnose a campaign with rig = "force": named friction causes, single and in pairs.

    Raises InputError as `_read_motion` does.
    """
    name, motion, mass = _read_motion(path)
    plain = _attempt((), (), motion, mass)
    known = [n for n, t in TERMS.items() if motion.pressure_pa is not None or not t.needs_pressure]
    singles = {n: _best_of((n,), motion, mass) for n in known}
    refused: dict[str, str] = {}
    accepted: list[Tried] = []
    for cause, item in singles.items():
        taken, sure = gains(item, plain)
        if not _physical(item):
            refused[cause] = f"refused: {item.values[0]:.3g} {TERMS[cause].unit} is not physical"
        elif taken < LEAST_GAIN or sure < SURE:
            refused[cause] = (
                f"refused: removes {taken:.1%} of the held-out squares, {sure:.1f} standard errors"
            )
        else:
            accepted.append(item)
    leader = min(accepted, key=lambda item: item.total, default=plain)
    if leader.names:
        pairs = _pairs_with(leader, known, singles, motion, mass)
        leader = min([leader, *pairs], key=lambda item: item.total)
        for item in accepted:
            if not set(item.names) <= set(leader.names):
                refused[item.names[0]] = f"explained by {' + '.join(leader.names)}"
    doubts = tuple(_doubts(plain, motion))
    return ForceDiagnosis(name, motion, plain, leader, singles, refused, mass, doubts)


def _doubts(plain: Tried, motion: Motion) -> list[str]:
    """Return why nothing can be concluded from this record, none usually."""
    found = []
    reversed_sign = (
        "the sign of the driving force or of position_m is reversed, or other forces act"
    )
    speed = np.abs(motion.speed_m_s)
    power_w = plain.body[0] * float(np.mean(speed)) + plain.body[1] * float(np.mean(speed**2))
    if power_w < 0.0:
        found.append(f"friction would drive the body ({-power_w:.3g} W): {reversed_sign}")
    if len(plain.body) == len(BODY) and plain.body[3] + 1.96 * plain.body_deviations[3] < 0.0:
        found.append(f"the mass comes out as {plain.body[3]:.3g} kg: {reversed_sign}")
    if motion.noise_n < LEAST_NOISE * float(np.sqrt(np.mean(motion.force_n**2))):
        found.append("the record has no noise to compare a residual with: filtered or simulated")
    return found


def _pairs_with(
    leader: Tried,
    known: Sequence[str],
    singles: Mapping[str, Tried],
    motion: Motion,
    mass: float | None,
) -> list[Tried]:
    """Return the pairs with the leading single in which either cause is needed."""
    found = []
    for other in known:
        if other in leader.names:
            continue
        pair = _best_of((*leader.names, other), motion, mass)
        both = [gains(pair, single) for single in (leader, singles[other])]
        if _physical(pair) and all(taken >= LEAST_GAIN and sure >= SURE for taken, sure in both):
            found.append(pair)
    return found

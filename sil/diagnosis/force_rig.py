"""Other actuators, known by driving force and position alone: which friction acts on them.

One body: D = M a + F_C sgn v + d v + F_0 + what a cause adds, with D the measured driving force.
Speed and acceleration come from the position by local polynomials; D goes through the same filter,
so both sides are delayed and smoothed alike.  Every hypothesis is linear but for one shape
parameter, which is searched on a grid; blocks of time are held out in turn.

Source: inverse dynamic identification, e.g. Gautier, Janot, Vandanjon 2013.
Checked by: tests/unit/sil/diagnosis/test_force_rig.py
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from can_dbc.errors import InputError
from plant.parameters import read_toml
from sil.campaign.campaign import ColumnMap, finite, parse_columns, read_record, real, text

Floats = NDArray[np.float64]

KEYS = {"name", "rig", "sample_rate_hz", "columns", "body", "stroke"}
BODY_KEYS = {"mass_kg", "piston_area_m2", "slow_m_s", "smooth_s"}
BLOCKS = 24
LEAST_GAIN = 0.03
"""A cause must take this share of the held-out misfit away ..."""
SURE = 3.0
"""... by this many standard errors over the held-out blocks."""
UNITS = {
    "friction_asymmetry": ("viscous_n_s_m", "N s/m"),
    "stribeck": ("force_n", "N"),
    "seal_pressure_friction": ("friction_n_pa", "N/Pa"),
    "friction_bump": ("force_n", "N"),
}
WHAT = {
    "friction_asymmetry": "friction grows with speed more in one direction than in the other",
    "stribeck": "sliding friction falls from a higher level over a speed",
    "seal_pressure_friction": "friction grows with the pressure across the piston",
    "friction_bump": "local drag around one position",
}


@dataclass(frozen=True)
class Motion:
    """Samples in which the body moves: driving force and what it may depend on, with block numbers."""

    force_n: Floats
    speed_m_s: Floats
    acceleration_m_s2: Floats
    position_m: Floats
    pressure_pa: Floats | None
    block: NDArray[np.int64]
    rate_hz: float


@dataclass(frozen=True)
class Tried:
    """A hypothesis: names, shape parameters, coefficients with deviations, held-out squares by block."""

    names: tuple[str, ...]
    shapes: tuple[float, ...]
    values: Floats
    deviations: Floats
    squares: Floats

    @property
    def total(self) -> float:
        """Held-out sum of squares [N^2]."""
        return float(self.squares.sum())


def is_force_rig(path: str | Path) -> bool:
    """Whether a campaign describes a rig known by force and position alone."""
    folder = Path(path)
    file = folder if folder.suffix == ".toml" else folder / "campaign.toml"
    return file.is_file() and read_toml(file).get("rig") == "force"


def read_motion(path: str | Path) -> tuple[str, Motion, float | None]:
    """Name, moving samples and the stated mass of a campaign with rig = "force".

    Raises InputError naming file and place of a missing key, column, or a body that never moves.
    """
    folder = Path(path)
    file = folder if folder.suffix == ".toml" else folder / "campaign.toml"
    raw = read_toml(file)
    name = str(file)
    unknown = sorted(set(raw) - KEYS)
    if unknown:
        raise InputError(f"{name}: {unknown[0]}: unknown key; expected {', '.join(sorted(KEYS))}")
    body = raw.get("body", {})
    if not isinstance(body, dict) or set(body) - BODY_KEYS:
        raise InputError(f"{name}: [body]: expected a table of {', '.join(sorted(BODY_KEYS))}")
    columns = parse_columns(raw.get("columns", {}), name)
    rate = real(raw, "sample_rate_hz", name, low=1.0, high=1e8)
    strokes = raw.get("stroke")
    if not isinstance(strokes, list) or not strokes:
        raise InputError(f"{name}: no [[stroke]]; expected at least one")
    parts = []
    for number, entry in enumerate(strokes, start=1):
        place = f"{name}: stroke {number}"
        if not isinstance(entry, dict) or set(entry) - {"file", "label"}:
            raise InputError(f"{place}: expected file and label")
        parts.append(moving(file.parent / text(entry, "file", place), columns, body, rate, name))
    first = 0
    joined: dict[str, list[Floats]] = {key: [] for key in ("d", "v", "a", "x", "p", "b")}
    for part in parts:
        for key, values in zip("dvaxp", part[:5], strict=True):
            joined[key].append(values)
        joined["b"].append(part[5] + first)
        first = int(joined["b"][-1].max()) + 1
    whole = {key: np.concatenate(values) for key, values in joined.items()}
    pressure = None if np.isnan(whole["p"]).any() else whole["p"]
    motion = Motion(
        whole["d"], whole["v"], whole["a"], whole["x"], pressure, whole["b"].astype(np.int64), rate
    )
    mass = finite(body["mass_kg"], f"{name}: mass_kg", 0.0, 1e6) if "mass_kg" in body else None
    return text(raw, "name", name), motion, mass


def moving(
    path: Path, columns: Mapping[str, ColumnMap], body: Mapping[str, Any], rate: float, name: str
) -> tuple[Floats, Floats, Floats, Floats, Floats, Floats]:
    """Force, speed, acceleration, position, pressure and block of one file's moving samples."""
    record = read_record(path, columns)
    area = finite(body.get("piston_area_m2", 0.0), f"{name}: piston_area_m2", -10.0, 10.0)
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
    half = max(
        2, round(0.5 * finite(body.get("smooth_s", 0.02), f"{name}: smooth_s", 0.0, 10.0) / step)
    )
    position = even("position_m")
    x, v, a = (local_polynomial(position, half, order) / step**order for order in (0, 1, 2))
    a = 2.0 * a
    d = local_polynomial(force, half, 0)
    fast = float(np.quantile(np.abs(v), 0.99))
    slow = finite(body.get("slow_m_s", 0.05 * fast), f"{name}: slow_m_s", 0.0, 1e3)
    keep = np.abs(v) > slow
    keep[: 2 * half] = keep[-2 * half :] = False
    if np.count_nonzero(keep) < 100:
        raise InputError(f"{path}: position_m: hardly moves; expected strokes")
    block = np.floor(np.arange(len(grid)) * BLOCKS / len(grid))
    return d[keep], v[keep], a[keep], x[keep], pressure[keep], block[keep]


def local_polynomial(values: Floats, half: int, order: int) -> Floats:
    """Coefficient of t^order of a cubic fitted to 2 half + 1 samples around each one [per step^order]."""
    t = np.arange(-half, half + 1, dtype=np.float64)
    weights = np.linalg.pinv(np.vander(t, 4, increasing=True))[order]
    padded = np.pad(values, half, mode="edge")
    return np.asarray(np.convolve(padded, weights[::-1], mode="valid"))


# --- hypotheses -------------------------------------------------------------------------------
def shapes_of(name: str, motion: Motion) -> tuple[float, ...]:
    """Shape parameters that a cause is tried with."""
    if name == "stribeck":
        fast = float(np.quantile(np.abs(motion.speed_m_s), 0.99))
        return tuple(fast * share for share in (0.05, 0.1, 0.2, 0.4))
    if name == "friction_bump":
        low, high = np.quantile(motion.position_m, (0.05, 0.95))
        return tuple(np.linspace(low, high, 9))
    return (0.0,)


def feature(name: str, shape: float, motion: Motion) -> Floats:
    """What a cause adds to the driving force, per unit of its coefficient."""
    v, sign = motion.speed_m_s, np.sign(motion.speed_m_s)
    if name == "friction_asymmetry":
        return np.abs(v)
    if name == "stribeck":
        return np.asarray(sign * np.exp(-np.abs(v) / shape))
    if name == "seal_pressure_friction":
        assert motion.pressure_pa is not None
        return np.asarray(sign * np.abs(motion.pressure_pa))
    low, high = np.quantile(motion.position_m, (0.05, 0.95))
    return np.asarray(
        sign * np.exp(-0.5 * ((motion.position_m - shape) / (0.08 * (high - low))) ** 2)
    )


def base(motion: Motion, mass_kg: float | None) -> tuple[Floats, Floats]:
    """Columns of the plain body (mass unless stated, Coulomb, viscous, offset) and what is left."""
    v = motion.speed_m_s
    columns = [np.sign(v), v, np.ones(len(v))]
    left = motion.force_n
    if mass_kg is None:
        columns.append(motion.acceleration_m_s2)
    else:
        left = left - mass_kg * motion.acceleration_m_s2
    return np.column_stack(columns), left


def attempt(
    names: tuple[str, ...], shapes: tuple[float, ...], motion: Motion, mass_kg: float | None
) -> Tried:
    """Fit a hypothesis with every block held out in turn; deviations from the blocks."""
    plain, left = base(motion, mass_kg)
    added = [feature(n, s, motion) for n, s in zip(names, shapes, strict=True)]
    columns = np.column_stack([plain, *added]) if added else plain
    scale = np.sqrt(np.mean(columns**2, axis=0)) + 1e-300
    columns = columns / scale
    numbers = np.unique(motion.block)
    grams, sides, squares = [], [], []
    for number in numbers:
        rows = motion.block == number
        grams.append(columns[rows].T @ columns[rows])
        sides.append(columns[rows].T @ left[rows])
    gram, side = sum(grams), sum(sides)
    guard = 1e-9 * np.trace(gram) * np.eye(len(gram))
    solutions = []
    for k, number in enumerate(numbers):
        rows = motion.block == number
        without = np.linalg.solve(gram - grams[k] + guard, side - sides[k])
        solutions.append(without)
        error = left[rows] - columns[rows] @ without
        squares.append(float(error @ error))
    values = np.linalg.solve(gram + guard, side)
    count = len(numbers)
    # jackknife over blocks: neighbouring samples are not independent
    spread = np.sqrt((count - 1) / count * np.sum((np.array(solutions) - values) ** 2, axis=0))
    first = plain.shape[1]
    return Tried(
        names, shapes, (values / scale)[first:], (spread / scale)[first:], np.array(squares)
    )


def best_of(names: tuple[str, ...], motion: Motion, mass_kg: float | None) -> Tried:
    """The best shape of a hypothesis by its held-out squares."""
    grids = [shapes_of(name, motion) for name in names]
    tried = [attempt(names, shapes, motion, mass_kg) for shapes in itertools.product(*grids)]
    return min(tried, key=lambda item: item.total)


def physical(item: Tried) -> bool:
    """Whether the extra friction of one-sided causes is positive, and nothing is nil in its interval."""
    for name, value, deviation in zip(item.names, item.values, item.deviations, strict=True):
        if name != "friction_asymmetry" and value <= 0.0:
            return False
        if abs(value) < 2.0 * deviation:
            return False
    return True


def gains(item: Tried, other: Tried) -> tuple[float, float]:
    """Share of the other's held-out squares that a hypothesis takes away, and in standard errors."""
    differences = other.squares - item.squares
    error = float(np.std(differences, ddof=1) * np.sqrt(len(differences))) + 1e-300
    return float(differences.sum() / other.total), float(differences.sum() / error)


@dataclass(frozen=True)
class ForceDiagnosis:
    """What was found on a rig known by force and position: hypotheses, the one that stands, refusals."""

    name: str
    motion: Motion
    plain: Tried
    leader: Tried
    singles: Mapping[str, Tried]
    refused: Mapping[str, str]
    mass_kg: float | None

    def error(self, item: Tried) -> float:
        """Relative force error: held-out rms over the rms of the driving force."""
        return float(np.sqrt(item.total / np.sum(self.motion.force_n**2)))

    def as_json(self) -> dict[str, Any]:
        """The object that diagnosis.json holds."""
        count = len(self.motion.force_n)
        before, after = (float(np.sqrt(i.total / count)) for i in (self.plain, self.leader))
        causes = []
        for name, value, deviation in zip(
            self.leader.names, self.leader.values, self.leader.deviations, strict=True
        ):
            rest = tuple(n for n in self.leader.names if n != name)
            without = self.singles[rest[0]] if rest else self.plain
            taken, sure = gains(self.leader, without)
            key, unit = UNITS[name]
            interval = {
                "value": value,
                "low": value - 1.96 * deviation,
                "high": value + 1.96 * deviation,
                "unit": unit,
            }
            causes.append(
                {
                    "id": name,
                    "class": "friction",
                    "probability": round(
                        min(0.98, 1.0 - 0.5 * float(np.exp(-0.5 * (sure - 2.0)))), 4
                    ),
                    "parameters": {key: interval},
                    "evidence": f"{WHAT[name]}: {value:.3g} {unit}; takes {taken:.1%} of the squared "
                    f"force error of held-out blocks away, {sure:.1f} standard errors; relative force "
                    f"error {self.error(self.plain):.2%} before, {self.error(self.leader):.2%} after",
                }
            )
        return {
            "format": 1,
            "campaign": self.name,
            "verdict": "named" if causes else "consistent",
            "causes": sorted(causes, key=lambda c: -float(c["probability"])),
            "rivals": [],
            "next_experiment": None,
            "gain": {
                "heldout_strokes": ["every block of time in turn"],
                "channels": {"force_n": {"before": before, "after": after, "unit": "rms"}},
                "standardised": {"before": before / max(after, 1e-300), "after": 1.0},
            },
            "false_alarm": {
                "level": 0.01,
                "basis": f"at least {LEAST_GAIN:.0%} of the held-out squares and {SURE:g} standard "
                "errors over blocks",
            },
            "extended_model": None,
            "findings": [f"{name}: {why}" for name, why in self.refused.items()],
            "detectability": "with driving force and position alone: causes in the force balance; an "
            "offset may be a constant force or Coulomb friction that differs with direction",
        }


def diagnose_force(path: str | Path) -> ForceDiagnosis:
    """Diagnose a campaign with rig = "force": named friction causes, single and in pairs."""
    name, motion, mass = read_motion(path)
    plain = attempt((), (), motion, mass)
    known = [n for n in UNITS if n != "seal_pressure_friction" or motion.pressure_pa is not None]
    singles = {n: best_of((n,), motion, mass) for n in known}
    refused: dict[str, str] = {}
    standing: list[Tried] = []
    for cause, item in singles.items():
        taken, sure = gains(item, plain)
        if not physical(item):
            refused[cause] = (
                f"refused: {item.values[0]:.3g} {UNITS[cause][1]} is no physical amount"
            )
        elif taken < LEAST_GAIN or sure < SURE:
            refused[cause] = (
                f"refused: takes {taken:.1%} of the held-out squares away, {sure:.1f} standard errors"
            )
        else:
            standing.append(item)
    leader = min(standing, key=lambda item: item.total, default=plain)
    if leader.names:
        pairs = pairs_beside(leader, known, singles, motion, mass)
        leader = min([leader, *pairs], key=lambda item: item.total)
        for item in standing:
            if not set(item.names) <= set(leader.names):
                refused[item.names[0]] = f"explained by {' + '.join(leader.names)}"
    return ForceDiagnosis(name, motion, plain, leader, singles, refused, mass)


def pairs_beside(
    leader: Tried,
    known: Sequence[str],
    singles: Mapping[str, Tried],
    motion: Motion,
    mass: float | None,
) -> list[Tried]:
    """Pairs with the leading single in which either earns its place."""
    found = []
    first = singles[leader.names[0]]
    for other in known:
        if other in leader.names:
            continue
        pair = best_of((*leader.names, other), motion, mass)
        taken, sure = gains(pair, first)
        back, back_sure = gains(pair, singles[other])
        if physical(pair) and min(taken, back) >= LEAST_GAIN and min(sure, back_sure) >= SURE:
            found.append(pair)
    return found

"""Recorded shifts linearised around a point, and what follows from them by linear algebra alone.

Of every shift only its information matrix and score are retained, after its own scatter is
marginalised; all shifts, or any run of them, are sums of these.
Checked by: tests/unit/sil/shift_diagnosis/test_model.py
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sil.shift_diagnosis.model import (
    DIFFERENCE,
    JITTER_S,
    LEAST_NOISE_M,
    SHOWN,
    Cause,
    PlantModel,
    Point,
)
from sil.shift_diagnosis.shifts import Shift

Floats = NDArray[np.float64]

TAIL: Final = 6.0
"""Degrees of freedom of the prior of every quantity in which trucks differ."""
SIZE_PRIOR: Final = 3.0
"""Standard deviation of a cause's size, in typical ones."""


@dataclass(frozen=True)
class Linear:
    """Shifts linearised at a point; parameters are the unit's quantities, then the causes' sizes.

    names: of the unit's quantities; values: the point, in prior standard deviations and typical
    sizes [p]. information [n, p, p], score [n, p], misfit [n] (chi squared), count [n], volume [n]
    (log determinant of the noise) of each shift; residual_m: [n, pulses], NaN behind a shift's last; weights: of each shift, the inverse
    covariance of its pulses. Shifts that could not be simulated have count 0.
    """

    names: tuple[str, ...]
    causes: tuple[Cause, ...]
    values: Floats
    information: Floats
    score: Floats
    misfit: Floats
    count: NDArray[np.int64]
    volume: Floats
    residual_m: Floats
    weights: tuple[Floats, ...]

    @property
    def units(self) -> int:
        """How many parameters are the unit's."""
        return len(self.names)


def point_of(model: PlantModel, names: Sequence[str], values: Floats) -> dict[str, float]:
    """Return amounts in their units from values [names] in prior standard deviations."""
    return {name: float(v) * model.unit[name] for name, v in zip(names, values, strict=True)}


def unit_names(model: PlantModel) -> tuple[str, ...]:
    """Return the unit's quantities that act: those of the gearbox only if there is one."""
    gearbox = () if model.mounted else ("linkage", "mass")
    return tuple(name for name in model.unit if name not in gearbox)


def linearise(
    model: PlantModel,
    shifts: Sequence[Shift],
    values: Floats,
    causes: Sequence[Cause] = (),
    active: Mapping[Cause, float] | None = None,
    noise_m: float = LEAST_NOISE_M,
    difference: float = DIFFERENCE,
) -> Linear:
    """Linearise shifts around the unit's `values` [units] (prior deviations) and active causes' sizes.

    difference: step of the differences, in prior deviations and typical sizes.
    """
    names = unit_names(model)
    active = active or {}
    here = Point(point_of(model, names, values), tuple(active.items()))
    moved = [name for name in names if name not in SHOWN]
    points = [here]
    points += [here.moved(name, difference * model.unit[name]) for name in moved]
    steps = [difference if cause.sign >= 0 else -difference for cause in causes]
    points += [
        here.with_cause(cause, active.get(cause, 0.0) + step)
        for cause, step in zip(causes, steps, strict=True)
    ]
    x, v, done = model.predict(shifts, points)
    base, speed = x[:, 0], v[:, 0]
    columns = dict(zip(moved, np.moveaxis(x[:, 1 : 1 + len(moved)], 1, 0), strict=True))
    by = {name: (column - base) / difference for name, column in columns.items()}
    by["latency"] = -speed * model.unit["latency"]
    by["offset"] = np.full_like(base, model.unit["offset"])
    by["gain"] = base * model.unit["gain"]
    by_cause = [(x[:, 1 + len(moved) + j] - base) / step for j, step in enumerate(steps)]
    size = len(names) + len(causes)
    information = np.zeros((len(shifts), size, size))
    score, misfit = np.zeros((len(shifts), size)), np.zeros(len(shifts))
    volume, count = np.zeros(len(shifts)), np.zeros(len(shifts), dtype=np.int64)
    residuals = np.full(base.shape, np.nan)
    weights = []
    scatter = {name: model.each[name] / model.unit[name] for name in model.each if name in names}
    for k, shift in enumerate(shifts):
        n = len(shift.time_s)
        residual = shift.position_m - base[k, :n]
        residuals[k, :n] = residual
        own = np.stack([by[name][k, :n] for name in names] + [c[k, :n] for c in by_cause], axis=1)
        own[:, ~np.isfinite(own).all(axis=0)] = 0.0
        if not done[k, 0] or not np.isfinite(residual).all():
            weights.append(np.zeros((n, n)))
            continue
        own[:, ~_useful(done[k], len(names), names, moved)] = 0.0
        spread = np.stack([by[name][k, :n] * share for name, share in scatter.items()], axis=1)
        covariance = np.diag(noise_m**2 + (JITTER_S * speed[k, :n]) ** 2) + spread @ spread.T
        weight = np.linalg.inv(covariance)
        weights.append(weight)
        information[k] = own.T @ weight @ own
        score[k] = own.T @ (weight @ residual)
        misfit[k] = residual @ weight @ residual
        volume[k] = np.linalg.slogdet(covariance / noise_m**2)[1]
        count[k] = n
    sizes = np.array([active.get(cause, 0.0) for cause in causes])
    return Linear(
        names, tuple(causes), np.concatenate([values, sizes]), information, score, misfit, count,
        volume, residuals, tuple(weights),
    )  # fmt: skip


def _useful(
    done: NDArray[np.bool_], units: int, names: Sequence[str], moved: Sequence[str]
) -> NDArray[np.bool_]:
    """Return which columns of a shift come from simulations that went through."""
    own = dict(zip(moved, done[1 : 1 + len(moved)].tolist(), strict=True))
    return np.array([own.get(name, True) for name in names] + done[1 + len(moved) :].tolist())


def prior_cost(values: Floats) -> float:
    """Return minus the log prior of the unit's quantities [units] in prior deviations.

    Student's, of TAIL degrees of freedom: unusual trucks are not that rare.
    """
    return float(0.5 * (TAIL + 1.0) * np.sum(np.log1p(values**2 / TAIL)))


def prior_weight(linear: Linear) -> Floats:
    """Return the precision [p] of the priors of unit and sizes at the point, as a normal one's."""
    units = (TAIL + 1.0) / (TAIL + linear.values[: linear.units] ** 2)
    return np.append(units, np.full(len(linear.causes), 1.0 / SIZE_PRIOR**2))


def estimates(linear: Linear, damping: float = 0.0) -> tuple[Floats, Floats]:
    """Return estimate [p] and covariance [p, p] of all parameters in the linear model.

    damping: of the step, as a share of the information's diagonal.
    """
    h, g = linear.information.sum(axis=0), linear.score.sum(axis=0)
    weight = prior_weight(linear)
    precision = h + np.diag(weight + damping * np.diag(h))
    covariance = np.linalg.inv(precision)
    return linear.values + covariance @ (g - weight * linear.values), covariance


def projected(linear: Linear) -> tuple[Floats, Floats]:
    """Return information [causes, causes] and score [causes] of the causes' sizes at the point.

    The unit's quantities are marginalised with their priors.
    """
    n = linear.units
    h, g = linear.information.sum(axis=0), linear.score.sum(axis=0)
    weight = prior_weight(linear)[:n]
    gain = np.linalg.solve(h[:n, :n] + np.diag(weight), h[:n, n:]).T
    pull = g[:n] - linear.values[:n] * weight
    return h[n:, n:] - gain @ h[:n, n:], g[n:] - gain @ pull

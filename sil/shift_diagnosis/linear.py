"""Recorded shifts linearised around a point, and what follows from them by linear algebra alone.

Of every shift only its information matrix and score are retained, after its own scatter is
marginalised; all shifts, or any run of them, are sums of these.
Checked by: tests/unit/sil/shift_diagnosis/test_model.py
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sil.shift_diagnosis.model import (
    DIFFERENCE,
    JITTER_S,
    LEAST_NOISE_M,
    SHOWN,
    SPEED_NOISE_RAD_S,
    Cause,
    PlantModel,
    Point,
)
from sil.shift_diagnosis.shifts import RecordedShift

Floats = NDArray[np.float64]

TAIL: Final = 6.0
"""Degrees of freedom of the prior of every quantity in which trucks differ."""
CLIFF_M: Final = 15e-3
"""Motion of a pulse by one standard deviation or typical size that is no longer linear."""
REWEIGHTED: Final = 12
"""Rounds of reweighting by the priors' tails."""
LOAD_SHARE: Final = 0.6
"""How far a load differs between shifts, as a share of how far it does between trucks."""
TRIED_S: Final[Floats] = 1e-3 * np.array([0.5, 1.0, 2.0, 4.0])
"""Times before and after a pulse at which the stay is simulated, too: for kinks of the motion."""
INSTANT_S: Final = (5e-4, 2e-3)
"""Least and largest standard deviation assumed of the instants of a shift, between shifts."""
MOVING_M_S: Final = 0.1
NORMAL: Final = ((1.0, 0.242), (2.0, 0.054))
"""Standard deviations on one side, and the share of a normal distribution near each."""
SIZE_PRIOR: Final = 3.0
"""Standard deviation of a cause's size, in typical ones."""


@dataclass(frozen=True)
class Linear:
    """Shifts linearised at a point; parameters are the unit's quantities, then the causes' sizes.

    names: of the unit's quantities; values: the point, in prior standard deviations and typical
    sizes [p]. Of each shift, residuals [pulses, m], slopes [pulses, p], weights [pulses, pulses],
    the inverse covariance, and volume, the log determinant of the noise. Shifts that could not be
    simulated have weight 0.
    """

    names: tuple[str, ...]
    causes: tuple[Cause, ...]
    values: Floats
    residuals: tuple[Floats, ...]
    slopes: tuple[Floats, ...]
    weights: tuple[Floats, ...]
    volume: Floats

    @property
    def units(self) -> int:
        """How many parameters are the unit's."""
        return len(self.names)

    @cached_property
    def information(self) -> Floats:
        """Information [n, p, p] of each shift."""
        return np.array([a.T @ w @ a for a, w in zip(self.slopes, self.weights, strict=True)])

    @cached_property
    def score(self) -> Floats:
        """Score [n, p] of each shift."""
        three = zip(self.slopes, self.weights, self.residuals, strict=True)
        return np.array([a.T @ (w @ r) for a, w, r in three])

    @cached_property
    def misfit(self) -> Floats:
        """Chi squared [n] of each shift."""
        return np.array([r @ w @ r for w, r in zip(self.weights, self.residuals, strict=True)])

    @cached_property
    def count(self) -> NDArray[np.int64]:
        """Compared numbers [n] of each shift."""
        return np.array([len(w) if w.any() else 0 for w in self.weights])

    def without_cliffs(self) -> Linear:
        """Return the same without what is about to stick or to release: it is not linear.

        These are shifts, by the truck's quantities, and causes in shifts.
        """
        steep = [np.abs(a).max(axis=0) > CLIFF_M for a in self.slopes]
        sticks = [bool(own[: self.units].any()) for own in steep]
        slopes = [np.where(own, 0.0, a) for a, own in zip(self.slopes, steep, strict=True)]
        weights = [0.0 * w if out else w for w, out in zip(self.weights, sticks, strict=True)]
        return self if all(sticks) else replace(self, slopes=tuple(slopes), weights=tuple(weights))

    def moved(self, values: Floats, shifts: Sequence[RecordedShift], position_m: Floats) -> Linear:
        """Return the same at another point [p] with its positions [n, pulses, m], slopes as here."""
        return replace(self, values=values, residuals=residuals_of(shifts, position_m))


def residuals_of(shifts: Sequence[RecordedShift], position_m: Floats) -> tuple[Floats, ...]:
    """Return recorded minus simulated positions [n, pulses, m] of each shift, 0 without a simulation."""
    pairs = zip(shifts, position_m, strict=True)
    return tuple(np.nan_to_num(s.position_m - x[: len(s.time_s)]) for s, x in pairs)


@dataclass(frozen=True)
class Noise:
    """What makes two equal shifts differ on the bus.

    position_m: of a pulse. scatter: that of the shifts, as a share of the model's. weights: if given,
    of each shift [pulses, pulses], instead of those that follow at a point. loads: quantities of the
    unit that are unknown in each shift, too.
    """

    position_m: float = LEAST_NOISE_M
    scatter: float = 1.0
    weights: tuple[Floats, ...] = ()
    loads: tuple[str, ...] = ()

    def covariance(
        self,
        model: PlantModel,
        shift: RecordedShift,
        speed_m_s: Floats,
        slopes: Mapping[str, Floats],
        apart_m: Floats,
    ) -> Floats:
        """Return the covariance [pulses, pulses, m^2] of a shift, by its slopes [pulses] per unit.

        apart_m: [2, TRIED_S, pulses], how far the stay moves within TRIED_S before and after a pulse.
        """
        shares = {name: self.scatter * sd for name, sd in model.each.items()}
        shares |= {name: model.each[name] for name in shares if name.startswith("cone")}
        if shift.end in "BF":
            error = SPEED_NOISE_RAD_S / max(abs(shift.difference_rad_s), SPEED_NOISE_RAD_S)
            shares[f"cone_{shift.end}"] = float(np.hypot(shares[f"cone_{shift.end}"], error))
        shares |= {name: LOAD_SHARE * model.unit[name] for name in self.loads}
        spread = np.stack(
            [slopes[name] * sd / model.unit[name] for name, sd in shares.items() if name in slopes],
            1,
        )
        kink = _kink_variance(apart_m, np.abs(speed_m_s), np.sqrt(np.sum(spread**2, axis=1)))
        own = np.diag(self.position_m**2 + (JITTER_S * speed_m_s) ** 2 + kink)
        return np.asarray(own + spread @ spread.T)


def _kink_variance(apart_m: Floats, speed_m_s: Floats, spread_m: Floats) -> Floats:
    """Return the variance [pulses, m^2] that instants that scatter add beyond what the speed says.

    Just after the stay arrives its speed is 0, although it moved shortly before. The scatter of the
    instants follows from the spread [pulses, m] while it moves.
    """
    moving = speed_m_s > MOVING_M_S
    longest = np.max(spread_m[moving] / speed_m_s[moving], initial=0.0)
    instant = float(np.clip(longest, *INSTANT_S))
    times, zero = np.append(0.0, TRIED_S), np.zeros((1, len(speed_m_s)))
    variance = zero[0]
    for side in apart_m:
        distances = np.vstack([zero, side])
        for at, share in NORMAL:
            by = at * instant
            k = int(np.searchsorted(times, by)) - 1
            w = (by - times[k]) / (times[k + 1] - times[k])
            away = (1.0 - w) * distances[k] + w * distances[k + 1]
            variance = variance + share * np.maximum(away - by * speed_m_s, 0.0) ** 2
    return np.asarray(variance)


NOISE: Final = Noise()


def point_of(model: PlantModel, names: Sequence[str], values: Floats) -> dict[str, float]:
    """Return amounts in their units from values [names] in prior standard deviations."""
    return {name: float(v) * model.unit[name] for name, v in zip(names, values, strict=True)}


def unit_names(model: PlantModel) -> tuple[str, ...]:
    """Return the unit's quantities that act: those of the gearbox only if there is one."""
    gearbox = () if model.mounted else ("linkage", "mass")
    return tuple(name for name in model.unit if name not in gearbox)


def linearise(
    model: PlantModel,
    shifts: Sequence[RecordedShift],
    values: Floats,
    causes: Sequence[Cause] = (),
    active: Mapping[Cause, float] | None = None,
    noise: Noise = NOISE,
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
    steps = [_step(cause, active.get(cause, 0.0), difference) for cause in causes]
    points += [
        here.with_cause(cause, active.get(cause, 0.0) + step)
        for cause, step in zip(causes, steps, strict=True)
    ]
    count, times = len(points), () if noise.weights else TRIED_S
    points += [here.moved("latency", side * by) for side in (1.0, -1.0) for by in times]
    x, v, done = model.predict(shifts, points)
    base, speed = x[:, 0], v[:, 0]
    near = np.where(done[:, count:, None], np.abs(x[:, count:] - base[:, None]), 0.0)
    apart = near.reshape(len(x), 2, len(times), base.shape[1])
    x, done = x[:, :count], done[:, :count]
    scale = np.array([difference] * len(moved) + steps)
    by = np.where(done[:, 1:, None], x[:, 1:] - base[:, None], 0.0) / scale[:, None]
    column = {name: by[:, k] for k, name in enumerate(moved)} | {
        "latency": -speed * model.unit["latency"],
        "offset": np.full_like(base, model.unit["offset"]),
        "gain": base * model.unit["gain"],
    }
    columns = np.stack([column[name] for name in names] + list(by.swapaxes(0, 1)[len(moved) :]), -1)
    slopes, weights, volume = [], [], np.zeros(len(shifts))
    for k, shift in enumerate(shifts):
        n = len(shift.time_s)
        own = columns[k, :n]
        usable = done[k, 0] and np.isfinite(base[k, :n]).all()
        slopes.append(np.where(np.isfinite(own).all(axis=0) & usable, own, 0.0))
        if noise.weights:
            weights.append(noise.weights[k] * usable)
            continue
        if not usable:
            weights.append(np.zeros((n, n)))
            continue
        units = dict(zip(names, slopes[k].T[: len(names)], strict=True))
        covariance = noise.covariance(model, shift, speed[k, :n], units, apart[k, :, :, :n])
        weights.append(np.linalg.inv(covariance))
        volume[k] = np.linalg.slogdet(covariance / LEAST_NOISE_M**2)[1]
    sizes = np.array([active.get(cause, 0.0) for cause in causes])
    return Linear(
        names, tuple(causes), np.concatenate([values, sizes]), residuals_of(shifts, base),
        tuple(slopes), tuple(weights), volume,
    )  # fmt: skip


def _step(cause: Cause, size: float, difference: float) -> float:
    """Return a step from a size that stays physical, of a difference: at a bound nothing changes."""
    step = difference if cause.sign >= 0 else -difference
    low, high = cause.sizes(np.inf)
    return step if low <= size + step <= high else -step


def prior_cost(values: Floats) -> float:
    """Return minus the log prior of the unit's quantities [units] in prior deviations.

    Student's, of TAIL degrees of freedom: unusual trucks are not that rare.
    """
    return float(0.5 * (TAIL + 1.0) * np.sum(np.log1p(values**2 / TAIL)))


def weight_of(point: Floats, units: int) -> Floats:
    """Return the precision [p] of the priors of unit and sizes at a point [p], as a normal one's."""
    weight = (TAIL + 1.0) / (TAIL + point[:units] ** 2)
    return np.append(weight, np.full(len(point) - units, 1.0 / SIZE_PRIOR**2))


def estimates(linear: Linear, damping: float = 0.0) -> tuple[Floats, Floats]:
    """Return estimate [p] and covariance [p, p] of all parameters in the linear model.

    damping: of the step, as a share of the information's diagonal.
    """
    h, g = linear.information.sum(axis=0), linear.score.sum(axis=0)
    weight = weight_of(linear.values, linear.units)
    precision = h + np.diag(weight + damping * np.diag(h))
    covariance = np.linalg.inv(precision)
    return linear.values + covariance @ (g - weight * linear.values), covariance


def projected(linear: Linear) -> tuple[Floats, Floats]:
    """Return information [causes, causes] and score [causes] of the causes' sizes at the point.

    The unit's quantities are marginalised with their priors.
    """
    n = linear.units
    h, g = linear.information.sum(axis=0), linear.score.sum(axis=0)
    weight = weight_of(linear.values, linear.units)[:n]
    gain = np.linalg.solve(h[:n, :n] + np.diag(weight), h[:n, n:]).T
    pull = g[:n] - linear.values[:n] * weight
    return h[n:, n:] - gain @ h[:n, n:], g[n:] - gain @ pull


def explained(linear: Linear, k: int | None = None) -> tuple[float, Floats]:
    """Return half chi squared and the point [units, or units + 1] that explain the linear model best.

    k: the cause that acts alone.  The priors' tails are followed by reweighting, from usual trucks.
    """
    n = linear.units
    own = np.append(np.arange(n), [] if k is None else [n + k]).astype(int)
    h, g = linear.information.sum(axis=0)[np.ix_(own, own)], linear.score.sum(axis=0)[own]
    at, best = linear.values[own], (np.inf, linear.values[own])
    for start in (0.0 * at, at):
        point = start
        for _ in range(REWEIGHTED):
            point = np.linalg.solve(h + np.diag(weight_of(point, n)), g + h @ at)
        by = point - at
        cost = 0.5 * float(linear.misfit.sum()) - g @ by + 0.5 * by @ h @ by
        cost += prior_cost(point[:n]) + 0.5 * float(np.sum((point[n:] / SIZE_PRIOR) ** 2))
        best = min(best, (float(cost), point), key=lambda item: item[0])
    return best


def hidden_cost(linear: Linear, sizes: Floats) -> tuple[Floats, Floats]:
    """Return half chi squared [causes, sizes] of a usual truck with one cause, called healthy.

    And its standard deviation [causes, sizes], over noise and over how far a truck is from usual: by
    its slopes, since what the fit makes least does not change to first order. A cause that is called
    an unusual truck costs the prior's tail, which varies little.
    sizes: [sizes], ascending, in typical ones.
    """
    n = linear.units
    h = linear.information.sum(axis=0)
    units, across, alone = h[:n, :n], h[n:, :n], np.diag(h)[n:]
    found, u = np.zeros((2, len(alone), len(sizes))), np.zeros_like(across)
    for j, size in enumerate(sizes):
        for _ in range(REWEIGHTED):
            weight = (TAIL + 1.0) / (TAIL + u**2)
            matrix = units + weight[:, :, None] * np.eye(n)
            u = np.linalg.solve(matrix, size * across[..., None])[..., 0]
        left = 0.5 * size**2 * alone - size * (across * u).sum(1) + 0.5 * (u @ units * u).sum(1)
        found[0, :, j] = left + 0.5 * (TAIL + 1.0) * np.log1p(u**2 / TAIL).sum(1)
        pull = (TAIL + 1.0) * u / (TAIL + u**2)
        found[1, :, j] = np.sqrt(2.0 * np.maximum(left, 0.0) + (pull**2).sum(1))
    return found[0], found[1]

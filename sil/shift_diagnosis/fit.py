"""Gauss-Newton fits of a truck's quantities, and of a cause, to recorded shifts.

Checked by: tests/unit/sil/shift_diagnosis/test_diagnose_logs.py
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from sil.shift_diagnosis.linear import (
    SIZE_PRIOR,
    Floats,
    Linear,
    Posterior,
    linearise,
    point_of,
    posterior,
    unit_names,
)
from sil.shift_diagnosis.model import LEAST_NOISE_M, Cause, PlantModel, Point
from sil.shift_diagnosis.shifts import Shift

DAMPINGS: Final = (0.0, 0.03, 0.3, 3.0, 30.0)
"""Dampings of a step that are tried, as shares of the information's diagonal."""
COARSE_M: Final = (1e-3, 1e-4)
"""Noise with which a fit begins."""
NEAR: Final = 5.0
"""Half chi squared per number up to which a fit begins with the noise itself."""
UNABLE: Final = 1e7
"""Cost of a shift that cannot be simulated."""
CONVERGED: Final = 0.3
"""Gain in half chi squared below which a fit ends."""


@dataclass(frozen=True)
class Fit:
    """A truck's quantities [units] in prior deviations, and the size of a cause in typical ones."""

    values: Floats
    cause: Cause | None
    size: float
    linear: Linear
    posterior: Posterior

    @property
    def half_chi2(self) -> float:
        """Half chi squared of residuals and priors at the point."""
        prior = self.values @ self.values + (self.size / SIZE_PRIOR) ** 2
        unable = UNABLE * np.count_nonzero(self.linear.count == 0)
        return float(0.5 * (self.linear.misfit.sum() + prior) + unable)


class Fitter:
    """Fits hypotheses to the same shifts of one truck."""

    def __init__(
        self, model: PlantModel, shifts: Sequence[Shift], noise_m: float = LEAST_NOISE_M
    ) -> None:
        self.model, self.shifts, self.noise_m = model, list(shifts), noise_m
        self.names = unit_names(model)

    def fit(self, cause: Cause | None, values: Floats, size: float, rounds: int = 8) -> Fit:
        """Fit the unit's quantities and a cause's size, from `values` [units] and `size`.

        At first coarsely: with little noise, the residual of a start far away has many minima.
        """
        at = np.append(values, size) if cause is not None else values
        now = self.at(cause, at)
        coarse = COARSE_M if now.half_chi2 > NEAR * now.linear.count.sum() else ()
        for noise_m in (*coarse, self.noise_m):
            now = self.at(cause, np.append(now.values, now.size)[: len(at)], noise_m)
            for _ in range(rounds):
                trials = [_step(now.linear, damping) for damping in DAMPINGS]
                costs = self.costs(cause, trials, now.linear)
                best = int(np.argmin(costs))
                if costs[best] > now.half_chi2 - CONVERGED:
                    break
                now = self.at(cause, trials[best], noise_m)
        return now

    def at(self, cause: Cause | None, at: Floats, noise_m: float | None = None) -> Fit:
        """Return the hypothesis linearised at a point [units, or units + 1]."""
        values, size = self._split(cause, at)
        causes = () if cause is None else (cause,)
        active = {} if cause is None else {cause: size}
        linear = linearise(self.model, self.shifts, values, causes, active, noise_m or self.noise_m)
        return Fit(values, cause, size, linear, posterior(linear, range(len(causes))))

    def costs(self, cause: Cause | None, trials: Sequence[Floats], near: Linear) -> Floats:
        """Return half chi squared with the priors [trials], with the weights of `near`.

        trials: [units] or [units + 1] each, the last the cause's size.
        """
        points, total = [], np.zeros(len(trials))
        for k, trial in enumerate(trials):
            values, size = self._split(cause, trial)
            own = () if cause is None else ((cause, size),)
            points.append(Point(point_of(self.model, self.names, values), own))
            total[k] = 0.5 * float(values @ values + (size / SIZE_PRIOR) ** 2)
        x, _v, done = self.model.predict(self.shifts, points)
        for k, (shift, weight) in enumerate(zip(self.shifts, near.weights, strict=True)):
            r = shift.position_m - x[k, :, : len(shift.time_s)]
            squares = 0.5 * np.sum((r @ weight) * r, axis=1)
            total += np.where(done[k] & np.isfinite(squares), squares, UNABLE)
        return total

    def _split(self, cause: Cause | None, at: Floats) -> tuple[Floats, float]:
        """Return the unit's quantities, and the cause's size not on its unphysical side."""
        values = at[: len(self.names)]
        if cause is None:
            return values, 0.0
        size, sign = float(at[-1]), cause.sign
        return values, size if sign == 0 else sign * max(0.0, sign * size)


def _step(linear: Linear, damping: float) -> Floats:
    """Return the point of a damped Gauss-Newton step [parameters]."""
    h, g = linear.information.sum(axis=0), linear.score.sum(axis=0)
    weight = np.ones(len(h))
    weight[linear.units :] = 1.0 / SIZE_PRIOR**2
    precision = h + np.diag(weight + damping * np.diag(h))
    step = np.linalg.solve(precision, g - weight * linear.values)
    return np.asarray(linear.values + step)

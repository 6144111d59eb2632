"""Gauss-Newton fits of a truck's quantities, and of a cause, to recorded shifts.

Checked by: tests/unit/sil/shift_diagnosis/test_diagnose_logs.py
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import log, log1p
from typing import Final

import numpy as np

from sil.shift_diagnosis.linear import (
    SIZE_PRIOR,
    Floats,
    Linear,
    estimates,
    linearise,
    point_of,
    prior_cost,
    projected,
    unit_names,
)
from sil.shift_diagnosis.model import DIFFERENCE, LEAST_NOISE_M, Cause, PlantModel, Point
from sil.shift_diagnosis.shifts import Shift

DAMPINGS: Final = (0.0, 0.03, 0.3, 3.0, 30.0)
"""Dampings of a step that are tried, as shares of the information's diagonal."""
DIFFERENCES: Final = (0.02, 0.5)
"""Other steps of the differences, tried in turn where a fit stalls: positions have kinks."""
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
    """A truck's quantities [units] in prior deviations, and the size of a cause in typical ones.

    estimate [p] and covariance [p, p] are those of the linear model at the point.
    """

    values: Floats
    cause: Cause | None
    size: float
    linear: Linear
    estimate: Floats
    covariance: Floats

    @property
    def half_chi2(self) -> float:
        """Half chi squared of residuals and priors at the point."""
        unable = UNABLE * np.count_nonzero(self.linear.count == 0)
        prior = prior_cost(self.values) + 0.5 * (self.size / SIZE_PRIOR) ** 2
        return float(0.5 * self.linear.misfit.sum() + prior + unable)

    @property
    def cost(self) -> float:
        """Minus the log evidence, without what all hypotheses have in common.

        The truck's quantities count by their value at the point, a cause's size by its volume, too.
        """
        cost = self.half_chi2 + 0.5 * float(self.linear.volume.sum())
        if self.cause is None:
            return cost
        information = float(projected(self.linear)[0][0, 0])
        cost += 0.5 * log1p(max(0.0, information) * SIZE_PRIOR**2)
        return cost - log(2.0) * (self.cause.sign != 0)  # the prior's other half is not physical


class Fitter:
    """Fits hypotheses to the same shifts of one truck."""

    def __init__(
        self, model: PlantModel, shifts: Sequence[Shift], noise_m: float = LEAST_NOISE_M
    ) -> None:
        self.model, self.shifts, self.noise_m = model, list(shifts), noise_m
        self.names = unit_names(model)

    def fit(self, cause: Cause | None, values: Floats, size: float, rounds: int = 12) -> Fit:
        """Fit the unit's quantities and a cause's size, from `values` [units] and `size`.

        At first coarsely: with little noise, the residual of a start far away has many minima.
        """
        at = np.append(values, size) if cause is not None else values
        now = self.at(cause, at)
        coarse = COARSE_M if now.half_chi2 > NEAR * now.linear.count.sum() else ()
        for noise_m in (*coarse, self.noise_m):
            now = self.at(cause, np.append(now.values, now.size)[: len(at)], noise_m)
            steps = list(DIFFERENCES)
            for _ in range(rounds):
                trials = [estimates(now.linear, damping)[0] for damping in DAMPINGS]
                costs = self.costs(cause, trials, now.linear)
                best = int(np.argmin(costs))
                stalls = bool(costs[best] > now.half_chi2 - CONVERGED)
                if stalls and not steps:
                    break
                goal = np.append(now.values, now.size)[: len(at)] if stalls else trials[best]
                step = steps.pop(0) if stalls else DIFFERENCE
                now = self.at(cause, goal, noise_m, step)
        return now

    def at(
        self,
        cause: Cause | None,
        at: Floats,
        noise_m: float | None = None,
        difference: float = DIFFERENCE,
    ) -> Fit:
        """Return the hypothesis linearised at a point [units, or units + 1]."""
        values, size = self._split(cause, at)
        causes = () if cause is None else (cause,)
        active = {} if cause is None else {cause: size}
        noise_m = noise_m or self.noise_m
        linear = linearise(self.model, self.shifts, values, causes, active, noise_m, difference)
        return Fit(values, cause, size, linear, *estimates(linear))

    def costs(self, cause: Cause | None, trials: Sequence[Floats], near: Linear) -> Floats:
        """Return half chi squared with the priors [trials], with the weights of `near`.

        trials: [units] or [units + 1] each, the last the cause's size.
        """
        points, total = [], np.zeros(len(trials))
        for k, trial in enumerate(trials):
            values, size = self._split(cause, trial)
            own = () if cause is None else ((cause, size),)
            points.append(Point(point_of(self.model, self.names, values), own))
            total[k] = prior_cost(values) + 0.5 * (size / SIZE_PRIOR) ** 2
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

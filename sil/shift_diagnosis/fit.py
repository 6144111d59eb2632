"""Gauss-Newton fits of a truck's quantities, and of a cause, to recorded shifts.

Checked by: tests/unit/sil/shift_diagnosis/test_diagnose_logs.py
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from math import log, log1p
from typing import Final

import numpy as np

from sil.inference.fit import Show, no_progress
from sil.inference.workers import spread_out
from sil.shift_diagnosis.linear import (
    NOISE,
    SIZE_PRIOR,
    Floats,
    Linear,
    Noise,
    estimates,
    linearise,
    point_of,
    prior_cost,
    projected,
    unit_names,
)
from sil.shift_diagnosis.model import DIFFERENCE, Cause, PlantModel, Point
from sil.shift_diagnosis.shifts import RecordedShift

DAMPINGS: Final = (0.0, 0.003, 0.03, 0.3, 3.0)
"""Dampings of a step that are tried, as shares of the information's diagonal."""
SHARES: Final = (0.5, 0.2)
"""Shares of the undamped step that are tried: along a ridge, damping stops."""
DIFFERENCES: Final = (0.5,)
"""Other steps of the differences, tried in turn where a fit stalls: positions have kinks."""
LEAST_SCATTER: Final = 0.1
"""Share of the model's scatter between shifts below which none is assumed."""
COARSE_M: Final = (1e-3, 1e-4)
"""Noise with which a fit begins."""
NEAR: Final = 5.0
"""Half chi squared per number up to which a fit begins with the noise itself."""
FARTHEST: Final = 15.0
"""Largest deviation of a truck's own quantity that a fit tries, in standard deviations."""
UNABLE: Final = 1e7
"""Cost of a shift that cannot be simulated."""
LATEST: Final = 4
"""Points that are remembered."""
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
    def point(self) -> Floats:
        """The quantities, then the size [units + 1]."""
        return np.append(self.values, self.size)

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


def fits_of(
    work: Callable[[Cause | None, Floats], Fit],
    items: Sequence[tuple[Cause | None, Floats]],
    workers: int,
    progress: Show = no_progress,
) -> list[Fit]:
    """Return work(cause, start [units, or units + 1]) of every item, on so many processes.

    Each fit has its item's own cause, as a cause's functions cannot leave a process. Units as `Fit`.
    """

    def bare(k: int) -> Fit:
        fit = work(*items[k])
        return replace(fit, cause=None, linear=replace(fit.linear, causes=()))

    fits = spread_out(bare, range(len(items)), workers, progress)
    pairs = zip(fits, (cause for cause, _start in items), strict=True)
    return [
        fit
        if cause is None
        else replace(fit, cause=cause, linear=replace(fit.linear, causes=(cause,)))
        for fit, cause in pairs
    ]


class Fitter:
    """Fits hypotheses to the same shifts of one truck."""

    def __init__(
        self, model: PlantModel, shifts: Sequence[RecordedShift], noise: Noise = NOISE
    ) -> None:
        self.model, self.shifts, self.noise = model, list(shifts), noise
        self.names = unit_names(model)
        self._latest: deque[tuple[object, Noise, Fit]] = deque(maxlen=LATEST)
        """Latest points: a fit that gains nothing ends where it was linearised before."""

    def fit(self, cause: Cause | None, start: Floats, rounds: int = 16) -> Fit:
        """Fit the unit's quantities, and a cause's size, from a point [units, or units + 1].

        At first coarsely: with little noise, the residual of a start far away has many minima.
        Derivatives are computed again only where steps by those of an earlier point gain nothing.
        """
        now, units = self.at(cause, start), len(self.names)
        first, noises = now, [self.noise]
        if 0.5 * now.linear.misfit.sum() > NEAR * now.linear.count.sum():
            noises = [replace(self.noise, position_m=m, weights=()) for m in COARSE_M] + noises
        for noise in noises:
            now = now if len(noises) == 1 else self.at(cause, now.point, noise)
            steps, fresh = list(DIFFERENCES), True
            for _ in range(rounds):
                trials = [estimates(now.linear, damping)[0] for damping in DAMPINGS]
                ahead, here = trials[0], now.linear.values
                trials += [here + share * (ahead - here) for share in SHARES]
                for trial in trials:
                    np.clip(trial[:units], -FARTHEST, FARTHEST, out=trial[:units])
                costs, x = self.costs(cause, trials, now.linear)
                best = int(np.argmin(costs))
                if costs[best] <= now.half_chi2 - CONVERGED:
                    now, fresh = self._moved(now, trials[best], x[:, best]), False
                elif not fresh or steps:
                    step = steps.pop(0) if fresh else DIFFERENCE
                    now, fresh = self.at(cause, now.point, noise, step), True
                else:
                    break
            now = self.at(cause, now.point, noise)
        return now if now.half_chi2 <= first.half_chi2 or not self.noise.weights else first

    def settle(self, fit: Fit) -> Fit:
        """Estimate how much the shifts scatter by the likelihood; return the fit with that."""
        while (scatter := 0.5 * self.noise.scatter) > LEAST_SCATTER:
            before, self.noise = self.noise, replace(self.noise, scatter=scatter)
            closer = self.fit(fit.cause, fit.point)
            if closer.cost > fit.cost:
                self.noise = before
                break
            fit = closer
        return fit

    def at(
        self,
        cause: Cause | None,
        point: Floats,
        noise: Noise | None = None,
        difference: float = DIFFERENCE,
    ) -> Fit:
        """Return the hypothesis linearised at a point [units, or more: then the cause's size]."""
        values, size = self._split(cause, point)
        noise = noise or self.noise
        key = cause, values.tobytes(), size, difference
        for known, of_noise, fit in self._latest:
            if known == key and of_noise is noise:
                return fit
        causes = () if cause is None else (cause,)
        active = {} if cause is None else {cause: size}
        linear = linearise(self.model, self.shifts, values, causes, active, noise, difference)
        fit = Fit(values, cause, size, linear, *estimates(linear))
        self._latest.append((key, noise, fit))
        return fit

    def _moved(self, now: Fit, trial: Floats, position_m: Floats) -> Fit:
        """Return a fit at another point, its positions [shifts, pulses] simulated, slopes as before."""
        values, size = self._split(now.cause, trial)
        linear = now.linear.moved(np.append(values, size)[: len(trial)], self.shifts, position_m)
        return Fit(values, now.cause, size, linear, *estimates(linear))

    def costs(
        self, cause: Cause | None, trials: Sequence[Floats], near: Linear
    ) -> tuple[Floats, Floats]:
        """Return half chi squared with the priors [trials] by the weights of `near`, and positions.

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
            if near.count[k]:
                r = shift.position_m - x[k, :, : len(shift.time_s)]
                squares = 0.5 * np.sum((r @ weight) * r, axis=1)
                total += np.where(done[k] & np.isfinite(squares), squares, UNABLE)
        return total, x

    def _split(self, cause: Cause | None, at: Floats) -> tuple[Floats, float]:
        """Return the unit's quantities, and the cause's size within what is physical."""
        values = at[: len(self.names)]
        if cause is None or len(at) == len(values):
            return values, 0.0
        low, high = cause.sizes(np.inf)
        return values, min(max(float(at[-1]), low), high)

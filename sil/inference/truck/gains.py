"""What each cause would gain beside a fitted truck, by secants with all else free.

Checked by: tests/unit/sil/inference/truck/test_gains.py
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sil.inference.problem import Floats
from sil.inference.truck.causes import Cause
from sil.inference.truck.fit import FINE_M, PRIORS, STEPS, Fit, Fitter
from sil.inference.truck.simulator import Bools


@dataclass(frozen=True)
class Beside:
    """A fit of which everything free is eliminated from whatever else acts.

    weighted_unit, weighted_own [shifts, pulses, ...]: derivatives by the weight of each pulse; weight,
    residual [shifts, pulses]; inverse [shifts, differing, differing]: of each shift's information; coupling
    [shifts, shared, differing], own_gradient [shifts, differing], marginal [shared, shared].
    """

    weight: Floats
    residual: Floats
    weighted_unit: Floats
    weighted_own: Floats
    inverse: Floats
    coupling: Floats
    own_gradient: Floats
    marginal: Floats

    @classmethod
    def of(cls, fitter: Fitter, fit: Fit, fixed: bool = False) -> Beside:
        """Linearise a fit by central differences; fixed: the size of its cause is not free."""
        slopes = np.clip(
            fitter.derivatives(fit, 0.3, (1.0, -1.0)), -STEPS.steepest_m, STEPS.steepest_m
        )
        variance = fitter.variance(FINE_M, fit.noise_factor)
        residual, weight = fitter.weighted_residual(fit, variance)
        if fixed:
            fit = replace(fit, cause=None)
        system = fitter.system(fit, slopes, variance)
        shared = len(fitter.layout) + (fit.cause is not None)
        own = fitter.own_derivatives(slopes)
        return cls(
            weight,
            residual,
            slopes[:, :, :shared] * weight[..., None],
            own * weight[..., None],
            np.asarray(np.linalg.inv(system.own), dtype=np.float64),
            system.coupling,
            system.own_gradient,
            system.marginal,
        )

    def information(self, slopes: Floats) -> tuple[Floats, Floats]:
        """Return information [n, n] and gradient [n] of what moves positions by `slopes` [n, shifts, pulses].

        Everything free is marginalised; a typical size is the unit.
        """
        own = np.einsum("nkt,ktq->nkq", slopes, self.weighted_own)
        through = np.einsum("nkq,kqj->nkj", own, self.inverse)
        unit = np.einsum("nkt,ktp->np", slopes, self.weighted_unit)
        unit = unit - np.einsum("nkj,kpj->np", through, self.coupling)
        flat, weight = slopes.reshape(len(slopes), -1), self.weight.ravel()
        alone = (flat * weight) @ flat.T - np.einsum("nkq,mkq->nm", through, own)
        hidden = unit @ np.linalg.solve(self.marginal, unit.T)
        gradient = flat @ (weight * self.residual.ravel())
        gradient -= np.einsum("nkj,kj->n", through, self.own_gradient)
        return np.asarray(alone - hidden), np.asarray(gradient)


def gains_of(fitter: Fitter, fit: Fit, causes: Sequence[Cause]) -> list[tuple[float, float]]:
    """Return of every cause the log evidence that it would gain, and its size in typical ones."""
    beside = Beside.of(fitter, fit)
    gains = []
    for cause in causes:
        best = (0.0, 0.0)
        sizes = cause.sizes(0.4, 3.0)  # of the secants
        matrix, gradients = beside.information(secants(fitter, fit, cause, sizes))
        for size, own, gradient in zip(sizes, np.diag(matrix), gradients.tolist(), strict=True):
            there = gradient / (max(float(own), 0.0) + 1.0 / PRIORS.size_sd**2)
            if there * size > 0.0:
                best = max(best, (0.5 * gradient * there, there))
        gains.append(best)
    return gains


def likeness(
    fitter: Fitter, fit: Fit, causes: Sequence[Cause], sizes: Sequence[float]
) -> list[tuple[float, float]]:
    """Return of every cause how far it stays behind in log evidence in place of the fit's own, and its size.

    At these sizes, in typical ones, and linear between them, whichever comes nearest; all else is free to make up for
    what is left. Infinitely far if it cannot be simulated, or has no such size.
    """
    beside = Beside.of(fitter, fit, fixed=True)
    rows = []
    for cause in causes:
        tried = np.sort(cause.sizes(*sizes))
        if not len(tried):
            rows.append((np.inf, 0.0))
            continue
        moves, done = _moves(fitter, fit, cause, tried.tolist())
        matrix, gradients = beside.information(moves)
        low = np.arange(len(tried))
        high = np.minimum(low + 1, len(tried) - 1)
        left, across, right = matrix[low, low], matrix[low, high], matrix[high, high]
        slope = left - across - gradients[low] + gradients[high]
        share = np.clip(slope / np.maximum(left - 2.0 * across + right, 1e-12), 0.0, 1.0)
        behind = 0.5 * left - gradients[low] - share * slope
        behind += 0.5 * share**2 * (left - 2.0 * across + right)
        whole = np.asarray(done.all(axis=1))
        behind = np.where(whole[low] & whole[high], behind, np.inf)
        best = int(np.argmin(behind))
        size = tried[low] + share * (tried[high] - tried[low])
        rows.append((float(behind[best]), float(size[best])))
    return rows


def secants(fitter: Fitter, fit: Fit, cause: Cause, sizes: Sequence[float]) -> Floats:
    """Return by how much positions [sizes, shifts, pulses] move by a cause of sizes, for one typical size."""
    moves, done = _moves(fitter, fit, cause, sizes)
    slopes = np.where(done[..., None], moves, 0.0) / np.array(sizes)[:, None, None]
    return np.asarray(np.clip(slopes, -STEPS.steepest_m, STEPS.steepest_m))


def _moves(fitter: Fitter, fit: Fit, cause: Cause, sizes: Sequence[float]) -> tuple[Floats, Bools]:
    """Return by how much positions [sizes, shifts, pulses] move to a cause of sizes, and where [sizes, shifts] that can be simulated."""
    assert fit.position_m is not None
    n = len(fitter.model)
    amounts = fitter.layout.amounts(fit.unit, fit.each)
    x, done = fitter.model.positions(
        np.tile(np.arange(n), len(sizes)),
        np.tile(amounts, (len(sizes), 1)),
        cause,
        np.repeat(sizes, n),
    )
    moves = np.nan_to_num(x).reshape(len(sizes), n, -1) - fit.position_m
    return moves, done.reshape(len(sizes), n)

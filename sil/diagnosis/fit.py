"""Maximum a posteriori fit of one hypothesis to a whole campaign.

Residuals are standardised; healthy tolerances of the unit, scatter of each stroke and the
hypothesis' own parameters are fitted together.  The normal equations have the shape of an arrow
(each stroke's scatter touches that stroke alone), so each stroke is eliminated on its own and only
the shared block is solved.  Levenberg-Marquardt, steps bounded by the physical limits.

Source: Gauss-Newton with priors, e.g. Gelman et al., Bayesian Data Analysis; Schur elimination as
in bundle adjustment (Triggs et al. 2000).
Checked by: tests/unit/sil/diagnosis/test_fit.py
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from plant.hybrid import IntegrationError

from .hypotheses import Candidate
from .model import Block, CampaignModel, Shared

Floats = NDArray[np.float64]

FARTHEST_SD = 8.0
"""No healthy quantity is tried farther out than this: friction and flows stay positive."""

EFFECT_PRIOR = 10.0
"""Width of the prior of an effect's parameter, in typical sizes: weak."""


@dataclass
class FitResult:
    """A fitted hypothesis.

    cost: half the sum of squared standardised residuals plus priors; shared, stroke: parameters in
    prior standard deviations (effects in units of their typical size from neutral); normal: the
    information on the shared parameters with scatter eliminated and priors added; blocks: the
    strokes in `use`, linearised at the optimum.
    """

    candidates: tuple[Candidate, ...]
    layout: Shared
    use: tuple[int, ...]
    cost: float
    shared: Floats
    stroke: Floats
    normal: Floats
    values: tuple[dict[str, float], ...]
    iterations: int
    blocks: dict[int, Block]

    @property
    def name(self) -> str:
        """Name of the hypothesis."""
        return "+".join(item.name for item in self.candidates) or "healthy"

    @property
    def chi2(self) -> float:
        """Sum of squared standardised residuals, scatter's priors included."""
        return sum(
            float(block.residual @ block.residual) + float(self.stroke[k] @ self.stroke[k])
            for k, block in self.blocks.items()
        )

    @property
    def size(self) -> int:
        """How many numbers were compared."""
        return sum(len(block.residual) for block in self.blocks.values())

    @property
    def covariance(self) -> Floats:
        """Covariance of the shared parameters by the curvature at the optimum."""
        return np.asarray(np.linalg.pinv(self.normal))

    @property
    def scaled(self) -> Floats:
        """The hypothesis' own parameters in typical sizes from neutral."""
        return self.shared[self.layout.effect_slice]

    def evidence(self) -> float:
        """Laplace's approximation of -2 log evidence, common constants left out."""
        _sign, logdet = np.linalg.slogdet(self.normal)
        prior = 2.0 * len(self.scaled) * np.log(EFFECT_PRIOR)
        return float(2.0 * self.cost + logdet + prior)

    def light(self) -> FitResult:
        """The same without the derivatives, small enough to travel between processes."""
        empty = np.zeros((0, 0))
        blocks = {k: Block(b.residual, empty, empty, empty) for k, b in self.blocks.items()}
        return FitResult(
            self.candidates,
            self.layout,
            self.use,
            self.cost,
            self.shared,
            self.stroke,
            self.normal,
            self.values,
            self.iterations,
            blocks,
        )


class Fitter:
    """Fits hypotheses to the strokes of a campaign."""

    def __init__(self, model: CampaignModel) -> None:
        self.model = model

    def cost(
        self,
        shared: Floats,
        scatter: Floats,
        candidates: Sequence[Candidate],
        use: Sequence[int],
        limit: float = np.inf,
    ) -> float:
        """Half the squared residuals plus the priors; infinite where motion cannot be continued.

        Stops adding up once `limit` is passed.
        """
        model = self.model
        healthy = len(model.unit) + len(model.offsets)
        total = 0.5 * float(shared[:healthy] @ shared[:healthy])
        total += 0.5 * float(shared[healthy:] @ shared[healthy:]) / EFFECT_PRIOR**2
        for k in use:
            try:
                r = model.residual(k, shared, scatter[k], candidates)
            except IntegrationError:
                return float("inf")
            total += 0.5 * float(r @ r) + 0.5 * float(scatter[k] @ scatter[k])
            if not total < limit:
                return float("inf") if np.isnan(total) else total
        return total

    def fit(
        self,
        candidates: Sequence[Candidate] = (),
        *,
        start: Floats | None = None,
        scatter: Floats | None = None,
        use: Sequence[int] | None = None,
        iterations: int = 12,
        freeze: Sequence[int] | None = None,
    ) -> FitResult:
        """Fit a hypothesis to the strokes in `use` (all by default).

        start: shared parameters to begin with; freeze: places of shared parameters that stay where
        they start (all of them: only the scatter of the strokes is fitted, as for held-out strokes).

        Raises IntegrationError if the start itself cannot be simulated.
        """
        model = self.model
        candidates = tuple(candidates)
        layout = model.layout(candidates)
        n = len(layout.names)
        shared = np.zeros(n) if start is None else start.copy()
        chosen = tuple(range(len(model.strokes))) if use is None else tuple(use)
        spread = np.zeros((len(model.strokes), len(model.scatter)))
        if scatter is not None:
            spread[:] = scatter
        free = np.ones(n, dtype=bool)
        if freeze is not None:
            free[list(freeze)] = False
        cost = self.cost(shared, spread, candidates, chosen)
        if not np.isfinite(cost):
            raise IntegrationError("the start of the fit cannot be simulated")
        damping = 1e-3
        done = 0
        blocks: dict[int, Block] = {}
        while True:
            blocks = {
                k: model.linearise(k, shared, spread[k], candidates) for k in chosen
            }
            normal, gradient, inner = arrow(blocks, spread, shared, layout)
            if done >= iterations:
                break
            done += 1
            improved = False
            for _ in range(7):
                step = np.zeros(n)
                if free.any():
                    damped = normal + damping * np.diag(np.diag(normal))
                    step[free] = np.linalg.solve(damped[np.ix_(free, free)], gradient[free])
                trial = bounded(shared + step, candidates, layout)
                moved = trial - shared
                trial_spread = spread.copy()
                for k, (inverse, hus, gs) in inner.items():
                    there = spread[k] + inverse @ (gs - hus.T @ moved)
                    trial_spread[k] = np.clip(there, -FARTHEST_SD, FARTHEST_SD)
                trial_cost = self.cost(trial, trial_spread, candidates, chosen, cost)
                if trial_cost < cost:
                    improved = True
                    break
                damping = max(damping * 8.0, 1e-3)
            if not improved:
                break
            gain = cost - trial_cost
            shared, spread, cost = trial, trial_spread, trial_cost
            damping = max(damping * 0.2, 1e-7)
            if gain < 0.05 + 1e-6 * cost:
                iterations = done  # one last linearisation at the optimum
        return FitResult(
            candidates=candidates,
            layout=layout,
            use=chosen,
            cost=cost,
            shared=shared,
            stroke=spread,
            normal=normal,
            values=model.effect_values(candidates, shared[layout.effect_slice]),
            iterations=done,
            blocks=blocks,
        )


def arrow(
    blocks: dict[int, Block], spread: Floats, shared: Floats, layout: Shared
) -> tuple[Floats, Floats, dict[int, tuple[Floats, Floats, Floats]]]:
    """Normal matrix and gradient of the shared parameters, the strokes' scatter eliminated."""
    n = len(layout.names)
    normal: Floats = np.zeros((n, n))
    gradient: Floats = np.zeros(n)
    inner: dict[int, tuple[Floats, Floats, Floats]] = {}
    for k, block in blocks.items():
        r, a, b = block.residual, block.shared, block.scatter
        inverse = np.asarray(np.linalg.inv(b.T @ b + np.eye(b.shape[1])), dtype=np.float64)
        hus: Floats = a.T @ b
        gs: Floats = b.T @ r - spread[k]
        normal += a.T @ a - hus @ inverse @ hus.T
        gradient += a.T @ r - hus @ (inverse @ gs)
        inner[k] = (inverse, hus, gs)
    prior = np.ones(n)
    prior[layout.effect_slice] = 1.0 / EFFECT_PRIOR**2
    normal += np.diag(prior)
    gradient -= prior * shared
    return normal, gradient, inner


def bounded(shared: Floats, candidates: Sequence[Candidate], layout: Shared) -> Floats:
    """Shared parameters with the healthy ones near and the effects' own within their bounds."""
    out = shared.copy()
    out[: layout.healthy] = np.clip(out[: layout.healthy], -FARTHEST_SD, FARTHEST_SD)
    k = layout.healthy
    for item in candidates:
        for parameter in item.parameters:
            low = (parameter.low - parameter.neutral) / parameter.typical
            high = (parameter.high - parameter.neutral) / parameter.typical
            out[k] = min(max(out[k], low), high)
            k += 1
    return out

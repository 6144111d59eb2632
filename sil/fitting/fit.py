"""Maximum a posteriori fit of one hypothesis to a whole campaign.

Residuals are standardised; healthy tolerances of the unit, scatter of each stroke and the
hypothesis' own parameters are fitted together.  The normal equations have the shape of an arrow
(each stroke's scatter touches that stroke alone), so each stroke is eliminated on its own and only
the shared block is solved.  Levenberg-Marquardt, steps bounded by the physical limits.

Source: Gauss-Newton with priors, e.g. Gelman et al., Bayesian Data Analysis; Schur elimination as
in bundle adjustment (Triggs et al. 2000).
Checked by: tests/unit/sil/fitting/test_fit.py
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from plant.errors import IntegrationError
from sil.fitting.hypotheses import Candidate, precision, scaled_of
from sil.fitting.model import Block, CampaignModel, Shared

Floats = NDArray[np.float64]

FARTHEST_SD = 4.5
"""No healthy quantity is tried farther out than this: friction and flows stay positive."""

BOUNDS_PASSES = 6


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
        """Covariance of the shared parameters by the curvature at the optimum.

        [shared, shared], in prior standard deviations and typical sizes.
        """
        return np.asarray(np.linalg.pinv(self.normal))

    @property
    def scaled(self) -> Floats:
        """The hypothesis' own parameters in typical sizes from neutral.

        [parameters], no unit.
        """
        return self.shared[self.layout.effect_slice]

    def evidence(self) -> float:
        """Laplace's approximation of -2 log evidence, common constants left out."""
        _sign, logdet = np.linalg.slogdet(self.normal)
        _sign, prior = np.linalg.slogdet(self.layout.precision)
        return float(2.0 * self.cost + logdet - prior)

    def light(self) -> FitResult:
        """Return the same without the derivatives, small enough to travel between processes."""
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

    def __init__(
        self,
        model: CampaignModel,
        progress: Callable[[float, float], None] = lambda done, size: None,
    ) -> None:
        """progress(done, size) is called at every iteration."""
        self.model = model
        self.progress = progress

    def cost(
        self,
        shared: Floats,
        scatter: Floats,
        candidates: Sequence[Candidate],
        use: Sequence[int],
        limit: float = np.inf,
        weight: float = 1.0,
    ) -> float:
        """Half the squared residuals plus the priors; infinite where motion cannot be continued.

        Stops adding up once `limit` is passed; weight: of the residuals against the priors.

        shared: [shared], scatter: [strokes, scatter], in prior standard deviations.
        """
        model = self.model
        healthy = len(model.unit) + len(model.offsets)
        total = 0.5 * float(shared[:healthy] @ shared[:healthy])
        own = shared[healthy:]
        total += 0.5 * float(own @ precision(candidates) @ own)
        for k in use:
            try:
                r = model.residual(k, shared, scatter[k], candidates)
            except IntegrationError:
                return float("inf")
            total += 0.5 * weight * float(r @ r) + 0.5 * float(scatter[k] @ scatter[k])
            if not total < limit:
                return float("inf") if np.isnan(total) else total
        return total

    def fit(  # noqa: C901 - one damped least-squares loop, with its exits in order
        self,
        candidates: Sequence[Candidate] = (),
        *,
        start: Floats | None = None,
        scatter: Floats | None = None,
        use: Sequence[int] | None = None,
        iterations: int = 12,
        freeze: Sequence[int] | None = None,
        effects_first: int = 0,
        fine: bool = False,
        reuse: Mapping[int, Block] | None = None,
    ) -> FitResult:
        """Fit a hypothesis to the strokes in `use` (all by default).

        start: shared parameters to begin with; freeze: indices of shared parameters that stay where
        they start (all of them: only the scatter of the strokes is fitted, as for held-out
        strokes);
        effects_first: so many iterations move the hypothesis' own parameters alone: far from the
        optimum, tolerances and scatter would run to their bounds instead; fine: end with central
        differences, which a valley between an effect and a tolerance needs; reuse: derivatives by
        tolerances and scatter that serve (strokes absent here: those of the first full step) until
        a
        step with them gains nothing; they change little, and cost most.

        Raises IntegrationError if the start itself cannot be simulated.

        start: [shared], scatter: [strokes, scatter], in prior standard deviations.
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
        damping = 1e-5
        done = 0
        blocks: dict[int, Block] = {}
        central = False
        reused = dict(reuse or {})
        while True:
            self.progress(done, iterations)
            own_only = done < min(effects_first, iterations)
            stale = bool(reused) and not own_only
            blocks = {
                k: model.linearise(
                    k,
                    shared,
                    spread[k],
                    candidates,
                    central,
                    own_only,
                    reused.get(k) if stale else None,
                )
                for k in chosen
            }
            if reuse is not None and not own_only:
                reused = blocks
            weight = 1.0 if done >= iterations else tempering(blocks)
            if done >= iterations:
                normal, gradient, inner = arrow(blocks, spread, shared, layout, weight)
                break
            misfit = 0.5 * sum(float(b.residual @ b.residual) for b in blocks.values())
            here = cost - (1.0 - weight) * misfit
            moving = free & (np.arange(n) >= layout.healthy) if own_only else free
            improved = False
            done += 1
            # bounds met on the way first; then what presses against its bound stays there
            for joint in (False,) if own_only else (True, False):
                begin = spread
                if own_only:
                    normal, gradient = own_normal(blocks, shared, layout, weight)
                elif joint:
                    on = bounds_met(blocks, spread, shared, layout, weight, moving, candidates)
                    if not on:
                        continue
                    normal, gradient, inner = arrow(blocks, spread, shared, layout, weight, on)
                    begin = spread.copy()
                    for k, (_which, by) in on.items():
                        begin[k] += by
                else:
                    normal, gradient, inner = arrow(blocks, spread, shared, layout, weight)
                own_damping = damping
                for _ in range(3 if joint else 7):
                    damped = normal + own_damping * np.diag(np.diag(normal))
                    trial = stepped(shared, damped, gradient, moving, candidates, layout)
                    trial_spread = spread
                    if not own_only:
                        there = scattered(begin, inner, trial - shared)
                        trial_spread = np.clip(there, -FARTHEST_SD, FARTHEST_SD)
                    trial_cost = self.cost(trial, trial_spread, candidates, chosen, here, weight)
                    if trial_cost < here:
                        improved = True
                        break
                    own_damping = max(own_damping * 30.0, 1e-5)
                if improved:
                    break
            damping = own_damping
            if not improved and own_only:
                effects_first = 0
                damping = 1e-5
                continue
            if not improved and stale:
                reused = {}
                damping = 1e-5
                continue
            if not improved:
                if not fine or central:
                    break
                central = True
                damping = 1e-5
                continue
            gain = here - trial_cost
            shared, spread = trial, trial_spread
            cost = self.cost(shared, spread, candidates, chosen)
            damping = max(damping * 0.05, 1e-13)
            if gain < 0.05 + 1e-6 * here:
                if own_only:
                    effects_first = 0
                elif fine and not central:
                    central = True
                else:
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


def tempering(blocks: dict[int, Block]) -> float:
    """Weight of the residuals while a fit is far off: their mean square is at most one.

    Far from the optimum small errors of the derivatives, times large residuals, would outweigh the
    priors and send tolerances along valleys in which effects can replace them.
    """
    total = sum(float(block.residual @ block.residual) for block in blocks.values())
    count = sum(len(block.residual) for block in blocks.values())
    return min(1.0, count / max(total, 1e-12))


def own_normal(
    blocks: dict[int, Block], shared: Floats, layout: Shared, weight: float
) -> tuple[Floats, Floats]:
    """Return normal matrix and gradient with the strokes' scatter held where it is.

    shared: [shared]; result [shared, shared] and [shared], no unit.
    """
    normal: Floats = layout.prior
    gradient: Floats = -normal @ shared
    for block in blocks.values():
        normal = normal + weight * block.shared.T @ block.shared
        gradient = gradient + weight * block.shared.T @ block.residual
    return normal, gradient


def stepped(
    shared: Floats,
    normal: Floats,
    gradient: Floats,
    moving: NDArray[np.bool_],
    candidates: Sequence[Candidate],
    layout: Shared,
) -> Floats:
    """Newton's step within the bounds: what runs into one stays there, the rest is solved again.

    shared, gradient, moving: [shared]; normal: [shared, shared]; no unit.
    """
    moving = moving.copy()
    trial = shared.copy()
    for _ in range(len(shared)):
        if not moving.any():
            break
        held = trial - shared
        held[moving] = 0.0
        pull = gradient - normal @ held
        wanted = trial.copy()
        wanted[moving] = shared[moving] + np.linalg.solve(
            normal[np.ix_(moving, moving)], pull[moving]
        )
        trial = bounded(wanted, candidates, layout)
        stuck = moving & (np.abs(trial - wanted) > 1e-12)
        if not stuck.any():
            break
        moving &= ~stuck
    return trial


def arrow(
    blocks: dict[int, Block],
    spread: Floats,
    shared: Floats,
    layout: Shared,
    weight: float = 1.0,
    on: Mapping[int, tuple[NDArray[np.bool_], Floats]] | None = None,
) -> tuple[Floats, Floats, dict[int, tuple[Floats, Floats, Floats]]]:
    """Return normal matrix and gradient of the shared parameters, the strokes' scatter eliminated.

    weight: of the residuals against the priors; on: which scatter of a stroke is set on its bounds,
    and how far it moves for that (by default: what is there and presses outward).

    shared: [shared], spread: [strokes, scatter]; result [shared, shared], [shared], and by stroke
    what its scatter needs; no unit.
    """
    root = weight**0.5
    n = len(layout.names)
    normal: Floats = np.zeros((n, n))
    gradient: Floats = np.zeros(n)
    inner: dict[int, tuple[Floats, Floats, Floats]] = {}
    for k, block in blocks.items():
        r, a, b = root * block.residual, root * block.shared, root * block.scatter
        if on is None:
            gs: Floats = b.T @ r - spread[k]
            held = (np.abs(spread[k]) >= FARTHEST_SD) & (gs * spread[k] > 0.0)
        else:
            held = np.zeros(b.shape[1], dtype=bool)
            if k in on:
                held, moved = on[k]
                r = r - b @ np.where(held, moved, 0.0)
            gs = b.T @ r - spread[k]
        if held.any():
            b = np.where(held, 0.0, b)
            gs = np.where(held, 0.0, gs)
        inverse = np.asarray(np.linalg.inv(b.T @ b + np.eye(b.shape[1])), dtype=np.float64)
        hus: Floats = a.T @ b
        normal += a.T @ a - hus @ inverse @ hus.T
        gradient += a.T @ r - hus @ (inverse @ gs)
        inner[k] = (inverse, hus, gs)
    normal += layout.prior
    gradient -= layout.prior @ shared
    return normal, gradient, inner


def bounds_met(
    blocks: dict[int, Block],
    spread: Floats,
    shared: Floats,
    layout: Shared,
    weight: float,
    moving: NDArray[np.bool_],
    candidates: Sequence[Candidate],
) -> dict[int, tuple[NDArray[np.bool_], Floats]]:
    """Scatter that a full step of everything would carry out of its bounds, and its way to them.

    spread: [strokes, scatter], shared, moving: [shared]; no unit.
    """
    on: dict[int, tuple[NDArray[np.bool_], Floats]] = {}
    which = np.zeros(spread.shape, dtype=bool)
    begin = spread
    for _ in range(BOUNDS_PASSES):
        normal, gradient, inner = arrow(blocks, spread, shared, layout, weight, on)
        trial = stepped(shared, normal, gradient, moving, candidates, layout)
        there = scattered(begin, inner, trial - shared)
        outside = (np.abs(there) > FARTHEST_SD) & ~which
        if not outside.any():
            break
        which |= outside
        begin = np.where(outside, np.clip(there, -FARTHEST_SD, FARTHEST_SD), begin)
        on = {k: (which[k], begin[k] - spread[k]) for k in blocks if which[k].any()}
    return on


def scattered(
    spread: Floats, inner: dict[int, tuple[Floats, Floats, Floats]], moved: Floats
) -> Floats:
    """Return the strokes' scatter that goes with a step of the shared parameters.

    spread: [strokes, scatter], moved: [shared]; no unit.
    """
    there = spread.copy()
    for k, (inverse, hus, gs) in inner.items():
        there[k] += inverse @ (gs - hus.T @ moved)
    return there


def bounded(shared: Floats, candidates: Sequence[Candidate], layout: Shared) -> Floats:
    """Shared parameters with the healthy ones near and the effects' own within their bounds.

    shared: [shared], no unit.
    """
    out = shared.copy()
    out[: layout.healthy] = np.clip(out[: layout.healthy], -FARTHEST_SD, FARTHEST_SD)
    k = layout.healthy
    for item in candidates:
        for parameter in item.parameters:
            low, high = scaled_of(parameter, parameter.low), scaled_of(parameter, parameter.high)
            out[k] = min(max(out[k], low), high)
            k += 1
    return out

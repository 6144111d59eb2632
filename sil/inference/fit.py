"""Maximum a posteriori fit of one hypothesis to a whole campaign.

Healthy tolerances of the unit, scatter of each stroke and the hypothesis' own parameters are fitted
together. The normal equations have the shape of an arrow (each stroke's scatter touches that stroke
alone), so each stroke is eliminated on its own and only the shared block is solved.
Levenberg-Marquardt, steps bounded by the physical limits.

Source: Gauss-Newton with priors, e.g. Gelman et al., Bayesian Data Analysis; Schur elimination as
in bundle adjustment (Triggs et al. 2000).
Checked by: tests/unit/sil/inference/test_fit.py
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from plant.errors import IntegrationError
from sil.files.quantity import counted
from sil.inference.candidate import Candidate, precision, scaled_of
from sil.inference.problem import Block, Floats, Problem, Shared

FARTHEST_SD = 4.5
"""No healthy quantity is tried farther out than this: friction and flows stay positive."""

Inner = dict[int, tuple[Floats, Floats, Floats]]
"""By stroke: inverse of its scatter's information, coupling with the shared parameters, gradient."""

Bounds = dict[int, tuple[NDArray[np.bool_], Floats]]
"""By stroke: which of its scatter is set on its bounds, and how far it moves for that."""


def arrow(
    blocks: dict[int, Block],
    spread: Floats,
    shared: Floats,
    layout: Shared,
    weight: float = 1.0,
    on: Bounds | None = None,
) -> tuple[Floats, Floats, Inner]:
    """Return normal matrix [shared, shared], gradient [shared], the strokes' scatter eliminated, and what each of these needs.

    spread: [strokes, scatter]; shared: [shared]; no unit. weight: of the residuals against the
    priors; on: by default what is on its bound and presses outward.
    """
    n = len(layout.names)
    normal: Floats = np.zeros((n, n))
    gradient: Floats = np.zeros(n)
    inner: Inner = {}
    for k, block in blocks.items():
        r, a, b, aa, hus, bb = _weighted(block, weight)
        at_bound = np.zeros(b.shape[1], dtype=bool)
        if on is not None and k in on:
            at_bound, moved = on[k]
            r = r - b @ np.where(at_bound, moved, 0.0)
        gs: Floats = b.T @ r - spread[k]
        if on is None:
            at_bound = (np.abs(spread[k]) >= FARTHEST_SD) & (gs * spread[k] > 0.0)
        if at_bound.any():
            hus, bb = np.where(at_bound, 0.0, hus), np.where(at_bound | at_bound[:, None], 0.0, bb)
            gs = np.where(at_bound, 0.0, gs)
        inverse = np.asarray(np.linalg.inv(bb + np.eye(b.shape[1])), dtype=np.float64)
        normal += aa - hus @ inverse @ hus.T
        gradient += a.T @ r - hus @ (inverse @ gs)
        inner[k] = (inverse, hus, gs)
    normal += layout.prior
    gradient -= layout.prior @ shared
    return normal, gradient, inner


def _weighted(block: Block, weight: float) -> tuple[Floats, ...]:
    """Return residual, derivatives by shared and scatter, and the products of these, weighted."""
    if weight not in block.weighted:
        root = weight**0.5
        a, b = root * block.shared, root * block.scatter
        block.weighted.clear()
        block.weighted[weight] = root * block.residual, a, b, a.T @ a, a.T @ b, b.T @ b
    return block.weighted[weight]


def scattered(spread: Floats, inner: Inner, moved: Floats) -> Floats:
    """Return the scatter [strokes, scatter] that goes with a step `moved` [shared], all in the fit's scaled parameters."""
    there = spread.copy()
    for k, (inverse, hus, gs) in inner.items():
        there[k] += inverse @ (gs - hus.T @ moved)
    return there


@dataclass(frozen=True)
class Tried:
    """Values of a hypothesis: how many were tried and refused, fits lost therefore; first: why the first was refused."""

    ids: tuple[str, ...]
    tried: int = 0
    refused: int = 0
    lost: int = 0
    first: str = ""

    def __add__(self, other: Tried) -> Tried:
        return Tried(
            self.ids,
            self.tried + other.tried,
            self.refused + other.refused,
            self.lost + other.lost,
            self.first or other.first,
        )

    def __str__(self) -> str:
        given_up = f", {self.lost} of its fits given up" if self.lost else ""
        return (
            f"{self.refused} of {counted(self.tried, 'value')} tried cannot be simulated: left out"
            f"{given_up}; the first: {self.first}"
        )


def shown(candidates: Sequence[Candidate], values: Sequence[Mapping[str, float]]) -> str:
    """Return values of a hypothesis in words, empty for a hypothesis without any or a term's nodes."""
    named = [
        f"{name} {value:.4g}"
        for item, parameters in zip(candidates, values, strict=True)
        if not item.is_term
        for name, value in parameters.items()
    ]
    return f"{', '.join(named)} in " if named else ""


class Refusals(dict[str, Tried]):
    """What was tried of every hypothesis, by the name that its fit has."""

    def add(self, candidates: Sequence[Candidate], error: IntegrationError | None) -> None:
        """Count a value of a hypothesis that was simulated, or could not be because of an error."""
        self._add(candidates, refused=int(error is not None), tried=1, first=str(error or ""))

    def lose(self, candidates: Sequence[Candidate], error: IntegrationError) -> None:
        """Count a fit of a hypothesis that was given up because of an error."""
        self._add(candidates, lost=1, first=str(error))

    def _add(self, candidates: Sequence[Candidate], **counts: int | str) -> None:
        name = "+".join(item.name for item in candidates) or "healthy"
        ids = tuple(item.id for item in candidates)
        self.join({name: Tried(ids, **counts)})  # type: ignore[arg-type]

    def join(self, others: dict[str, Tried]) -> None:
        """Add what another process counted."""
        for name, item in others.items():
            self[name] = self[name] + item if name in self else item


Show = Callable[[float, float], None]
"""Shows that so much of so much is done."""

FIRST_DAMPING = 1e-5


def no_progress(done: float, size: float) -> None:
    """Show nothing."""


@dataclass
class FitResult:
    """A fitted hypothesis.

    cost: half the squared standardised residuals plus priors; shared, stroke: parameters in prior
    standard deviations (effects in typical sizes from neutral); normal: the information on the shared
    ones, priors added; blocks: the strokes in `use`, linearised at the optimum.
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
        """Covariance [shared, shared] of the shared parameters by the curvature at the optimum."""
        return np.asarray(np.linalg.pinv(self.normal))

    @property
    def scaled(self) -> Floats:
        """The hypothesis' own parameters [parameters] in typical sizes from neutral."""
        return self.shared[self.layout.effect_slice]

    @property
    def point(self) -> tuple[tuple[float, ...], ...]:
        """Values of the hypothesis' own parameters, cause by cause: where another fit may begin."""
        pairs = zip(self.candidates, self.values, strict=True)
        return tuple(tuple(values[p.name] for p in item.parameters) for item, values in pairs)

    def evidence(self) -> float:
        """Laplace's approximation of -2 log evidence, common constants left out."""
        _sign, logdet = np.linalg.slogdet(self.normal)
        _sign, prior = np.linalg.slogdet(self.layout.precision)
        return float(2.0 * self.cost + logdet - prior)

    def light(self) -> FitResult:
        """Return the same without the derivatives, small enough to travel between processes."""
        empty = np.zeros((0, 0))
        blocks = {k: Block(b.residual, empty, empty, empty) for k, b in self.blocks.items()}
        return replace(self, blocks=blocks)


class Fitter:
    """Fits hypotheses to the strokes of a campaign; refusals: what was tried of each, and not simulated."""

    def __init__(self, model: Problem, progress: Show = no_progress) -> None:
        """progress(done, size) is called at every iteration."""
        self.model = model
        self.progress = progress
        self.refusals = Refusals()

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

        shared: [shared], scatter: [strokes, scatter], in prior standard deviations; the sum ends
        once `limit` is passed; weight: of the residuals against the priors.
        """
        try:
            total = self.total(shared, scatter, candidates, use, limit, weight)
        except IntegrationError as error:
            self.refusals.add(candidates, error)
            return float("inf")
        self.refusals.add(candidates, None)
        return total

    def total(
        self,
        shared: Floats,
        scatter: Floats,
        candidates: Sequence[Candidate],
        use: Sequence[int],
        limit: float = np.inf,
        weight: float = 1.0,
    ) -> float:
        """Return what `cost` does at shared [shared], scatter [strokes, scatter] in deviations, uncounted.

        Raises IntegrationError, with the stroke and the value, where motion cannot be continued.
        """
        model = self.model
        healthy = len(model.unit) + len(model.offsets)
        total = 0.5 * float(shared[:healthy] @ shared[:healthy])
        scaled = shared[healthy:]
        total += 0.5 * float(scaled @ precision(candidates) @ scaled)
        for k in use:
            try:
                r = model.residual(k, shared, scatter[k], candidates)
            except IntegrationError as error:
                values = model.effect_values(candidates, scaled)
                raise IntegrationError(
                    f"{shown(candidates, values)}{model.name_of(k)}: {error}"
                ) from None
            total += 0.5 * weight * float(r @ r) + 0.5 * float(scatter[k] @ scatter[k])
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
        freeze: Sequence[int] = (),
        effects_first: int = 0,
        fine: bool = False,
        reuse: Mapping[int, Block] | None = None,
    ) -> FitResult:
        """Fit a hypothesis to the strokes in `use` (all by default).

        Parameters
        ----------
        start, scatter
            Where to begin: [shared] and [strokes, scatter], in prior standard deviations.
        freeze
            Indices of shared parameters that stay where they start; `normal` says nothing of them.
            With all of them, only the scatter of the strokes is fitted, as for held-out strokes.
        effects_first
            So many iterations move the hypothesis' own parameters alone: far from the optimum,
            tolerances and scatter would run to their bounds instead.
        fine
            End with central differences, which a valley between an effect and a tolerance needs.
        reuse
            Derivatives by tolerances and scatter to use (strokes absent here: those of the first
            full step) until a step with them gains nothing; they change little, and cost most.

        Raises
        ------
        IntegrationError
            The start itself cannot be simulated.
        """
        descent = _Descent(self, tuple(candidates), use, freeze, start, scatter)
        done = 0
        central = False
        reused = dict(reuse or {})
        while True:
            self.progress(done, iterations)
            own_only = done < min(effects_first, iterations)
            stale = bool(reused) and not own_only
            descent.linearise(central, own_only, reused if stale else {})
            if reuse is not None and not own_only:
                reused = descent.blocks
            if done >= iterations:
                descent.weight = 1.0
                descent.normal = descent.arrow()[0]
                return descent.result(done)
            done += 1
            gain = descent.step(own_only)
            if gain == "large":
                continue
            if own_only:
                effects_first = 0
            elif gain == "none" and stale:
                reused = {}
            elif fine and not central and not self.model.has_tangents:
                central = True
            elif gain == "none":
                return descent.result(done)
            else:
                iterations = done  # one last linearisation at the optimum

    def attempt(self, candidates: Sequence[Candidate], **options: Any) -> FitResult | None:
        """Return what `fit` does, light; None, which is counted, where it cannot be simulated."""
        try:
            return self.fit(candidates, **options).light()
        except IntegrationError as error:
            self.refusals.lose(candidates, error)
            return None

    def approach(
        self,
        candidates: Sequence[Candidate],
        start: Floats,
        scatter: Floats,
        use: Sequence[int],
        iterations: int,
    ) -> tuple[float, Floats]:
        """Move the hypothesis' own parameters alone; return cost and parameters [shared], no unit. Raises as `fit` does."""
        descent = _Descent(self, tuple(candidates), use, (), start, scatter)
        for _ in range(iterations):
            descent.linearise(False, True, {})
            if descent.step(True) == "none":
                break
        return descent.cost, descent.shared


class _Descent:
    """One fit in progress: its parameters, cost, damping and last linearisation."""

    def __init__(
        self,
        fitter: Fitter,
        candidates: tuple[Candidate, ...],
        use: Sequence[int] | None,
        freeze: Sequence[int],
        start: Floats | None,
        scatter: Floats | None,
    ) -> None:
        model = fitter.model
        self.fitter, self.model, self.candidates = fitter, model, candidates
        self.layout = model.layout(candidates)
        n = len(self.layout.names)
        parameters = [p for item in candidates for p in item.parameters]
        far = np.full(self.layout.healthy, FARTHEST_SD)
        self.low = np.array([*-far, *(scaled_of(p, p.low) for p in parameters)])
        self.high = np.array([*far, *(scaled_of(p, p.high) for p in parameters)])
        self.use = tuple(range(model.size)) if use is None else tuple(use)
        self.frozen = frozenset(freeze)
        self.free = np.ones(n, dtype=bool)
        self.free[list(freeze)] = False
        self.shared = np.zeros(n) if start is None else start.copy()
        self.spread = np.zeros((model.size, len(model.scatter)))
        if scatter is not None:
            self.spread[:] = scatter
        self.cost = fitter.total(self.shared, self.spread, candidates, self.use)
        if not np.isfinite(self.cost):
            raise IntegrationError("the start of the fit cannot be simulated")
        self.damping = FIRST_DAMPING
        self.weight = 1.0
        self.blocks: dict[int, Block] = {}
        self.normal: Floats = np.zeros((n, n))

    def linearise(self, central: bool, own_only: bool, reused: Mapping[int, Block]) -> None:
        """Linearise every stroke here, and weigh the residuals so that their mean square is at most one.

        Far from the optimum, errors of the derivatives times large residuals would outweigh the priors.
        """
        model, shared, causes = self.model, self.shared, self.candidates
        self.blocks = {
            k: model.linearise(
                k, shared, self.spread[k], causes, central, own_only, reused.get(k), self.frozen
            )
            for k in self.use
        }
        count = sum(len(block.residual) for block in self.blocks.values())
        self.weight = min(1.0, count / max(2.0 * self.misfit(), 1e-12))

    def misfit(self) -> float:
        """Return half the sum of squared residuals."""
        return 0.5 * sum(float(b.residual @ b.residual) for b in self.blocks.values())

    def step(self, own_only: bool) -> Literal["none", "small", "large"]:
        """Take the first damped step that lowers the weighted cost; return how large the gain is."""
        here = self.cost - (1.0 - self.weight) * self.misfit()
        moving = self.free
        if own_only:
            moving = moving & (np.arange(len(moving)) >= self.layout.healthy)
        for normal, gradient, inner, begin, tries in self.systems(moving, own_only):
            self.normal = normal
            damping = self.damping
            for _ in range(tries):
                damped = normal + damping * np.diag(np.diag(normal))
                trial = self.stepped(damped, gradient, moving)
                spread = scattered(begin, inner, trial - self.shared)
                spread = np.clip(spread, -FARTHEST_SD, FARTHEST_SD)
                cost = self.fitter.cost(trial, spread, self.candidates, self.use, here, self.weight)
                if cost < here:
                    self.shared, self.spread = trial, spread
                    self.cost = self.fitter.total(trial, spread, self.candidates, self.use)
                    self.damping = max(damping * 0.05, 1e-13)
                    return "small" if here - cost < 0.05 + 1e-6 * here else "large"
                damping = max(damping * 30.0, FIRST_DAMPING)
        self.damping = FIRST_DAMPING
        return "none"

    def systems(
        self, moving: NDArray[np.bool_], own_only: bool
    ) -> Iterator[tuple[Floats, Floats, Inner, Floats, int]]:
        """Yield the systems to solve: normal, gradient, inner, scatter to begin from, tries.

        First with the scatter that meets its bounds set on them, then with only what presses against its
        bound held; as it is if the hypothesis' own parameters move alone.
        """
        if own_only:
            normal: Floats = self.layout.prior.copy()
            gradient: Floats = -normal @ self.shared
            within = np.ix_(moving, moving)
            for block in self.blocks.values():
                columns = block.shared[:, moving]
                normal[within] += self.weight * (columns.T @ columns)
                gradient[moving] += self.weight * (columns.T @ block.residual)
            yield normal, gradient, {}, self.spread, 7
            return
        on = self.bounds_met(moving)
        if on:
            begin = self.spread.copy()
            for k, (_which, by) in on.items():
                begin[k] += by
            yield *self.arrow(on), begin, 3
        yield *self.arrow(), self.spread, 7

    def arrow(self, on: Bounds | None = None) -> tuple[Floats, Floats, Inner]:
        return arrow(self.blocks, self.spread, self.shared, self.layout, self.weight, on)

    def stepped(self, normal: Floats, gradient: Floats, moving: NDArray[np.bool_]) -> Floats:
        """Newton's step within the bounds: what runs into one stays there, the rest is solved again."""
        moving = moving.copy()
        shared = self.shared
        trial = shared.copy()
        for _ in range(len(shared)):
            if not moving.any():
                break
            fixed_step = trial - shared
            fixed_step[moving] = 0.0
            pull = gradient - normal @ fixed_step
            wanted = trial.copy()
            wanted[moving] = shared[moving] + np.linalg.solve(
                normal[np.ix_(moving, moving)], pull[moving]
            )
            trial = np.clip(wanted, self.low, self.high)
            stuck = moving & (np.abs(trial - wanted) > 1e-12)
            if not stuck.any():
                break
            moving &= ~stuck
        return trial

    def bounds_met(self, moving: NDArray[np.bool_]) -> Bounds:
        """Return the scatter that a full step of everything would carry out of its bounds."""
        on: Bounds = {}
        which = np.zeros(self.spread.shape, dtype=bool)
        begin = self.spread
        for _ in range(6):
            normal, gradient, inner = self.arrow(on)
            trial = self.stepped(normal, gradient, moving)
            there = scattered(begin, inner, trial - self.shared)
            outside = (np.abs(there) > FARTHEST_SD) & ~which
            if not outside.any():
                break
            which |= outside
            begin = np.where(outside, np.clip(there, -FARTHEST_SD, FARTHEST_SD), begin)
            on = {k: (which[k], begin[k] - self.spread[k]) for k in self.blocks if which[k].any()}
        return on

    def result(self, iterations: int) -> FitResult:
        values = self.model.effect_values(self.candidates, self.shared[self.layout.effect_slice])
        state = self.cost, self.shared, self.spread, self.normal
        return FitResult(
            self.candidates, self.layout, self.use, *state, values, iterations, self.blocks
        )

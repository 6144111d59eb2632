"""Maximum a posteriori fit of one hypothesis to a truck's shifts, and its evidence.

A position, known to a tick of its timer, is off by noise of the pulses, of their instants where the stay moves, and now and then by
much more: Student's t. Its scale is at least that of the noise and estimated by likelihood, at a price
of log(factor) for each number. Each shift has quantities of its own, eliminated on its own; how much
the loads differ from shift to shift is estimated by EM. Pulses have kinks by every quantity where the
stay sticks and releases: steps are tried at several dampings at once, and before each stage random
quantities of every shift; the best are taken.
Source: Levenberg-Marquardt with Schur elimination, as in sil/inference/fit.py; slopes by Broyden (1965) between
differences; evidence by Laplace.
Checked by: tests/unit/sil/inference/truck/test_fit.py
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np

from sil.inference.problem import Floats
from sil.inference.truck.causes import Cause
from sil.inference.truck.simulator import Bools, Ints, ShiftModel

Rng = np.random.Generator


@dataclass(frozen=True)
class Priors:
    """Distributions that a fit assumes; typical sizes of a cause are 1, tails degrees of freedom of Student's t."""

    tail: float = 4.0
    """Of a position's error."""
    unit_tail: float = 6.0
    """Of what differs between trucks: an unusual truck is no faulty one."""
    size_sd: float = 3.0
    """Scale of a cause's size."""
    size_tail: float = 2.0
    """Of a cause's size: a severe fault is no less a fault."""
    instant_s: float = 7e-5
    """Standard deviation of the instant of a pulse."""
    spreads: tuple[float, float] = (0.02, 3.0)
    """Limits of an estimated spread between shifts, by its usual value."""


@dataclass(frozen=True)
class Steps:
    """How a fit moves; costs in log evidence."""

    farthest_sd: float = 8.0
    """No quantity is tried farther out."""
    followed: int = 2
    """Rounds in which slopes only follow the steps, where a fit is not judged."""
    steepest_m: float = 15e-3
    """Derivative of a position by a standard deviation, at most: beyond, it is a jump."""
    dampings: tuple[float, ...] = (0.0, 0.01, 0.1, 1.0, 10.0)
    """Of the steps tried at once."""
    short: float = 0.4
    """Share of an undamped step that is tried besides."""
    trip_draws: int = 4
    """Supplies of a trip that are drawn, with the present one."""
    of_others: float = 0.25
    """Share of draws that are another shift's quantities."""
    passing: float = 0.2
    """Share of draws in which a cone stops nothing."""
    centrings: int = 3
    informed: float = 0.9
    """Share of a load's variance that a shift leaves at most if its spread is estimated with it."""
    impossible: float = 1e6
    """Cost of a shift that cannot be simulated."""
    stuck: float = 4.0
    """Cost beyond the median from which a shift begins anew, ..."""
    freed: int = 2
    """... so many of them at once, ..."""
    starts: int = 8
    """... each from so many starts, ..."""
    draws: int = 16
    """... the best of so many draws, ..."""
    settling: int = 6
    """... with so many rounds of settling ..."""
    freeing: float = 1.0
    """... if it gains at least this."""


PRIORS, STEPS = Priors(), Steps()
COARSE_M, MIDDLE_M, FINE_M = 1e-3, 1e-4, 1e-5
"""Errors of the model that a stage allows for: first large, so that a fit finds its way."""
FIRST_FACTOR: Final = 4.0
"""Factor of the noise at which the last stage begins."""
FACTORS: Final[Floats] = np.exp(np.linspace(0.0, np.log(40.0), 80))
PULSE_S: Final = 0.01
FAR_SD: Final = 5.0
"""Standard deviations of a position that noise hardly ever makes."""


@dataclass(frozen=True, eq=False)
class Fit:
    """A hypothesis with everything that it leaves free.

    size: of the cause, in typical ones; unit [quantities], each [shifts, differing]: in standard
    deviations; spread [differing]: estimated factors on those between shifts; noise_factor: on the
    expected noise; cost: negative log posterior, per_shift [shifts] of it; position_m [shifts, pulses]:
    predicted; size_sd, unit_sd [quantities]: standard deviations of both, from the information.
    """

    cause: Cause | None
    size: float
    unit: Floats
    each: Floats
    spread: Floats
    noise_factor: float = 1.0
    cost: float = np.inf
    per_shift: Floats | None = None
    position_m: Floats | None = None
    evidence: float = -np.inf
    size_sd: float = 0.0
    unit_sd: Floats | None = None
    mounted: bool = True

    @property
    def id(self) -> str:
        """Identifier of its cause; healthy without one."""
        return "healthy" if self.cause is None else self.cause.id

    @property
    def name(self) -> str:
        """Its cause with the variant."""
        return "healthy" if self.cause is None else self.cause.name


class System(NamedTuple):
    """Normal equations: blocks of the arrow and gradients, of the shared quantities and of each shift's."""

    shared: Floats
    shared_gradient: Floats
    coupling: Floats
    own: Floats
    own_gradient: Floats

    def steps(self, dampings: Sequence[float]) -> tuple[Floats, Floats]:
        """Return the steps at dampings [n]: of the shared quantities [n, shared] and of each shift's [n, shifts, differing]."""
        inverse = self._own_inverses(dampings)
        reach = self.coupling @ inverse
        normal = self.shared + np.reshape(dampings, (-1, 1, 1)) * np.diag(np.diag(self.shared))
        normal = normal - (reach @ np.swapaxes(self.coupling, 1, 2)).sum(axis=1)
        own_gradient = self.own_gradient[..., None]
        gradient = self.shared_gradient[:, None] - (reach @ own_gradient).sum(axis=1)
        moved = np.linalg.solve(normal, gradient)
        rest = own_gradient - np.swapaxes(self.coupling, 1, 2) @ moved[:, None]
        return moved[..., 0], (inverse @ rest)[..., 0]

    def own_steps(self, dampings: Sequence[float]) -> Floats:
        """Return the steps of each shift's quantities [n, shifts, differing] at dampings [n], the shared ones kept."""
        return np.asarray((self._own_inverses(dampings) @ self.own_gradient[..., None])[..., 0])

    def _own_inverses(self, dampings: Sequence[float]) -> Floats:
        diagonal = self.own * np.eye(self.own.shape[1])
        return np.asarray(np.linalg.inv(self.own + np.reshape(dampings, (-1, 1, 1, 1)) * diagonal))

    @property
    def marginal(self) -> Floats:
        """Information [shared, shared] on the shared quantities, each shift's eliminated, no unit."""
        reach = self.coupling @ np.linalg.inv(self.own)
        out: Floats = self.shared - np.einsum("kpi,kqi->pq", reach, self.coupling)
        return out


class Trials(NamedTuple):
    """Fits to choose from, as arrays: fields as of `Fit` with the trials in front; whole [trials, shifts]: `per_shift` with its prior."""

    unit: Floats
    each: Floats
    size: Floats
    position_m: Floats
    per_shift: Floats
    whole: Floats

    @property
    def cost(self) -> Floats:
        """Negative log posterior [trials]."""
        unit = _tail_cost(self.unit).sum(axis=1) + _size_cost(self.size)
        return np.asarray(self.whole.sum(axis=1) + unit)

    def joined(self, other: Trials) -> Trials:
        """Return trials with each shift as in the better one of two: cones and teeth stop it, or not."""
        better = self.whole > other.whole
        wide = better[..., None]
        return self._replace(
            each=np.where(wide, other.each, self.each),
            position_m=np.where(wide, other.position_m, self.position_m),
            per_shift=np.where(better, other.per_shift, self.per_shift),
            whole=np.where(better, other.whole, self.whole),
        )

    def best(self, fit: Fit) -> Fit:
        """Return the best of them, else as a fit."""
        costs = self.cost
        k = int(np.argmin(costs))
        return replace(
            fit,
            unit=self.unit[k],
            each=self.each[k],
            size=float(self.size[k]),
            position_m=self.position_m[k],
            per_shift=self.per_shift[k],
            cost=float(costs[k]),
        )


class Fitter:
    """Fits hypotheses to recorded shifts; fixed: the size is not moved."""

    def __init__(self, model: ShiftModel, noise_m: float) -> None:
        self.model = model
        self.measured_noise_m = noise_m
        # the timer's rounding is in what is measured at rest, and is no error of its own
        self.noise_m = float(np.sqrt(max(noise_m**2 - model.tick_m**2 / 12.0, 0.0)))
        self.layout = model.layout
        self.position_m = model.position_m
        self.count = int(model.recorded.sum())
        self.mask: Bools = model.acts[:, self.layout.differing]
        speed = np.abs(np.gradient(self.position_m, axis=1)) / PULSE_S
        beside = np.maximum(np.roll(speed, 1, 1), np.roll(speed, -1, 1))
        self.speed_m_s: Floats = np.maximum(speed, 0.5 * beside)
        # pulses have kinks: with slopes of its own a hypothesis is some ten in log evidence off
        self.reference: Floats | None = None
        self.likeliest: Fit | None = None  # whose loads others try, once it is known

    # --- costs

    def off(self, x: Floats, which: Ints | slice = slice(None)) -> Floats:
        """Return by how much recorded positions differ from `x` [n, pulses] beyond the timer's rounding, in m."""
        rest = self.position_m[which] - x
        return np.asarray(np.sign(rest) * np.maximum(np.abs(rest) - 0.5 * self.model.tick_m, 0.0))

    def variance(self, error_m: float, factor: float = 1.0) -> Floats:
        """Return the squared scale [shifts, pulses] of a position's error in m^2; error_m: that of the model."""
        instant_s = PRIORS.instant_s * max(1.0, error_m / FINE_M) ** 0.5
        noise = self.noise_m**2 + error_m**2 + (instant_s * self.speed_m_s) ** 2
        return np.asarray(factor**2 * noise)

    def _misfit(self, x: Floats, done: Bools, which: Ints, variance: Floats) -> Floats:
        """Return the cost [n] of predicted positions [n, pulses] by Student's t."""
        ratio = self.off(x, which) ** 2 / variance[which]
        tail = 0.5 * (PRIORS.tail + 1.0) * np.log1p(ratio / PRIORS.tail)
        cost = np.where(self.model.recorded[which], tail, 0.0).sum(axis=1)
        return np.where(done & np.isfinite(cost), cost, STEPS.impossible)

    def prior_cost(self, fit: Fit) -> float:
        """Return the cost of the priors of a fit."""
        return self.unit_cost(fit.unit, fit.size) + float(_own_cost(fit.each, fit.spread).sum())

    @staticmethod
    def unit_cost(unit: Floats, size: float = 0.0) -> float:
        """Return the cost of the truck's quantities [quantities] and a cause's size."""
        return float(_tail_cost(unit).sum() + _size_cost(size))

    def factor_of(self, x: Floats) -> float:
        """Return the likeliest factor of the noise that leaves positions [shifts, pulses]."""
        ratio = (self.off(x) ** 2 / self.variance(FINE_M))[self.model.recorded]
        scaled = np.minimum(ratio, 1e8)[:, None] / FACTORS**2 / PRIORS.tail
        cost = self.count * np.log(FACTORS) + 0.5 * (PRIORS.tail + 1.0) * np.log1p(scaled).sum(
            axis=0
        )
        return float(FACTORS[int(np.argmin(cost))])

    def deviating(self, fit: Fit) -> int:
        """Return in how many shifts a position is farther off than noise makes it."""
        assert fit.position_m is not None
        off = np.abs(self.off(fit.position_m)) > FAR_SD * np.sqrt(self.variance(FINE_M))
        return int((off & self.model.recorded).any(axis=1).sum())

    def chi2(self, fit: Fit) -> float:
        """Return chi squared per number that a fit leaves."""
        assert fit.position_m is not None
        ratio = self.off(fit.position_m) ** 2 / self.variance(FINE_M)
        return float(ratio[self.model.recorded].mean())

    def misfit_cost(self, fit: Fit) -> float:
        """Return the cost of what a fit leaves of the positions, against noise as measured."""
        assert fit.per_shift is not None
        return float(fit.per_shift.sum()) + self.count * float(np.log(fit.noise_factor))

    def start(self, cause: Cause | None = None, size: float = 0.0) -> Fit:
        """Return a usual truck."""
        each = np.zeros((len(self.model), len(self.layout.differing)))
        spread = np.ones(len(self.layout.differing))
        unit = np.zeros(len(self.layout))
        return Fit(cause, size, unit, each, spread, mounted=self.model.mounted)

    def evaluated(self, fit: Fit, error_m: float) -> Fit:
        """Return a fit with its predictions and cost at an error of the model."""
        which = np.arange(len(self.model))
        x, done = self.model.positions(
            which, self.layout.amounts(fit.unit, fit.each), fit.cause, fit.size
        )
        per_shift = self._misfit(x, done, which, self._variance_of(fit, error_m))
        cost = float(per_shift.sum()) + self.prior_cost(fit)
        return replace(fit, position_m=x, per_shift=per_shift, cost=cost)

    def _variance_of(self, fit: Fit, error_m: float) -> Floats:
        return self.variance(error_m, fit.noise_factor if error_m == FINE_M else 1.0)

    # --- derivatives

    def _steps(self, share: float) -> Floats:
        """Return the steps [quantities] of a difference, in their units."""
        sd, columns = self.layout.unit_sd.copy(), self.layout.differing
        sd[columns] = np.minimum(sd[columns], self.layout.shift_sd)
        return share * sd

    def derivatives(
        self, fit: Fit, share: float, sides: tuple[float, ...], shared: bool = True
    ) -> Floats:
        """Return the derivatives [shifts, pulses, quantities + 1] of positions by standard deviations and size.

        shared: also by what does not differ between shifts.
        """
        assert fit.position_m is not None
        layout = self.layout
        rows, columns = np.nonzero(self._moving(fit, shared))
        base = np.nan_to_num(fit.position_m)
        sizes = np.full((len(base), 1), fit.size)
        here = np.hstack([layout.amounts(fit.unit, fit.each), sizes])[rows]
        by = np.append(self._steps(share), 0.0)[columns]
        moves = []
        for side in sides:
            # a cone that stops nothing has no slope: towards where it stops the stay it has a step
            moves.append(np.where(columns == layout.at["cone"], 1.0, side) * by)
            moves[-1][columns == len(layout)] = self._size_step(fit, side * share)
        there = np.tile(here, (len(sides), 1))
        there[np.arange(len(there)), np.tile(columns, len(sides))] += np.concatenate(moves)
        x, done = self.model.positions(
            np.tile(rows, len(sides)), there[:, :-1], fit.cause, there[:, -1]
        )
        x = np.where(done[:, None], np.nan_to_num(x), np.tile(base[rows], (len(sides), 1)))
        out = np.zeros((*base.shape, len(layout) + 1))
        scale = np.append(layout.unit_sd, 1.0)[columns] / len(sides)
        for move, moved in zip(moves, x.reshape(len(sides), len(rows), -1), strict=True):
            out[rows, :, columns] += (moved - base[rows]) * (scale / move)[:, None]
        supply = layout.at["supply"]
        for column in layout.of_trips if shared else ():  # the same pressure, in other units
            ratio = layout.unit_sd[column] / layout.unit_sd[supply] * self.model.acts[:, column]
            out[:, :, column] = out[:, :, supply] * ratio[:, None]
        out[:, :, layout.at["offset"]] = layout.unit_sd[layout.at["offset"]]
        out[:, :, layout.at["gain"]] = fit.position_m * layout.unit_sd[layout.at["gain"]]
        return out

    def _moving(self, fit: Fit, shared: bool) -> Bools:
        """Return by which quantities of which shifts, and size [shifts, quantities + 1], positions have to be simulated anew."""
        moves = self.model.acts & self.layout.simulated
        if not shared:
            moves &= np.isin(np.arange(len(self.layout)), self.layout.differing)
        by_size = np.full((len(moves), 1), shared and fit.cause is not None)
        return np.hstack([moves, by_size])

    @staticmethod
    def _size_step(fit: Fit, step: float) -> float:
        """Return a step of the size, to the other side where the size has its limit."""
        if fit.cause is None:
            return 0.0
        size = fit.cause.clipped(fit.size + step)
        return (size if size != fit.size else fit.cause.clipped(fit.size - step)) - fit.size

    def own_derivatives(self, derivatives: Floats) -> Floats:
        """Return the derivatives [shifts, pulses, differing] in m by each shift's quantities, of all of them."""
        columns = self.layout.differing
        scale = self.layout.shift_sd / self.layout.unit_sd[columns]
        out: Floats = derivatives[:, :, columns] * scale * self.mask[:, None, :]
        return out

    def weighted_residual(
        self, fit: Fit, variance: Floats, expected: bool = False
    ) -> tuple[Floats, Floats]:
        """Return recorded less predicted positions [shifts, pulses] in m, and their weights in 1/m^2."""
        assert fit.position_m is not None
        rest = np.where(self.model.recorded, np.nan_to_num(self.off(fit.position_m)), 0.0)
        ratio = 3.0 if expected else rest**2 / variance
        weight = np.where(
            self.model.recorded, (PRIORS.tail + 1.0) / (PRIORS.tail + ratio) / variance, 0.0
        )
        return rest, weight

    def system(
        self, fit: Fit, derivatives: Floats, variance: Floats, expected: bool = False
    ) -> System:
        """Return the normal equations of derivatives [shifts, pulses, quantities + 1] in m and variance in m^2.

        expected: with the information that errors have on average.
        """
        shared = len(self.layout) + (fit.cause is not None)
        rest, weight = self.weighted_residual(fit, variance, expected)
        by_unit, by_own = derivatives[:, :, :shared], self.own_derivatives(derivatives)
        weighted, weighted_own = by_unit * weight[..., None], by_own * weight[..., None]
        size_prior = (PRIORS.size_tail + 1.0) / (PRIORS.size_tail * PRIORS.size_sd**2 + fit.size**2)
        prior = np.append((PRIORS.unit_tail + 1.0) / (PRIORS.unit_tail + fit.unit**2), size_prior)[
            :shared
        ]
        value = np.append(fit.unit, fit.size)[:shared]
        turned = np.swapaxes
        return System(
            (turned(weighted, 1, 2) @ by_unit).sum(axis=0) + np.diag(prior),
            weighted.reshape(-1, shared).T @ rest.ravel() - prior * value,
            turned(weighted, 1, 2) @ by_own,
            turned(weighted_own, 1, 2) @ by_own + np.diag(1.0 / fit.spread**2),
            (turned(weighted_own, 1, 2) @ rest[..., None])[..., 0] - fit.each / fit.spread**2,
        )

    # --- fits

    def improved(
        self,
        fit: Fit,
        error_m: float,
        rounds: int,
        least: float = 0.3,
        fixed: bool = False,
        kept: Sequence[int] = (),
        enough: float = -np.inf,
        followed: int = STEPS.followed,
        again: bool = True,
    ) -> Fit:
        """Return a fit after at most so many rounds of steps that each gain `least`.

        fixed: its size is kept; kept: columns of the truck's quantities that are; enough: cost at which it ends;
        followed: rounds in which slopes only follow the steps (Broyden); again: where no step gains, it goes on by
        wider differences.
        """
        variance = self._variance_of(fit, error_m)
        fit = self.centred(self.evaluated(fit, error_m), kept)
        stuck, columns = False, np.array(kept, dtype=np.int64)
        slopes, before, age = np.empty(0), fit, followed
        for turn in range(rounds):
            if fit.cost <= enough:
                break
            if age == followed:
                slopes = self.derivatives(fit, 0.4 if stuck else 0.1, ((1.0, -1.0)[turn % 2],))
                age = 0
            else:
                slopes, age = self._followed(slopes, before, fit), age + 1
            system = self.system(fit, slopes, variance)
            if fixed and fit.cause is not None:
                system.shared[-1, -1], system.shared_gradient[-1] = 1e15, 0.0
            system.shared[columns, columns], system.shared_gradient[columns] = 1e15, 0.0
            unit, each, size = self._moved(fit, *system.steps(STEPS.dampings))
            tried = self._tried(fit, unit, each, size, variance)
            best = tried.best(fit)
            # slopes that only followed are taken anew before a fit counts as stuck
            if best.cost >= fit.cost - least and not age:
                each = self._loads_of(fit, unit, each)
                best = tried.joined(self._tried(fit, unit, each, size, variance)).best(fit)
            if best.cost < fit.cost - least:
                before, fit, stuck = fit, self.centred(best, kept), False
            elif stuck or (not age and not again):
                break
            else:
                stuck, age = not age, followed
        return fit

    def _followed(self, slopes: Floats, before: Fit, fit: Fit) -> Floats:
        """Return slopes [shifts, pulses, quantities + 1] that agree with the last step (Broyden)."""
        assert fit.position_m is not None and before.position_m is not None
        there, here = (self.layout.amounts(f.unit, f.each) * self.model.acts for f in (fit, before))
        by_size = np.full(len(there), fit.size - before.size)
        moved = np.column_stack([(there - here) / self.layout.unit_sd, by_size])
        rest = fit.position_m - before.position_m - np.einsum("ktp,kp->kt", slopes, moved)
        along = moved / np.maximum((moved**2).sum(axis=1, keepdims=True), 1e-12)
        out: Floats = slopes + np.nan_to_num(rest)[:, :, None] * along[:, None, :]
        return out

    def _tried(
        self, fit: Fit, unit: Floats, each: Floats, size: Floats, variance: Floats
    ) -> Trials:
        """Return trials [n, ...] of the hypothesis of a fit with their costs at a variance [shifts, pulses]."""
        shape = each.shape[:2]
        which = np.tile(np.arange(shape[1]), shape[0])
        amounts = self.layout.amounts(unit, each).reshape(len(which), -1)
        x, done = self.model.positions(which, amounts, fit.cause, np.repeat(size, shape[1]))
        per_shift = self._misfit(x, done, which, variance).reshape(shape)
        whole = per_shift + _own_cost(each, fit.spread)
        return Trials(unit, each, size, x.reshape(*shape, -1), per_shift, whole)

    def with_loads_of(self, other: Fit, fit: Fit) -> Fit:
        """Return a fit in which each shift has the loads of its gears as in another one."""
        return replace(fit, each=self._loads_of(other, fit.unit, fit.each))

    def _loads_of(self, other: Fit, unit: Floats, each: Floats) -> Floats:
        """Return quantities [..., shifts, differing] with the loads of gears as in a fit, in trucks [..., quantities]."""
        columns = self.layout.differing[self.layout.of_gears]
        ratio = self.layout.unit_sd[columns] / self.layout.shift_sd[self.layout.of_gears]
        moved = ratio * (unit - other.unit)[..., None, columns]
        each = each.copy()
        each[..., self.layout.of_gears] = other.each[:, self.layout.of_gears] - moved
        return np.asarray(each * self.mask)

    def _moved(self, fit: Fit, *steps: Floats) -> tuple[Floats, Floats, Floats]:
        """Return quantities and sizes after `System.steps` and, besides, a short one of the first, within the limits."""
        shared, differing = (np.concatenate([STEPS.short * by[:1], by]) for by in steps)
        units, most = len(self.layout), STEPS.farthest_sd
        unit = np.clip(fit.unit + shared[:, :units], -most, most)
        each = np.clip(fit.each + differing, -most, most) * self.mask
        size = np.full(len(shared), fit.size)
        if fit.cause is not None:
            size = np.clip(fit.size + shared[:, units], *fit.cause.bounds)
        return unit, each, size

    def centred(self, fit: Fit, kept: Sequence[int] = ()) -> Fit:
        """Return a fit with the same predictions that its priors like better.

        What its shifts have in common is the truck's, or the trip's; kept: columns of the truck's that stay.
        """
        unit, each = fit.unit.copy(), fit.each.copy()
        at = {column: k for k, column in enumerate(self.layout.differing.tolist())}
        supply = self.layout.at["supply"]
        groups = [(c, at[supply], self.model.acts[:, c]) for c in self.layout.of_trips.tolist()]
        groups += [(column, k, self.mask[:, k]) for column, k in at.items()]
        for column, k, rows in groups:
            if column in kept or not rows.any():
                continue
            ratio = self.layout.shift_sd[k] / self.layout.unit_sd[column]
            weight, total, count = fit.spread[k] ** -2, each[rows, k].sum(), rows.sum()
            moved = 0.0
            for _ in range(STEPS.centrings):
                u = unit[column] + ratio * moved
                own = (PRIORS.unit_tail + 1.0) / (PRIORS.unit_tail + u * u)
                slope = weight * (total - count * moved) - own * ratio * u
                moved += slope / (weight * count + own * ratio**2)
            unit[column] += ratio * moved
            each[rows, k] -= moved
        centred = replace(fit, unit=unit, each=each)
        gain = self.prior_cost(fit) - self.prior_cost(centred)
        return replace(centred, cost=fit.cost - gain)

    def rescanned(self, fit: Fit, error_m: float, rng: Rng, number: int = 32) -> Fit:
        """Return a fit with the best of random quantities for each shift: half of them near, half by the prior."""
        n, own = fit.each.shape
        trips = [np.flatnonzero(acts) for acts in self.model.acts[:, self.layout.of_trips].T]
        if error_m == FINE_M:
            trips = []
        groups = STEPS.trip_draws if trips else 1
        anywhere = rng.random((n, number, 1)) < 0.5
        near = rng.choice([0.1, 0.3], (n, number, 1))
        width = np.where(anywhere, np.maximum(fit.spread, 0.7), near * np.maximum(fit.spread, 0.2))
        centre = np.where(anywhere, 0.0, fit.each[:, None, :])
        there = centre + width * rng.normal(size=(n, number, own)) * self.mask[:, None, :]
        there = np.where(rng.random((n, number, own)) < 0.5, fit.each[:, None, :], there)
        # what another shift has, where the loads are much the same
        others = rng.integers(n, size=(n, number))
        swaps = rng.random((n, number, 1)) < STEPS.of_others
        there = np.where(swaps, fit.each[others] * self.mask[:, None, :], there)
        cone, passing = self._passing(fit)
        reached = self.mask[:, cone] & (passing > -STEPS.farthest_sd)
        passes = (rng.random((n, number)) < STEPS.passing) & reached[:, None]
        there[:, :, cone] = np.where(passes, passing[:, None], there[:, :, cone])
        there[:, :: number // groups] = fit.each[:, None, :]
        # draws in groups: all shifts of a trip have the same supply in each, the first the present one
        units = np.repeat(fit.unit[None], groups, axis=0)
        drawn = units[1:, self.layout.of_trips]
        units[1:, self.layout.of_trips] = np.where(
            rng.random(drawn.shape) < 0.5,
            drawn + 0.3 * rng.normal(size=drawn.shape),
            rng.normal(size=drawn.shape),
        )
        which = np.repeat(np.arange(n), number)
        amounts = self.layout.amounts(units[0], there.reshape(-1, own)).reshape(
            n, groups, -1, len(self.layout)
        )
        amounts += ((units - units[0]) * self.layout.unit_sd)[None, :, None, :]
        x, done = self.model.positions(which, amounts.reshape(n * number, -1), fit.cause, fit.size)
        variance = self._variance_of(fit, error_m)
        per_shift = self._misfit(x, done, which, variance).reshape(n, groups, -1)
        total = per_shift + _own_cost(there, fit.spread).reshape(per_shift.shape)
        unit, taken = fit.unit.copy(), np.zeros(n, dtype=np.int64)
        for column, shifts in zip(self.layout.of_trips.tolist(), trips, strict=False):
            if not len(shifts):
                continue  # a trip with shifts among others only
            cost = total[shifts].min(axis=2).sum(axis=0) + _tail_cost(units[:, column])
            taken[shifts] = int(np.argmin(cost))
            unit[column] = units[taken[shifts[0]], column]
        rows = np.arange(n)
        best = np.argmin(total[rows, taken], axis=1)
        chosen = taken * (number // groups) + best
        return replace(
            fit,
            unit=unit,
            each=there[rows, chosen],
            position_m=x.reshape(n, number, -1)[rows, chosen],
            per_shift=per_shift[rows, taken, best],
            cost=float(total[rows, taken, best].sum()) + self.unit_cost(unit, fit.size),
        )

    def _passing(self, fit: Fit) -> tuple[int, Floats]:
        """Return the place of the cone's impulse among what differs, and what [shifts] it is if the stay just passes."""
        column = self.layout.at["cone"]
        cone = int(np.flatnonzero(self.layout.differing == column)[0])
        amount = self.model.passing - fit.unit[column] * self.layout.unit_sd[column] - 0.01
        return cone, amount / self.layout.shift_sd[cone]

    def freed(self, fit: Fit, rng: Rng) -> Fit:
        """Return a fit in which the shifts farthest off have begun anew, and the likeliest's loads, where that is better.

        Its loads may differ from the others' as much as loads ever do: they come together afterwards.
        """
        fit = self.evaluated(fit, FINE_M)
        each = self.begun_anew(fit, FINE_M, rng)
        if each is None:
            return fit
        anew = replace(fit, spread=self._widest(fit), each=each)
        anew = self.improved(anew, FINE_M, 8)
        anew = self.improved(self.with_scales(anew), FINE_M, 8)
        return min(anew, self.with_scales(fit), key=self.whole_cost)

    def begun_anew(self, fit: Fit, error_m: float, rng: Rng) -> Floats | None:
        """Return quantities [shifts, differing] of which the shifts farthest off have begun anew; None if none gains.

        A shift may end in a minimum of its own, teeth that part too early, say, from which the truck's quantities do not
        lead it; what is shared stays as it is until all are fitted again.
        """
        assert fit.per_shift is not None
        off = fit.per_shift - np.median(fit.per_shift)
        worst = np.argsort(-off)[: STEPS.freed]
        stuck = worst[off[worst] > STEPS.stuck]
        if not len(stuck):
            return None
        starts = STEPS.starts
        alone = Fitter(self.model.only(np.repeat(stuck, starts)), self.measured_noise_m)
        wide = replace(fit, spread=self._free_spread(fit, stuck))
        anew = alone.drawn(wide, rng)
        anew.each[::starts] = fit.each[stuck]
        if self.likeliest is not None:
            anew.each[1::starts] = self.with_loads_of(self.likeliest, fit).each[stuck]
        anew = alone.evaluated(alone.settled(anew, STEPS.settling), error_m)
        assert anew.per_shift is not None
        cost = (anew.per_shift + _own_cost(anew.each, wide.spread)).reshape(-1, starts)
        present = (fit.per_shift + _own_cost(fit.each, wide.spread))[stuck]
        gains = present - cost.min(axis=1) > STEPS.freeing
        if not gains.any():
            return None
        each = fit.each.copy()
        best = np.arange(len(stuck)) * starts + np.argmin(cost, axis=1)
        each[stuck[gains]] = anew.each[best[gains]]
        return each

    def _widest(self, fit: Fit) -> Floats:
        """Return spreads [differing] of which those of loads are as wide as they ever are."""
        return np.where(self.layout.is_load, PRIORS.spreads[1], fit.spread)

    def _free_spread(self, fit: Fit, stuck: Ints) -> Floats:
        """Return spreads [differing] of shifts that begin anew; the supply's is that of trips if only these are in theirs."""
        spread = self._widest(fit)
        others = np.setdiff1d(np.arange(len(self.model)), stuck)
        trips = self.model.acts[:, self.layout.of_trips]
        if not (trips[stuck].any(axis=0) & trips[others].any(axis=0)).any():
            k = int(np.flatnonzero(self.layout.differing == self.layout.at["supply"])[0])
            of_trip = self.layout.unit_sd[self.layout.of_trips]
            spread[k] = max([spread[k], *(of_trip / self.layout.shift_sd[k])])
        return spread

    def whole_cost(self, fit: Fit) -> float:
        """Return the cost of a fit, with what its scales and its volume cost: the one by which fits compare."""
        if self.reference is None:
            scales = self.count * np.log(fit.noise_factor) + (self.mask * np.log(fit.spread)).sum()
            return fit.cost + float(scales)
        return fit.cost + self._volume_cost(fit, self.reference)

    def _volume_cost(self, fit: Fit, slopes: Floats) -> float:
        """Return the cost of the scales, and of the volume that all but a cause's size have at slopes (Laplace)."""
        variance = self._variance_of(fit, FINE_M)
        system = self.system(replace(fit, cause=None), slopes, variance, expected=True)
        volume = np.linalg.slogdet(system.own)[1].sum() + np.linalg.slogdet(system.marginal)[1]
        # of every shift: the information holds a prior also for what does not act on one
        spreads = len(self.model) * np.log(fit.spread).sum()
        return float(self.count * np.log(fit.noise_factor) + 0.5 * volume + spreads)

    def drawn(self, fit: Fit, rng: Rng) -> Fit:
        """Return a fit with the best of random quantities for each shift, its loads anywhere within their spreads."""
        n, own = len(self.model), len(self.layout.differing)
        shape = n, STEPS.draws, own
        there = rng.normal(size=shape) * (rng.random(shape) < 0.5)
        load = rng.uniform(-1.0, 1.0, shape) * fit.spread
        there = np.where(self.layout.is_load, load, there)
        there *= self.mask[:, None, :]
        which = np.repeat(np.arange(n), STEPS.draws)
        amounts = self.layout.amounts(fit.unit, there.reshape(-1, own))
        x, done = self.model.positions(which, amounts, fit.cause, fit.size)
        variance = self._variance_of(fit, MIDDLE_M)
        cost = self._misfit(x, done, which, variance).reshape(n, -1) + _own_cost(there, fit.spread)
        return replace(fit, each=there[np.arange(n), np.argmin(cost, axis=1)])

    def settled(self, fit: Fit, rounds: int) -> Fit:
        """Return a fit after so many rounds of each shift's own steps; what is shared is kept.

        In every second one slopes only follow the steps.
        """
        variance = self._variance_of(fit, MIDDLE_M)
        fit = self.evaluated(fit, MIDDLE_M)
        rows = np.arange(len(self.model))
        slopes, before = np.empty(0), fit
        for turn in range(rounds):
            if turn % 2:
                slopes = self._followed(slopes, before, fit)
            else:
                side = (1.0, -1.0)[turn // 2 % 2]
                slopes = self.derivatives(fit, 0.1 if turn else 0.3, (side,), shared=False)
            system = self.system(fit, slopes, variance)
            steps = system.own_steps(STEPS.dampings)
            trials = fit.each + np.concatenate([0.0 * steps[:1], STEPS.short * steps[:1], steps])
            each = np.clip(trials, -STEPS.farthest_sd, STEPS.farthest_sd) * self.mask
            which = np.tile(rows, len(each))
            amounts = self.layout.amounts(fit.unit, each.reshape(-1, each.shape[2]))
            x, done = self.model.positions(which, amounts, fit.cause, fit.size)
            per_shift = self._misfit(x, done, which, variance).reshape(len(each), -1)
            best = np.argmin(per_shift + _own_cost(each, fit.spread), axis=0)
            before = fit
            fit = replace(
                fit,
                each=each[best, rows],
                position_m=x.reshape(*per_shift.shape, -1)[best, rows],
                per_shift=per_shift[best, rows],
            )
        return fit

    def with_scales(self, fit: Fit) -> Fit:
        """Return a fit with the scales of its loads (EM) and of the noise (likelihood)."""
        assert fit.position_m is not None
        system = self.system(
            fit, self.derivatives(fit, 0.1, (1.0,)), self._variance_of(fit, FINE_M)
        )
        variance = np.einsum("kii->ki", np.linalg.inv(system.own))
        spread = fit.spread.copy()
        for column in np.flatnonzero(self.layout.is_load):
            # a shift that says nothing of a load says nothing of how much it differs
            is_known = variance[:, column] < STEPS.informed * spread[column] ** 2
            rows = self.mask[:, column] & is_known
            if rows.sum() >= 2:
                square = fit.each[rows, column] ** 2 + variance[rows, column]
                spread[column] = np.clip(np.sqrt(square.mean()), *PRIORS.spreads)
        fit = replace(fit, spread=spread, noise_factor=self.factor_of(fit.position_m))
        return self.evaluated(fit, FINE_M)

    def finished(self, fit: Fit, rng: Rng, times: int = 3, fixed: bool = False) -> Fit:
        """Return a fit of the last stage, with its scales and evidence."""
        for _ in range(times - 1):
            fit = self.freed(self.with_scales(fit), rng)
            fit = self.improved(self.rescanned(fit, FINE_M, rng), FINE_M, 8, fixed=fixed)
        fit = self.improved(self.with_scales(fit), FINE_M, 8, fixed=fixed, followed=0)
        return self.with_evidence(fit)

    def with_evidence(self, fit: Fit) -> Fit:
        """Return a fit with its log evidence (Laplace) and the standard deviations of its quantities."""
        fit = self.evaluated(fit, FINE_M)
        slopes = self.slopes(fit)
        variance = self._variance_of(fit, FINE_M)
        system = self.system(fit, slopes, variance, expected=True)
        sd = np.sqrt(np.diag(np.linalg.inv(system.marginal)))
        norm = self._volume_cost(fit, slopes if self.reference is None else self.reference)
        size_sd = 0.0
        if fit.cause is not None:
            size_sd = float(sd[-1])
            norm += float(np.log(PRIORS.size_sd / size_sd)) - (
                np.log(2.0) if fit.cause.sign else 0.0
            )
        evidence = -(fit.cost + norm)
        return replace(fit, evidence=evidence, size_sd=size_sd, unit_sd=sd[: len(self.layout)])

    def slopes(self, fit: Fit) -> Floats:
        """Return the derivatives [shifts, pulses, quantities + 1] of which evidence is computed, in m."""
        return np.clip(self.derivatives(fit, 0.3, (1.0, -1.0)), -STEPS.steepest_m, STEPS.steepest_m)

    def profile(self, fit: Fit) -> tuple[float, float]:
        """Return the 95 % interval of the size: where the cost, refitted at other sizes, has risen by 2."""
        assert fit.cause is not None
        ends = []
        for sign in (-1.0, 1.0):
            step = max(fit.size_sd, 1e-3 * abs(fit.size), 1e-3)
            moved, last = fit, (fit.size, 0.0)
            for doubling in range(9):
                size = fit.cause.clipped(fit.size + sign * step * 2.0**doubling)
                if fit.size * size < 0.0:
                    size = 0.0
                moved = replace(moved, size=size)
                moved = self.improved(moved, FINE_M, 6, least=0.1, fixed=True, followed=0)
                rise = moved.cost - fit.cost - float(_size_cost(size) - _size_cost(fit.size))
                if rise > 2.0:
                    share = (2.0 - last[1]) / max(rise - last[1], 1e-9)
                    last = (last[0] + (size - last[0]) * share, 2.0)
                    break
                last = (size, max(rise, 0.0))
                if size in (0.0, *fit.cause.bounds):
                    break
            ends.append(last[0])
        return min(ends), max(ends)


def _tail_cost(unit: Floats) -> Floats:
    """Return the cost of quantities of a truck [...] by Student's t."""
    return np.asarray(0.5 * (PRIORS.unit_tail + 1.0) * np.log1p(unit**2 / PRIORS.unit_tail))


def _size_cost(size: Floats | float) -> Floats:
    """Return the cost of a cause's size [...] by Student's t."""
    ratio = (np.asarray(size) / PRIORS.size_sd) ** 2 / PRIORS.size_tail
    return np.asarray(0.5 * (PRIORS.size_tail + 1.0) * np.log1p(ratio))


def _own_cost(each: Floats, spread: Floats) -> Floats:
    """Return the cost [...] of shifts' quantities [..., differing] at their spread."""
    return np.asarray(0.5 * ((each / spread) ** 2).sum(axis=-1))

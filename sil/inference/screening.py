"""Which further effects could explain what a fit leaves: a score test, linear in everything.

The change c that a candidate makes to the prediction is freed of what the fitted parameters could
imitate; the gain in cost of the best amount of it is (c'r)^2 / 2 c'c: one simulated stroke each.

Source: Rao's score test; see Cox and Hinkley, Theoretical Statistics.
Checked by: tests/unit/sil/inference/test_fit.py
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import copysign, inf, sqrt
from typing import Any

import numpy as np

from plant.errors import IntegrationError
from sil.inference.candidate import Candidate
from sil.inference.fit import FARTHEST_SD, FitResult, Fitter, arrow, shown
from sil.inference.problem import Floats, Problem
from sil.inference.workers import spread_out


@dataclass(frozen=True)
class Score:
    """What a candidate would gain on top of a fit, by the linear estimate.

    gain: in cost; amount: in multiples of the start tried; square: squared standardised change by that
    start, freed of what the fit could imitate; free: its share of the whole change.
    """

    candidate: Candidate
    start: tuple[float, ...]
    gain: float
    amount: float
    square: float
    free: float

    def smallest(self, gain: float) -> float | None:
        """Return the value of the main parameter that would gain so much; None if out of its bounds."""
        main = self.candidate.parameters[0]
        if self.free <= 0.0:
            return None
        value = main.neutral + (2.0 * gain / self.square) ** 0.5 * (self.start[0] - main.neutral)
        return value if main.low <= value <= main.high else None


@dataclass(frozen=True)
class DetectableSize:
    """The smallest value of a cause's main parameter that would have been claimed, beside those of its others."""

    candidate: Candidate
    value: float
    others: dict[str, float]

    @property
    def typical_sizes(self) -> float:
        """Difference to neutral in typical sizes."""
        main = self.candidate.parameters[0]
        return abs(self.value - main.neutral) / main.typical

    def as_json(self) -> dict[str, Any]:
        """Return the object in `detectable` of diagnosis.json."""
        main = self.candidate.parameters[0]
        return {
            "id": self.candidate.id,
            "parameter": main.name,
            "size": abs(self.value - main.neutral),
            "unit": main.unit,
            "value": self.value,
            "neutral": main.neutral,
            "typical_sizes": self.typical_sizes,
            "form": self.candidate.variant,
            "others": self.others,
        }


def detectable(
    fitter: Fitter, fit: FitResult, scores: Sequence[Score], gain: float, workers: int
) -> list[DetectableSize]:
    """Return the smallest size of each cause that would gain so much in the blocks of a fit.

    Each cause in the form in which that is least. One that is missing would not have been noticed
    within its physical bounds.
    """
    if not scores:
        return []
    sizes: dict[str, DetectableSize] = {}
    screening = Screening(fitter, fit)
    values = spread_out(lambda score: screening.smallest(score, gain), scores, workers)
    for score, value in zip(scores, values, strict=True):
        if value is None:
            continue
        names = [parameter.name for parameter in score.candidate.parameters[1:]]
        item = DetectableSize(
            score.candidate, value, dict(zip(names, score.start[1:], strict=True))
        )
        least = sizes.setdefault(score.candidate.id, item)
        sizes[score.candidate.id] = min(least, item, key=lambda size: size.typical_sizes)
    return list(sizes.values())


def change_of(
    model: Problem, fit: FitResult, candidate: Candidate, start: tuple[float, ...]
) -> dict[int, Floats]:
    """Return by stroke what the candidate at `start` changes in the standardised prediction [n]; raises IntegrationError."""
    changes = {}
    parameters = {p.name: v for p, v in zip(candidate.parameters, start, strict=True)}
    for k, block in fit.blocks.items():
        both, values = (*fit.candidates, candidate), (*fit.values, parameters)
        try:
            changes[k] = model.changed(k, fit.shared, fit.stroke[k], both, values) - block.base
        except IntegrationError as error:
            where = f"{shown((candidate,), (parameters,))}{model.name_of(k)}"
            raise IntegrationError(f"{where}: {error}") from None
    return changes


class Screening:
    """Scores of candidates on top of one fit."""

    def __init__(self, fitter: Fitter, fit: FitResult) -> None:
        self.fitter, self.fit = fitter, fit
        normal, self._gradient, self._inner = arrow(fit.blocks, fit.stroke, fit.shared, fit.layout)
        # what is at its bound and presses outward imitates nothing
        outward = self._gradient * fit.shared > 0.0
        healthy = np.arange(len(normal)) < fit.layout.healthy
        moving = ~(healthy & outward & (np.abs(fit.shared) >= FARTHEST_SD - 1e-9))
        self._solved = np.zeros_like(normal)
        self._solved[np.ix_(moving, moving)] = np.linalg.pinv(normal[np.ix_(moving, moving)])

    def score(self, candidate: Candidate, start: tuple[float, ...]) -> Score | None:
        """Return what a candidate would gain by a start; None, which the fitter counts, if that cannot be simulated."""
        fit, refusals = self.fit, self.fitter.refusals
        try:
            changes = change_of(self.fitter.model, fit, candidate, start)
        except IntegrationError as error:
            refusals.add((*fit.candidates, candidate), error)
            return None
        refusals.add((*fit.candidates, candidate), None)
        slope = square = 0.0
        cross = np.zeros_like(self._gradient)
        for k, c in changes.items():
            block, (inverse, hus, gs) = fit.blocks[k], self._inner[k]
            at_bound = (np.abs(fit.stroke[k]) >= FARTHEST_SD) & (gs == 0.0)
            bc = np.where(at_bound, 0.0, block.scatter.T @ c)
            slope += float(c @ block.residual) - float(bc @ inverse @ gs)
            square += float(c @ c) - float(bc @ inverse @ bc)
            cross += block.shared.T @ c - hus @ (inverse @ bc)
        slope -= float(cross @ self._solved @ self._gradient)
        square -= float(cross @ self._solved @ cross)
        free = square / max(1.0, float(sum(c @ c for c in changes.values())))
        if free <= 1e-9:
            return Score(candidate, start, 0.0, 0.0, 0.0, 0.0)
        amount = slope / square
        either = candidate.parameters[0].sign == 0
        gain = 0.5 * slope * amount if amount > 0.0 or either else 0.0
        return Score(candidate, start, gain, amount, square, free)

    def remaining(self, candidate: Candidate, start: tuple[float, ...]) -> float | None:
        """Return the squared change, priors included, that remains once all fitted quantities have followed it.

        In standard deviations; two Gauss-Newton steps, since edges that move in time are not linear. None
        if it cannot be simulated.
        """
        fit, model = self.fit, self.fitter.model
        healthy, units = fit.layout.healthy, len(model.unit)
        own = {p.name: v for p, v in zip(candidate.parameters, start, strict=True)}
        shared, scatter = np.zeros_like(fit.shared), np.zeros_like(fit.stroke)
        for last in (False, False, True):
            values = model.effect_values(fit.candidates, (fit.shared - shared)[healthy:])
            both, tables = (*fit.candidates, candidate), (*values, own)
            rest: dict[int, Floats] = {}
            try:
                for k, block in fit.blocks.items():
                    there = model.changed(
                        k, fit.shared - shared, fit.stroke[k] - scatter[k], both, tables
                    )
                    offsets = block.shared[:, units:healthy] @ shared[units:healthy]
                    rest[k] = there - block.base - offsets
            except IntegrationError:
                return None
            if last:
                break
            cross = -fit.layout.prior @ shared
            pulls = {}
            for k, c in rest.items():
                block, (inverse, hus, _gs) = fit.blocks[k], self._inner[k]
                pulls[k] = block.scatter.T @ c - scatter[k]
                cross += block.shared.T @ c - hus @ (inverse @ pulls[k])
            step = self._solved @ cross
            shared += step
            shared[:healthy] = np.clip(shared[:healthy], -FARTHEST_SD, FARTHEST_SD)
            for k, pull in pulls.items():
                inverse, hus, _gs = self._inner[k]
                moved = scatter[k] + inverse @ (pull - hus.T @ step)
                scatter[k] = np.clip(moved, -FARTHEST_SD, FARTHEST_SD)
        squares = sum(float(c @ c) for c in rest.values()) + float(np.sum(scatter**2))
        return squares + float(shared @ fit.layout.prior @ shared)

    def smallest(self, score: Score, gain: float) -> float | None:
        """Return the value of the main parameter that would gain so much, tried itself; None if out of its bounds.

        Where both signs are physical, that of the less noticeable one is returned.
        """
        first, main = score.smallest(gain), score.candidate.parameters[0]
        if first is None:
            return None
        by = first - main.neutral
        sides = (by, -by) if main.sign == 0 else (by,)
        sizes = [self._smallest(score, gain, side) for side in sides]
        return None if None in sizes else max(sizes, key=lambda v: abs((v or 0.0) - main.neutral))

    def _smallest(self, score: Score, gain: float, first: float) -> float | None:
        """Return the value that would gain so much on one side, from a first difference to neutral."""
        main, others = score.candidate.parameters[0], score.start[1:]
        too_small, enough, by = 0.0, inf, abs(first)
        for k in range(12):
            value = main.neutral + copysign(by, first)
            if not main.low <= value <= main.high:
                return None
            square = self.remaining(score.candidate, (value, *others))
            if not square:
                return None
            ratio = min(max(sqrt(2.0 * gain / square), 0.1), 10.0)
            if abs(ratio - 1.0) <= 0.15:
                return value
            too_small, enough = (by, enough) if ratio > 1.0 else (too_small, by)
            by *= ratio
            if (k % 2 or not too_small < by < enough) and 0.0 < too_small < enough < inf:
                by = sqrt(too_small * enough)
        # of two values that stay apart, the one that would be noticed, if that is a matter of this size
        is_between = 0.0 < too_small < enough < inf
        return main.neutral + copysign(enough, first) if is_between else None


def screen(fitter: Fitter, fit: FitResult, candidates: Sequence[Candidate]) -> list[Score]:
    """Score of every candidate on top of a fit, by its best start, largest gain first."""
    screening = Screening(fitter, fit)
    best = []
    for candidate in candidates:
        starts = [screening.score(candidate, start) for start in candidate.starts[::2]]
        scores = [score for score in starts if score is not None]
        # a start without a free change counts only where no other does
        best += [max(scores, key=lambda score: (score.free > 0.0, score.gain))] if scores else []
    return sorted(best, key=lambda score: -score.gain)

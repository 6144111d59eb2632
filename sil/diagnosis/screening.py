"""Which further effects could explain what a fit leaves: a score test, linear in everything.

At a fitted hypothesis, the change c that a candidate makes to the prediction is freed of what the
fitted parameters could imitate; the gain in cost of the best amount of it is (c'r)^2 / 2 c'c.
No further fit is needed: one simulated stroke each.

Source: Rao's score test; see Cox and Hinkley, Theoretical Statistics.
Checked by: tests/unit/sil/fitting/test_fit.py
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from plant.errors import IntegrationError
from sil.campaign.campaign import Floats
from sil.fitting.arrow import FARTHEST_SD, arrow
from sil.fitting.fit import FitResult, Fitter
from sil.fitting.hypotheses import Candidate
from sil.fitting.model import CampaignModel
from sil.fitting.refused import shown


@dataclass(frozen=True)
class Score:
    """What a candidate would gain on top of a fit, by the linear estimate.

    gain: in cost (half chi squared); amount: in multiples of the start tried; start: that start;
    square: squared standardised change by that start, freed of what the fit could imitate; free:
    its share of the whole change.
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


def change_of(
    model: CampaignModel, fit: FitResult, candidate: Candidate, start: tuple[float, ...]
) -> dict[int, Floats]:
    """Return by stroke what the candidate at `start` changes in the standardised prediction [n].

    Raises IntegrationError if one of them cannot be simulated.
    """
    changes = {}
    own = {p.name: v for p, v in zip(candidate.parameters, start, strict=True)}
    for k, block in fit.blocks.items():
        amounts = model.amounts(fit.shared, fit.stroke[k])
        setup = model.setup(k, amounts, (*fit.candidates, candidate), (*fit.values, own))
        try:
            changes[k] = model.predict(k, setup) - block.base
        except IntegrationError as error:
            where = f"{shown((candidate,), (own,))}{model.strokes[k].entry.file}"
            raise IntegrationError(f"{where}: {error}") from None
    return changes


def screen(fitter: Fitter, fit: FitResult, candidates: Sequence[Candidate]) -> list[Score]:
    """Score of every candidate on top of a fit, largest gain first.

    A start that cannot be simulated scores nothing; the fitter's refusals count it.
    """
    model = fitter.model
    blocks = fit.blocks
    normal, gradient, inner = arrow(blocks, fit.stroke, fit.shared, fit.layout)
    # what is at its bound and presses outward imitates nothing
    outward = gradient * fit.shared > 0.0
    healthy = np.arange(len(normal)) < fit.layout.healthy
    moving = ~(healthy & outward & (np.abs(fit.shared) >= FARTHEST_SD - 1e-9))
    solved = np.zeros_like(normal)
    solved[np.ix_(moving, moving)] = np.linalg.pinv(normal[np.ix_(moving, moving)])
    found = []
    for candidate in candidates:
        best: Score | None = None
        for start in candidate.starts[::2]:
            try:
                changes = change_of(model, fit, candidate, start)
            except IntegrationError as error:
                fitter.refusals.add((*fit.candidates, candidate), error)
                continue
            fitter.refusals.add((*fit.candidates, candidate), None)
            slope = square = 0.0
            cross = np.zeros(len(normal))
            for k, c in changes.items():
                block, (inverse, hus, gs) = blocks[k], inner[k]
                held = (np.abs(fit.stroke[k]) >= FARTHEST_SD) & (gs == 0.0)
                bc = np.where(held, 0.0, block.scatter.T @ c)
                slope += float(c @ block.residual) - float(bc @ inverse @ gs)
                square += float(c @ c) - float(bc @ inverse @ bc)
                cross += block.shared.T @ c - hus @ (inverse @ bc)
            slope -= float(cross @ solved @ gradient)
            square -= float(cross @ solved @ cross)
            free = square / max(1.0, float(sum(c @ c for c in changes.values())))
            if free <= 1e-9:
                best = best or Score(candidate, start, 0.0, 0.0, 0.0, 0.0)
                continue
            amount = slope / square
            either = candidate.parameters[0].sign == 0
            gain = 0.5 * slope * amount if amount > 0.0 or either else 0.0
            if best is None or gain > best.gain or best.free == 0.0:
                best = Score(candidate, start, gain, amount, square, free)
        if best is not None:
            found.append(best)
    return sorted(found, key=lambda score: -score.gain)

"""What the held-out strokes say about hypotheses, and how probable each is then.

A hypothesis is scored by its evidence on the training strokes (Laplace) plus its cost on the
held-out ones, where only the strokes' own scatter may be fitted.  As long as the best of them
leaves a misfit that noise does not explain, score differences overstate what is known: then the
model error has an unknown size, and marginalising over that turns the exponential into a power,

    p_i ~ prior_i (1 + 2 (score_i - floor) / nu)^(-nu / 2),

Student's form with nu effective observations; it is exp(-score) again once the misfit is nil.
Checked by: tests/unit/sil/diagnosis/test_judge.py
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from plant.errors import IntegrationError
from sil.diagnosis.workers import spread_out
from sil.fitting.fit import FitResult, Fitter
from sil.fitting.floor import Misfit, misfit

Floats = NDArray[np.float64]

EFFECTIVE = 10.0
"""Effective observations nu of the model error."""

PAIR_PRIOR = 0.1
"""Prior odds of two causes at once against one."""


@dataclass
class Judged:
    """A hypothesis judged by all strokes.

    training, held: fits; score: evidence/2 on the training plus cost on the held-out strokes;
    misfit: over the held-out strokes (over the training ones if none are held out).
    """

    training: FitResult
    held: FitResult | None
    score: float
    misfit: Misfit
    whole: Misfit
    probability: float = 0.0

    @property
    def name(self) -> str:
        """Name of the hypothesis."""
        return self.training.name

    @property
    def ids(self) -> tuple[str, ...]:
        """Identifiers of its causes."""
        return tuple(item.id for item in self.training.candidates)

    @property
    def prior(self) -> float:
        """Prior weight."""
        return PAIR_PRIOR if len(self.ids) > 1 else 1.0


def judge(
    fitter: Fitter, fits: Sequence[FitResult], held_out: Sequence[int], workers: int = 1
) -> list[Judged]:
    """Held-out evaluation of fits, best score first."""
    model = fitter.model
    unseen = _unseen_offsets(fitter, held_out)

    def work(fit: FitResult) -> FitResult | None:
        frozen = [k for k in range(len(fit.shared)) if k not in unseen]
        try:
            return fitter.fit(
                fit.candidates, start=fit.shared, use=held_out, iterations=4, freeze=frozen
            ).light()
        except IntegrationError:
            return None

    found = []
    answers = spread_out(work, fits, workers) if held_out else [None] * len(fits)
    for fit, held in zip(fits, answers, strict=True):
        if held_out and held is None:
            continue
        cost = 0.5 * fit.evidence()
        whole = fit
        if held is not None:
            # the priors of the shared parameters are counted once, with the training strokes
            cost += 0.5 * held.chi2
            blocks = {**fit.blocks, **held.blocks}
            stroke = fit.stroke.copy()
            stroke[list(held_out)] = held.stroke[list(held_out)]
            whole = replace(fit, use=tuple(sorted(blocks)), stroke=stroke, blocks=blocks)
        found.append(Judged(fit, held, cost, misfit(model, held or fit), misfit(model, whole)))
    found.sort(key=lambda item: item.score)
    weigh(found)
    return found


def _unseen_offsets(fitter: Fitter, held_out: Sequence[int]) -> set[int]:
    """Return the indices of offsets of gauges that no training stroke has: held-out ones determine them."""
    model = fitter.model
    strokes = set(range(len(model.strokes))) - set(held_out)
    trained = {channel.name for k in strokes for channel in model.strokes[k].channels}
    first = len(model.unit)
    return {first + j for j, name in enumerate(model.offsets) if name not in trained}


def weigh(judged: Sequence[Judged]) -> None:
    """Fill in the probabilities of competing hypotheses."""
    if not judged:
        return
    leader = min(judged, key=lambda item: item.score)
    error = 0.5 * leader.whole.beyond
    nu = EFFECTIVE
    logs = np.array(
        [
            np.log(item.prior) - 0.5 * nu * np.log1p(2.0 * (item.score - leader.score + error) / nu)
            for item in judged
        ]
    )
    weights = np.exp(logs - logs.max())
    weights /= weights.sum()
    for item, weight in zip(judged, weights, strict=True):
        item.probability = float(weight)


def by_cause(judged: Sequence[Judged]) -> dict[str, float]:
    """Probability of each cause: of all hypotheses it takes part in."""
    total: dict[str, float] = {}
    for item in judged:
        for name in item.ids:
            total[name] = total.get(name, 0.0) + item.probability
    return dict(sorted(total.items(), key=lambda entry: -entry[1]))

"""A fit continued by samples where slopes lead no further.

Checked by: tests/unit/sil/shift_diagnosis/test_polish.py
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Final

import numpy as np

from sil.shift_diagnosis.evolution import evolved
from sil.shift_diagnosis.fit import FARTHEST, Fit, Fitter
from sil.shift_diagnosis.linear import Floats
from sil.shift_diagnosis.model import Cause
from sil.shift_diagnosis.search import Run, final_fit
from sil.shift_diagnosis.verdict import Judged

CONTINUED: Final = 6
"""Causes, the best ones, whose fits are continued."""
HOPELESS: Final = 50.0
"""Log evidence behind the best one from which a fit is not continued."""
GENERATIONS: Final = 40


def continued(whole: Fitter, judged: Sequence[Judged], run: Run) -> list[Judged]:
    """Return the hypotheses, the fits of the healthy truck and of the best causes continued."""
    least = min(item.cost for item in judged)
    ranked = sorted(judged, key=lambda item: item.cost)
    close = [i for i in ranked if i.fit.cause is not None and i.cost < least + HOPELESS]
    chosen = [*(i for i in judged if i.fit.cause is None), *close[:CONTINUED]]
    fits = run(partial(continued_fit, whole), [(i.fit.cause, i.fit.point) for i in chosen])
    found = {item.fit.cause: item for item in judged}
    for item in map(Judged.of, fits):
        if item.cost < found[item.fit.cause].cost:
            found[item.fit.cause] = item
    return list(found.values())


def continued_fit(whole: Fitter, cause: Cause | None, at: Floats) -> Fit:
    """Return a hypothesis fitted from the best point found around where a fit to all shifts ended.

    at: [units, or units + 1 with a cause's size], prior deviations and typical sizes.
    """
    fit, units = whole.at(cause, at), len(whole.names)

    def costs(points: list[Floats]) -> Floats:
        for point in points:
            np.clip(point[:units], -FARTHEST, FARTHEST, out=point[:units])
        return whole.costs(cause, points, fit.linear)[0]

    start = fit.values if cause is None else fit.point
    return final_fit(whole, cause, evolved(costs, start.copy(), fit.covariance, GENERATIONS))

"""A cause challenged before it is named: by other causes from many starts, and by its own restarts.

The residual of a log has many minima. What ends in a better one is not by that the truer cause: the
evidence between causes is known no better than restarts of one of them agree.
Checked by: tests/unit/sil/shift_diagnosis/test_challenge.py
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Final

import numpy as np

from sil.shift_diagnosis.fit import COARSE_M, Fitter
from sil.shift_diagnosis.linear import Floats
from sil.shift_diagnosis.model import Cause
from sil.shift_diagnosis.search import Run, final_fit, healthy_again
from sil.shift_diagnosis.starts import starts_around
from sil.shift_diagnosis.verdict import CERTAIN, Judged, weighed

CHALLENGERS: Final = 8
"""Other effects, those whose sizes come nearest to the shifts, that are fitted once more."""
STARTS: Final = 2
"""Starts of each of them."""
RESTARTS: Final = 6
"""Starts of the cause that is to be named."""


def to_be_named(judged: Sequence[Judged]) -> str:
    """Return the id of the effect that would be named, of hypotheses with probabilities; "" if none."""
    total: dict[str, float] = {}
    for item in judged:
        if item.fit.cause is not None:
            total[item.id] = total.get(item.id, 0.0) + item.probability
    top = max(total, key=lambda name: total[name], default="")
    return top if top and total[top] >= CERTAIN else ""


def challenged(
    whole: Fitter, judged: Sequence[Judged], causes: Sequence[Cause], ids: int, run: Run
) -> tuple[list[Judged], float]:
    """Return the hypotheses after every cause that would be named was challenged, and `apart`.

    apart: log evidence by which restarts of such a cause end behind its best fit; 0 if none was.
    ids: how many effects are offered.
    """
    items, done, apart = list(judged), set[str](), 0.0
    while (name := to_be_named(items)) and name not in done:
        done.add(name)
        items, own = more_starts(whole, items, causes, name, run)
        apart = max(apart, own)
        items = weighed(healthy_again(whole, weighed(items, ids, apart)), ids, apart)
    return items, apart


def more_starts(
    whole: Fitter, judged: Sequence[Judged], causes: Sequence[Cause], name: str, run: Run
) -> tuple[list[Judged], float]:
    """Return the hypotheses with what more starts found, and how far restarts of one end apart.

    name: id of its effect. The second is log evidence: the median of its restarts behind its best
    fit. Starts are sizes tried in the healthy truck and in that cause's.
    """
    found = {item.fit.cause: item for item in judged}
    trucks = [next(item for item in judged if item.id == own).fit for own in ("healthy", name)]
    starts: dict[str, list[tuple[float, Cause, Floats]]] = {}
    for truck in trucks:
        around = starts_around(whole, causes, COARSE_M[0], truck.values)
        for cause, tried in around.items():
            starts.setdefault(cause.effect.id, []).extend((c, cause, at) for c, at in tried)
    for tried_of_id in starts.values():
        tried_of_id.sort(key=lambda item: item[0])
    nearest = sorted(starts, key=lambda other: starts[other][0][0])
    others = [other for other in nearest if other != name][:CHALLENGERS]
    chosen = starts[name][:RESTARTS] + [item for other in others for item in starts[other][:STARTS]]
    ends = map(Judged.of, run(partial(final_fit, whole), [(c, at) for _cost, c, at in chosen]))
    costs = []
    for item in ends:
        if item.id == name:
            costs.append(item.cost)
        if item.fit.cause not in found or item.cost < found[item.fit.cause].cost:
            found[item.fit.cause] = item
    least = min(item.cost for item in found.values() if item.id == name)
    return list(found.values()), float(np.median(costs)) - least

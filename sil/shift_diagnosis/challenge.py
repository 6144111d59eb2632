"""A cause challenged before it is named: by other causes from many starts, and by what theory says.

The residual of a log has many minima. What ends in a better one is not by that the truer cause.
Checked by: tests/unit/sil/shift_diagnosis/test_challenge.py
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Final

from sil.shift_diagnosis.fit import COARSE_M, Fitter
from sil.shift_diagnosis.linear import Floats
from sil.shift_diagnosis.model import Cause
from sil.shift_diagnosis.polish import continued
from sil.shift_diagnosis.search import NEARLY, Run, final_fit, healthy_again
from sil.shift_diagnosis.starts import starts_around
from sil.shift_diagnosis.verdict import CERTAIN, Detectable, Judged, weighed

CHALLENGERS: Final = 8
"""Other effects, those whose sizes come nearest to the shifts, that are fitted once more."""
STARTS: Final = 3
"""Starts of each of them, and of the cause that is to be named."""


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
) -> list[Judged]:
    """Return the hypotheses after every cause that would be named was challenged.

    ids: how many effects are offered.
    """
    items, done = list(judged), set[str]()
    while (name := to_be_named(items)) and name not in done:
        done.add(name)
        items = continued(whole, more_starts(whole, items, causes, name, run), run)
        items = weighed(healthy_again(whole, weighed(items, ids)), ids)
    return items


def more_starts(
    whole: Fitter, judged: Sequence[Judged], causes: Sequence[Cause], name: str, run: Run
) -> list[Judged]:
    """Return the hypotheses with better fits of the effect to be named and of those next to it.

    name: its id. Starts are sizes tried in the healthy truck and in that effect's.
    """
    trucks = [next(item for item in judged if item.id == own).fit for own in ("healthy", name)]
    starts: dict[str, list[tuple[float, Cause, Floats]]] = {}
    for truck in trucks:
        around = starts_around(whole, causes, COARSE_M[0], truck.values)
        for cause, tried in around.items():
            starts.setdefault(cause.effect.id, []).extend((c, cause, at) for c, at in tried)
    for of_id in starts.values():
        of_id.sort(key=lambda item: item[0])
    nearest = sorted(starts, key=lambda other: starts[other][0][0])
    chosen = [name, *[other for other in nearest if other != name][:CHALLENGERS]]
    items = [(cause, at) for other in chosen for _cost, cause, at in starts[other][:STARTS]]
    found = {item.fit.cause: item for item in judged}
    for item in map(Judged.of, run(partial(final_fit, whole), items)):
        if item.cost < found.setdefault(item.fit.cause, item).cost:
            found[item.fit.cause] = item
    return list(found.values())


def alike_by_theory(judged: Sequence[Judged], detectable: Sequence[Detectable]) -> dict[str, float]:
    """Return the effects that look like the one to be named, and how far they are behind it.

    That is log evidence, which then decides nothing: by the information of the shifts the two cannot
    be distinguished, and the other one explains these shifts nearly as well.
    """
    name = to_be_named(judged)
    own = {other for item in detectable if item.cause.effect.id == name for other in item.alike}
    own |= {item.cause.effect.id for item in detectable if name in item.alike}
    named = [item for item in judged if item.id == name]
    found: dict[str, float] = {}
    for item in judged if named else ():
        behind = item.cost - min(each.cost for each in named)
        if item.id in own and item.chi2 < min(each.chi2 for each in named) + NEARLY:
            found[item.id] = min(behind, found.get(item.id, behind))
    return found

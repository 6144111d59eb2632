"""Search over hypotheses: where the variants of a cause begin."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from sil.diagnosis import search
from sil.diagnosis.search import Fits, Search, Task
from sil.fitting.hypotheses import candidates


def test_a_pair_is_one_hypothesis_in_either_order() -> None:
    fits = Fits()
    for cost, name in ((3.0, "a+b"), (2.0, "b+a"), (4.0, "a+b"), (5.0, "a")):
        causes = tuple(SimpleNamespace(name=part) for part in name.split("+"))
        fits.add(SimpleNamespace(name=name, cost=cost, candidates=causes))
    assert {name: fit.cost for name, fit in fits.items()} == {"b+a": 2.0, "a": 5.0}


@pytest.mark.parametrize(
    ("fitted", "other", "start"),
    [("clock_skew:offset alone", "clock_skew", (0.01, 0.0)), ("clock_skew", "", (0.01,))],
)
def test_a_variant_begins_where_the_parameters_are_that_it_shares(
    monkeypatch: pytest.MonkeyPatch, fitted: str, other: str, start: tuple[float, ...]
) -> None:
    known = {item.name: item for item in candidates({"internal position"})}
    best = known[fitted]
    values = dict(zip([p.name for p in best.parameters], (0.01, 0.002), strict=False))
    fit = SimpleNamespace(
        name=fitted,
        candidates=(best,),
        values=(values,),
        point=(tuple(values.values()),),
        shared=None,
        stroke=None,
        evidence=lambda: 1.0,
    )
    found: list[Task] = []
    made = Search.__new__(Search)
    made.model, made.fits, made.candidates = None, Fits({fitted: fit}), list(known.values())
    monkeypatch.setattr(search, "misfit", lambda *_: SimpleNamespace(beyond=1.0))
    monkeypatch.setattr(made, "run_tasks", lambda tasks: found.extend(tasks) or [])
    monkeypatch.setattr(made, "polish", lambda fits: None)
    made.variants()
    (task,) = found
    assert task.candidates[0].name == (other or "clock_skew:offset alone")
    assert task.starts == ((start,),)

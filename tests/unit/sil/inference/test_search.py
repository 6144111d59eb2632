"""Search over hypotheses: where the variants of a cause begin."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from sil.inference.candidate import candidates
from sil.inference.search import Fits, Search, Task


def test_a_pair_is_one_hypothesis_in_either_order() -> None:
    fits = Fits()
    for cost, name in ((3.0, "a+b"), (2.0, "b+a"), (4.0, "a+b"), (5.0, "a")):
        causes = tuple(SimpleNamespace(name=part) for part in name.split("+"))
        fits.add(SimpleNamespace(name=name, cost=cost, candidates=causes))
    assert {name: fit.cost for name, fit in fits.items()} == {"b+a": 2.0, "a": 5.0}


def tried(
    monkeypatch: pytest.MonkeyPatch, names: str, *values: dict[str, float]
) -> dict[str, tuple[tuple[tuple[float, ...], ...], ...]]:
    """Return the starts of all hypotheses that are tried as variants of one, by name."""
    known = {item.name: item for item in candidates({"internal position"})}
    fit = SimpleNamespace(
        name=names,
        candidates=tuple(known[name] for name in names.split("+")),
        values=values,
        point=tuple(tuple(own.values()) for own in values),
        shared=None,
        stroke=None,
    )
    found: list[Task] = []
    made = Search.__new__(Search)
    made.candidates, made.varied = list(known.values()), set()
    monkeypatch.setattr(made, "run_tasks", lambda tasks: found.extend(tasks) or [])
    monkeypatch.setattr(made, "polish", lambda fits: None)
    assert made.try_variants(fit) and not made.try_variants(fit)
    return {"+".join(item.name for item in task.candidates): task.starts for task in found}


@pytest.mark.parametrize(
    ("name", "other", "start"),
    [("clock_skew:offset alone", "clock_skew", (0.01, 0.0)), ("clock_skew", "", (0.01,))],
)
def test_a_variant_begins_where_the_parameters_are_that_it_shares(
    monkeypatch: pytest.MonkeyPatch, name: str, other: str, start: tuple[float, ...]
) -> None:
    found = tried(monkeypatch, name, {"offset_s": 0.01} | ({} if other else {"drift": 0.002}))
    assert found == {other or "clock_skew:offset alone": ((start,),)}


def test_the_causes_of_a_pair_are_replaced_by_others_of_their_class(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    pair = "inlet_clog+valve_delay_pressure:from atmosphere"
    found = tried(monkeypatch, pair, {"factor": 0.7}, {"slope_s_pa": 4e-9})
    assert {name.partition(":")[0] for name in found} == {
        "exhaust_clog+valve_delay_pressure",
        "back_pressure+valve_delay_pressure",
        *(f"inlet_clog+{name}" for name in ("valve_delay_pressure", "valve_open_delay")),
        *(f"inlet_clog+{name}" for name in ("valve_creep", "valve_slow_close")),
    }
    starts = found["inlet_clog+valve_open_delay"]
    assert len(starts) > 1 and all(one == (0.7,) for one, _two in starts)

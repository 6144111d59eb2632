"""Rows that are bounds: the softest stop found for a family of loads at an information delay.

A row sets `bound.family`, `bound.delay_s` and if wanted `bound.extra_s`, `bound.valves`,
`bound.simulations`, `bound.hunts` and `bound.moves` (the share of the simulations that goes to passes
and moves after the hunts) of each search, and `bound.known`, the share to which the impulse is known before the
stroke; all other settings change the model. `sil.studies.bound_search` searches, twice, with moves
`sil.studies.bound_moves`.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace

import numpy as np

from can_dbc.errors import InputError
from plant.parameters import ParameterSet, load
from sil.studies.bound_figures import PARTS, figures
from sil.studies.bound_moves import MovingSearch
from sil.studies.bound_search import HUNTS, Search, arrivals_of, stem_switches
from sil.studies.policies import (
    FAMILIES,
    GEARBOX,
    Arrivals,
    Family,
    FamilyModel,
    Floats,
)
from sil.studies.rows import RowResult
from sil.studies.study import BoundsTable, LoadedStudy, Row, Setting

__all__ = ["COLUMNS", "columns", "figures", "run"]

SETTINGS = ("family", "delay_s", "extra_s", "valves", "simulations", "hunts", "moves", "known")
"""Settings `bound....` of a row."""

COLUMNS = (
    "open_loop_m_s",
    "damper_m_s",
    "clairvoyant_m_s",
    "bound_m_s",
    "impact_stay_m_s",
    "impact_worst_m_s",
    "lost_s",
    "search_1_m_s",
    "search_2_m_s",
    "spread_m_s",
    "last_doubling_m_s",
    "stem_switches",
    "simulations",
    "failed",
)
HISTORY = tuple(f"search_{k}_m_s {part}" for k in (1, 2) for part in PARTS)
MOST_HUNTS = 1000
"""Hunts of a search, at most."""
KNOWN_SHARE = 20
"""The search for one known load has the budget of the family divided by this."""
USELESS_S = 0.005
"""A branch that begins later than this before the latest arrival, under every load, is not searched."""
NEARBY = 5
"""Impulses that stand for one that is known to a share of itself."""
VALVES = {"all": "BNF", "firmware": "BN", "neutral": "N"}
"""Valves that a policy may use. The firmware never fills F while B pushes: its interlock."""


def columns(study: LoadedStudy) -> tuple[str, ...]:
    """Return the worst impact speeds over the family, and how far two searches agree."""
    return COLUMNS + HISTORY


def run(study: LoadedStudy, row: Row) -> RowResult:
    """Search the bounds of a row. Raises InputError for settings that are missing or wrong."""
    own, model = row.split({"bound": SETTINGS})
    for name, allowed in (("family", FAMILIES), ("valves", VALVES)):
        if own.setdefault(name, "all" if name == "valves" else "") not in allowed:
            shown = repr(own[name]) if own[name] else "missing"
            raise InputError(f"bound.{name}: {shown}; expected {', '.join(allowed)}")
    table, family = study.study.bounds, FAMILIES[str(own["family"])]
    delay_s = number("delay_s", own.get("delay_s"), -1.0)
    extra_s = number("extra_s", own.get("extra_s", table.extra_s), 0.0)
    valves = VALVES[str(own["valves"])]
    parameters = load(study.study.model).override(model)  # type: ignore[arg-type]
    values = tuple(sorted(model.items()))
    budget = count("simulations", own.get("simulations", table.simulations))
    hunts = count("hunts", own.get("hunts", HUNTS), MOST_HUNTS)
    moves = number("moves", own.get("moves", 0.0), 0.0, "")
    parts = [family]
    if "known" in own:
        if family is not GEARBOX:
            raise InputError("bound.known: needs an impulse; expected bound.family gearbox")
        parts = around(family, number("known", own["known"], 0.0, ""))
    found = [
        searched(
            parameters,
            each,
            delay_s,
            extra_s,
            valves,
            table,
            budget // len(parts),
            hunts,
            moves,
            len(parts) > 1,
        )
        for each in parts
    ]
    best_m_s = max(each.best_m_s for each in found)
    first, second = (np.max([each.history[k] for each in found], axis=0) for k in range(2))
    plain = FamilyModel(parameters, family, delay_s, extra_s).plain
    damped = family.under(load="damper")
    known_m_s = _known_loads_m_s(study.study.model, values, family.name, extra_s, valves, table)
    figures = (
        plain.impact_stay_m_s.max(),
        FamilyModel(parameters, damped, 0.0, 0.0).plain.impact_stay_m_s.max(),
        min(known_m_s, best_m_s),
        best_m_s,
        max(each.arrivals.impact_stay_m_s.max() for each in found),
        max(each.arrivals.impact_worst_m_s.max() for each in found),
        max(each.lost_s for each in found),
        first[-1],
        second[-1],
        abs(first[-1] - second[-1]),
        min(first[-2], second[-2]) - best_m_s,
        max(each.stem_switches for each in found),
        sum(each.runs for each in found),
        0.0,
        *first[:-1],
        *second[:-1],
    )
    return RowResult(dict(zip(COLUMNS + HISTORY, map(float, figures), strict=True)))


@dataclass(frozen=True)
class Found:
    """The best policy of two searches: hardest impact, arrivals, time lost, size of the search.

    history: [2, parts], the best of each search at parts of its budget, in m/s.
    """

    best_m_s: float
    history: Floats
    arrivals: Arrivals
    lost_s: float
    stem_switches: int
    runs: int


def searched(
    parameters: ParameterSet,
    family: Family,
    delay_s: float,
    extra_s: float,
    valves: str,
    table: BoundsTable,
    budget: int,
    hunts: int,
    moves: float,
    nearby: bool,
) -> Found:
    """Search the softest policy of a family twice, each with a budget of simulations.

    moves: share of the budget that goes to moves after the hunts.

    nearby: its loads are nearly the same, so that few pulses serve them all. If the release is known
    ahead, half of the budget goes to policies that do not use it.
    """
    model = FamilyModel(parameters, family, delay_s, extra_s)
    shapes = [(1, 1)]  # pulses of each valve in a segment, and in a branch
    late = (model.plain.revealed_s + delay_s > model.limit_s - USELESS_S).all()
    if nearby and (late or model.loads == 1):
        shapes = [(2, 0)]
    elif nearby and delay_s < 0.0:
        shapes = [(2, 0), (1, 1)]
    elif late:
        shapes, budget = [(4, 0)], budget // 4
    history, policies = [], []
    for seed in (table.seed, table.seed + 1):
        searches = [
            MovingSearch(model, valves, *shape, seed, moves)
            if moves
            else Search(model, valves, *shape, seed)
            for shape in shapes
        ]
        parts = [search.run(max(budget // len(shapes), 1), hunts) for search in searches]
        policies += [search.best for search in searches]
        # the first has half of the budget, so the whole of its own is a half of both
        history.append(
            parts[0] if len(parts) == 1 else [*parts[0][1:], min(each[-1] for each in parts)]
        )
    best = min(policies, key=lambda policy: policy.cost_m_s)
    arrivals = arrivals_of(model, best)
    lost_s = float((arrivals.arrival_s[0, 0] - model.plain.arrival_s[0, 0]).max())
    return Found(
        best.cost_m_s, np.array(history), arrivals, lost_s, stem_switches(best), model.runs
    )


def around(family: Family, known: float) -> list[Family]:
    """Return a family for each impulse of a family: it, and others up to `known` of it away.

    A share of 1: nothing is known, and the family is one.
    """
    if known == 1.0:
        return [family]
    factors = 1.0 + known * np.linspace(-1.0, 1.0, NEARBY if known else 1)
    found = []
    for case in family.cases:
        impulses = (float(factor) * case.sync_impulse_n_s for factor in factors)
        cases = tuple(replace(case, sync_impulse_n_s=impulse) for impulse in impulses)
        found.append(replace(family, cases=cases))
    return found


def count(name: str, value: Setting, most: int = 10**9) -> int:
    """Return a whole number of the row's settings, 1 to `most`. Raises InputError for anything else."""
    if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= most:
        raise InputError(f"bound.{name}: {value!r}; expected a whole number, 1 to {most}")
    return value


def number(name: str, value: Setting | None, low: float, unit: str = " s") -> float:
    """Return a number of the row's settings, `low` to 1. Raises InputError for anything else."""
    shown = "missing" if value is None else repr(value)
    expected = f"bound.{name}: {shown}; expected {low:g} to 1{unit}"
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not low <= value <= 1.0:
        raise InputError(expected)
    return float(value)


@functools.cache
def _known_loads_m_s(
    model: str,
    values: tuple[tuple[str, Setting], ...],
    family: str,
    extra_s: float,
    valves: str,
    table: BoundsTable,
) -> float:
    """Return bound (a) in m/s; it is the same for all delays, so a worker searches it once."""
    parameters = load(model).override(dict(values))  # type: ignore[arg-type]
    found = []
    for case in FAMILIES[family].cases:
        alone = FamilyModel(parameters, replace(FAMILIES[family], cases=(case,)), 0.0, extra_s)
        search = Search(alone, valves, 3, 0, table.seed)
        search.run(table.simulations // KNOWN_SHARE)
        found.append(search.best.cost_m_s)
    return max(found)

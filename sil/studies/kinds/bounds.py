"""Rows that are bounds: the softest stop found for a family of loads at an information delay.

A row sets `bound.family`, `bound.delay_s` and if wanted `bound.extra_s`, `bound.valves`,
`bound.simulations`, `bound.hunts` and `bound.moves` (the share of the simulations that goes to passes
and moves after the hunts) of each search, and `bound.known`, the share to which the impulse is known before the
stroke; all other settings change the model. `sil.studies.bound_search` searches, twice, with moves
`sil.studies.bound_moves`.
"""

from __future__ import annotations

import csv
import functools
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from can_dbc.errors import InputError
from plant.parameters import ParameterSet, load
from sil.report.figure import MS, Figure, Floats, Panel, Rule, Series, Span, Stack
from sil.studies.bound_moves import MovingSearch
from sil.studies.bound_search import (
    HALVINGS,
    HUNTS,
    Search,
    arrivals_of,
    stem_switches,
)
from sil.studies.figures import title_of
from sil.studies.kinds.budget import THESIS_S
from sil.studies.policies import FAMILIES, GEARBOX, NOT_ARRIVED, Arrivals, Family, FamilyModel
from sil.studies.rows import RowResult
from sil.studies.study import BoundsTable, LoadedStudy, Row, Setting
from sil.studies.table import Table

SHIPPED = Path(__file__).parents[1] / "bounds.csv"
"""Result of the shipped study `bounds`."""
TUNED = SHIPPED.with_name("tuned.csv")
"""Result of the shipped study `tuning`: the results.csv of `opc4 whatif tuning`."""

FORETOLD = "synchro brake"
"""The strategy that knows the release ahead, from the shaft speeds; in the laboratory nothing is."""

LEAD_S = 0.03
LAST_MS = 64.0
"""Right end of the figure."""


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
PARTS = [f"1/{1 << k}" for k in range(HALVINGS - 1, 0, -1)]
"""Parts of the budget at which the searches' best so far is stored; the last is the whole."""
HISTORY = tuple(f"search_{k}_m_s {part}" for k in (1, 2) for part in PARTS)
MOST_HUNTS = 1000
"""Hunts of a search, at most."""
KNOWN_SHARE = 20
"""The search for one known load has the budget of the family divided by this."""
KNOWN = "impulse known before the stroke to +-, %"
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


def figures(study: LoadedStudy, table: Table) -> dict[str, Figure]:
    """Return bounds and tuned strategies over the information delay, damper and plain push as levels.

    Bounds for loads that are known to a share are drawn over that share.
    """
    if "bound.known" in table.numbers:
        panel = known_panel(table.numbers)
        return {"bounds_known": Figure([Stack(KNOWN, [panel], width=9.0)], title_of(study))}
    delay_ms = MS * table.numbers["bound.delay_s"]
    families = np.array(table.texts.get("load", [study.study.name] * table.size))
    variants = np.array(_variants(table))
    stacks = []
    for family in dict.fromkeys(families):
        inside = families == family
        first = int(np.flatnonzero(inside)[0])
        lines = []
        for k, variant in enumerate(dict.fromkeys(variants)):
            rows = np.flatnonzero(inside & (variants == variant))
            rows = rows[np.argsort(delay_ms[rows])]
            x, name = delay_ms[rows], f"valves: {variant}" if variant else "bound"
            b = envelope(x, table.numbers["bound_m_s"][rows])
            lines.append(Series(f"(b) {name}", x, b, f"series{k}", "marked", width=2.2))
            ends = np.array([0.0, LAST_MS])
            a = np.full(2, np.min(table.numbers["clairvoyant_m_s"][rows]))
            lines.append(Series(f"(a) {name}", ends, a, f"series{k}", dashed=True, width=1.0))
        tuned = _tuned_points(family)
        low = min(float(np.min(delay_ms)), *(MS * min(each)[0] for each in tuned.values()))
        for k, (strategy, points) in enumerate(tuned.items(), start=3):
            x, y = np.array(sorted(points)).T
            lines.append(Series(strategy, MS * x, y, f"series{k % 8}", "dots", width=3.0))
        rules = levels(table.numbers, first)
        thesis = MS * sum(delay_s for _name, delay_s in THESIS_S)
        rules.append(Rule(thesis, f"thesis: {thesis:.0f} ms", "alarm", "x", "solid"))
        ahead = [Span(low, 0.0, "band")] if low < 0.0 else []
        panel = Panel(
            "Impact speed at the stop", "m/s", lines, spans=ahead, rules=rules, limits=(0.0, 1.5),
            height=380,
        )  # fmt: skip
        axis = "information delay, ms (grey: known ahead)"
        title = f"{family}: worst of its loads"
        stacks.append(Stack(axis, [panel], title, limits=(low, LAST_MS), width=6.4))
    return {
        "bounds": Figure(stacks, title_of(study), _headline(table, families), same_scale=True),
        "convergence": _convergence(study, table),
    }


def levels(columns: Mapping[str, Floats], row: int) -> list[Rule]:
    """Return the impact speeds of plain push and oil damper in a row as lines across a panel.

    columns: those of a study's table, [rows].
    """
    known = (("open loop", "open_loop_m_s", "faint"), ("oil damper", "damper_m_s", "series2"))
    return [
        Rule(float(columns[column][row]), name, role, "y", "solid") for name, column, role in known
    ]


def known_panel(columns: Mapping[str, Floats]) -> Panel:
    """Return bounds in m/s over the share to which a load is known, a line for each delay.

    columns: those of a study's table, [rows]. Where nothing is known (a share of 1) the bound is
    a level. What is reached with late information is also reached with earlier information.
    """
    known, delay_s = columns["bound.known"], columns["bound.delay_s"]
    bound_m_s = columns["bound_m_s"].copy()
    for each in np.unique(known):
        rows = np.flatnonzero(known == each)
        bound_m_s[rows] = envelope(delay_s[rows], bound_m_s[rows])
    lines, rules = [], levels(columns, 0)
    for k, delay in enumerate(np.unique(delay_s)[::-1]):
        rows = np.flatnonzero((delay_s == delay) & (known < 1.0))
        rows = rows[np.argsort(known[rows])]
        name = "release known" + (f" {MS * delay:.0f} ms late" if delay > 0.0 else "")
        name += f" {-MS * delay:.0f} ms ahead" if delay < 0.0 else ""
        role = f"series{(0, 4, 6, 1)[k % 4]}"
        x, y = 100.0 * known[rows], bound_m_s[rows]
        lines.append(Series(f"bound: {name}", x, y, role, "marked", width=2.2))
        rules += [
            Rule(each, "nothing known" if k == 0 else "", role, "y", "dashed")
            for each in bound_m_s[(delay_s == delay) & (known == 1.0)]
        ]
    return Panel("Worst impact", "m/s", lines, rules=rules, limits=(0.0, 1.5), height=400)


def _convergence(study: LoadedStudy, table: Table) -> Figure:
    """Return the best of both searches of each row over their simulations."""
    shares: Floats = np.array([100.0 / (1 << k) for k in range(HALVINGS - 1, -1, -1)])
    lines = []
    for row in range(table.size):
        name = f"{MS * table.numbers['bound.delay_s'][row]:g} ms"
        if variant := _variants(table)[row]:
            name += f", {variant}"
        for k, dashed in ((1, False), (2, True)):
            names = (*(f"search_{k}_m_s {part}" for part in PARTS), f"search_{k}_m_s")
            found = np.array([table.numbers[name][row] for name in names])
            found[found > NOT_ARRIVED] = np.nan
            label = name if k == 1 else f"{name}, second search"
            lines.append(Series(label, shares, found, f"series{row % 8}", "marked", dashed))
    panel = Panel("Hardest impact of the best policy", "m/s", lines, height=380)
    axis = "simulations, % of each search's"
    best = table.numbers["spread_m_s"]
    ends = f"{best.min():.3f} to {best.max():.3f} m/s"
    text = f"The two searches of a point differ by {ends} at the end"
    return Figure([Stack(axis, [panel], logarithmic=True, width=9.0)], title_of(study), text)


def _variants(table: Table) -> list[str]:
    """Return the variant of each row, or the delays of its valves if they are swept."""
    if "variant" in table.texts or not {"valve.D_rise", "valve.D_fall"} <= table.numbers.keys():
        return table.texts.get("variant", [""] * table.size)
    delays_s = zip(table.numbers["valve.D_rise"], table.numbers["valve.D_fall"], strict=True)
    return [f"opens {MS * rise:g}, closes {MS * fall:g} ms" for rise, fall in delays_s]


def _headline(table: Table, families: Iterable[str]) -> str:
    observed = table.numbers["bound.delay_s"] >= 0.0
    harder = table.numbers["bound_m_s"] > table.numbers["damper_m_s"]
    rows = {family: observed & (np.array(families) == family) for family in dict.fromkeys(families)}
    found = [family for family, which in rows.items() if which.any() and harder[which].all()]
    if not found:
        return "The softest worst-case stop found for a controller that waits for the motion"
    return (
        f"On the {' and the '.join(found)} no policy found that waits for the motion stops as "
        "softly as the oil damper"
    )


def envelope(delay: Floats, bound_m_s: Floats) -> Floats:
    """Return the bound [n] in m/s over the delay [n] in any unit.

    What is reached with late information is also reached with earlier information.
    """
    order = np.argsort(delay)
    found = np.empty_like(bound_m_s)
    found[order] = np.minimum.accumulate(bound_m_s[order][::-1])[::-1]
    return found


def _tuned_points(family: str) -> dict[str, list[tuple[float, float]]]:
    """Return (information delay s, worst impact speed m/s) of each strategy of the shipped tuning."""
    found: dict[str, list[tuple[float, float]]] = {}
    with open(TUNED, encoding="utf-8", newline="") as file:
        for row in csv.DictReader(file):
            worst_m_s = worst_over(row, family)
            if worst_m_s is not None and row["strategy"] not in ("open loop", "oil damper"):
                found.setdefault(row["strategy"], []).append((delay_of(row, family), worst_m_s))
    return found


def worst_over(row: Mapping[str, str], family: str) -> float | None:
    """Return the worst impact speed of a tuned row over a family's loads, None if one failed."""
    cells = [value for name, value in row.items() if name.startswith(f"impact_m_s {family}")]
    return None if not cells or "" in cells else max(map(float, cells))


def delay_of(row: Mapping[str, str], family: str) -> float:
    """Return the information delay of a tuned row; negative, at most `LEAD_S`, if known ahead."""
    if row["strategy"] != FORETOLD or family != "gearbox":
        return float(row["information_delay_s"])
    return -min(LEAD_S, float(row["best.least_lead_s"] or LEAD_S))

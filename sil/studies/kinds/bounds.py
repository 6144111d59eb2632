"""Rows that are bounds: the softest stop found for a family of loads at an information delay.

A row sets `bound.family`, `bound.delay_s` and if wanted `bound.extra_s`; all other settings change
the model. `sil.studies.bound_search` searches.
"""

from __future__ import annotations

import csv
import functools
import math
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np

from can_dbc.errors import InputError
from plant.parameters import load
from sil.report.figure import MS, Figure, Floats, Panel, Rule, Series, Span, Stack
from sil.studies.bound_search import bound, clairvoyant, shooters_of
from sil.studies.figures import title_of
from sil.studies.kinds.budget import THESIS_S
from sil.studies.rows import RowResult
from sil.studies.shooting import FAMILIES
from sil.studies.study import BoundsTable, LoadedStudy, Row, Setting
from sil.studies.table import Table

TUNED = Path(__file__).parents[1] / "tuned.csv"
"""Result of the shipped study `tuning`: the results.csv of `opc4 whatif tuning`."""

FORETOLD = "synchro brake"
"""The strategy that knows the release ahead, from the shaft speeds; in the laboratory nothing is."""

LEAD_S = 0.03
LAST_MS = 64.0
"""Right end of the figure."""


def columns(study: LoadedStudy) -> tuple[str, ...]:
    """Return the worst impact speeds over the family, and the size of the search."""
    return (
        "open_loop_m_s",
        "damper_m_s",
        "clairvoyant_m_s",
        "bound_m_s",
        "stem_switches",
        "simulations",
        "failed",
    )


def run(study: LoadedStudy, row: Row) -> RowResult:
    """Search the bounds of a row. Raises InputError for a family or delay that is missing or wrong."""
    own = {k[6:]: v for k, v in row.settings.items() if k.startswith("bound.")}
    model = {k: v for k, v in row.settings.items() if not k.startswith("bound.")}
    unknown = set(own) - {"family", "delay_s", "extra_s"}
    if unknown:
        raise InputError(f"bound.{min(unknown)}: unknown; expected family, delay_s, extra_s")
    family = FAMILIES.get(str(own.get("family")))
    if family is None:
        raise InputError(f"bound.family: {own.get('family')!r}; expected {', '.join(FAMILIES)}")
    table = study.study.bounds
    delay_s = seconds("delay_s", own.get("delay_s"), -1.0)
    extra_s = seconds("extra_s", own.get("extra_s", table.extra_s), 0.0)
    known_m_s = softest_known(
        study.study.model, tuple(sorted(model.items())), family.name, extra_s, table
    )
    found = bound(
        load(study.study.model).override(model),  # type: ignore[arg-type]
        family,
        delay_s,
        extra_s,
        most_switches=table.switches,
        budget=table.budget,
        stems=table.stems,
        seed=table.seed,
        known_m_s=known_m_s,
    )
    return RowResult(
        {
            "open_loop_m_s": found.open_loop_m_s,
            "damper_m_s": found.damper_m_s,
            "clairvoyant_m_s": found.clairvoyant_m_s,
            "bound_m_s": found.non_anticipating_m_s,
            "stem_switches": float(found.stem.switches),
            "simulations": float(found.runs),
            "failed": 0.0,
        }
    )


def seconds(name: str, value: Setting | None, low: float) -> float:
    """Return a time of the row's settings, from `low` to 1 s. Raises InputError for anything else."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise InputError(f"bound.{name}: {value!r}; expected a number of seconds")
    if not (math.isfinite(value) and low <= value <= 1.0):
        raise InputError(f"bound.{name}: {value!r}; expected {low:g} to 1 s")
    return float(value)


@functools.cache
def softest_known(
    model: str,
    values: tuple[tuple[str, Setting], ...],
    family: str,
    extra_s: float,
    table: BoundsTable,
) -> tuple[float, ...]:
    """Return bound (a) of each load; it is the same for all delays, so a worker searches it once."""
    parameters = load(model).override(dict(values))  # type: ignore[arg-type]
    return tuple(
        clairvoyant(
            shooter, most_switches=table.switches, budget=table.budget, seed=table.seed
        ).speed_m_s
        for shooter in shooters_of(parameters, FAMILIES[family], extra_s)
    )


def figures(study: LoadedStudy, table: Table) -> dict[str, Figure]:
    """Return bounds and tuned strategies over the information delay, damper and plain push as levels."""
    delay_ms = MS * table.numbers["bound.delay_s"]
    families = np.array(table.texts.get("load", [study.study.name] * table.size))
    variants = np.array(table.texts.get("variant", [""] * table.size))
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
            a = np.full(len(x), np.min(table.numbers["clairvoyant_m_s"][rows]))
            lines.append(Series(f"(b) {name}", x, b, f"series{k}", width=2.2))
            lines.append(Series(f"(a) {name}", x, a, f"series{k}", dashed=True, width=1.0))
        for k, (strategy, points) in enumerate(tuned_points(family).items(), start=3):
            x, y = np.array(sorted(points)).T
            lines.append(Series(strategy, MS * x, y, f"series{k % 8}", "dots", width=3.0))
        rules = [
            Rule(table.numbers[column][first], name, role, "y", "solid")
            for name, column, role in (
                ("open loop", "open_loop_m_s", "faint"),
                ("oil damper", "damper_m_s", "series2"),
            )
        ]
        thesis = MS * sum(delay_s for _name, delay_s in THESIS_S)
        rules.append(Rule(thesis, f"thesis: {thesis:.0f} ms", "alarm", "x", "solid"))
        low = float(np.min(delay_ms))
        ahead = [Span(low, 0.0, "band")] if low < 0.0 else []
        panel = Panel(
            "Impact speed at the stop", "m/s", lines, spans=ahead, rules=rules, limits=(0.0, 1.5),
            height=380,
        )  # fmt: skip
        axis = "information delay, ms (grey: known ahead)"
        title = f"{family}: worst of its loads"
        stacks.append(Stack(axis, [panel], title, limits=(low, LAST_MS), width=6.4))
    return {"bounds": Figure(stacks, title_of(study), headline(table, families), same_scale=True)}


def headline(table: Table, families: Iterable[str]) -> str:
    """Return which families no controller was found to stop as softly as the damper does."""
    observed = table.numbers["bound.delay_s"] >= 0.0
    harder = table.numbers["bound_m_s"] > table.numbers["damper_m_s"]
    rows = {family: observed & (np.array(families) == family) for family in dict.fromkeys(families)}
    found = [family for family, which in rows.items() if which.any() and harder[which].all()]
    if not found:
        return "The softest worst-case stop found for a controller"
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


def tuned_points(family: str) -> dict[str, list[tuple[float, float]]]:
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

"""Figures of bounds: over the information delay, over what is known beforehand, and the searches' course.

Checked by: tests/unit/sil/studies/kinds/test_bounds.py
"""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np

from sil.report.figure import MS, Figure, Floats, Note, Panel, Rule, Series, Span, Stack
from sil.studies.bound_search import HALVINGS
from sil.studies.figures import title_of
from sil.studies.policies import NOT_ARRIVED, THESIS_DELAYS_S
from sil.studies.study import LoadedStudy
from sil.studies.table import Table

SHIPPED = Path(__file__).with_name("bounds.csv")
"""Result of the shipped study `bounds`."""
TUNED = SHIPPED.with_name("tuned.csv")
"""Result of the shipped study `tuning`: the results.csv of `opc4 whatif tuning`."""

FORETOLD = "synchro brake"
"""The strategy that knows the release ahead, from the shaft speeds; in the laboratory nothing is."""

LEAD_S = 0.03
LAST_MS = 64.0
"""Right end of the figure."""
PARTS = [f"1/{1 << k}" for k in range(HALVINGS - 1, 0, -1)]
"""Parts of the budget at which the searches' best so far is stored; the last is the whole."""
KNOWN = "impulse known before the stroke to +-, %"


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
        thesis = MS * sum(delay_s for _name, delay_s in THESIS_DELAYS_S)
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
    lines, rules, notes = [], levels(columns, 0), []
    middle = 50.0 * known[known < 1.0].max(initial=0.0)
    for k, delay in enumerate(np.unique(delay_s)[::-1]):
        rows = np.flatnonzero((delay_s == delay) & (known < 1.0))
        rows = rows[np.argsort(known[rows])]
        name = "release known" + (f" {MS * delay:.0f} ms late" if delay > 0.0 else "")
        name += f" {-MS * delay:.0f} ms ahead" if delay < 0.0 else ""
        role = ("ink", "series4", "series6", "series1")[k % 4]
        x, y = 100.0 * known[rows], bound_m_s[rows]
        lines.append(Series(f"bound: {name}", x, y, role, "marked", width=2.2))
        for each in bound_m_s[(delay_s == delay) & (known == 1.0)]:
            rules.append(Rule(each, "", role, "y", "dashed"))
            notes += [Note(middle, each, "nothing known", role, up=3.0)] if k == 0 else []
    return Panel(
        "Worst impact", "m/s", lines, rules=rules, notes=notes, limits=(0.0, 1.5), height=400
    )


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

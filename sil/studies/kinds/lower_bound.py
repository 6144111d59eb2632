"""Rows that are certified lower bounds: no braking by valve N stops the hardest load softer.

A row sets `bound.delay_s`; all other settings change the model. See `sil.studies.lower_bound`.
"""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Iterator, Mapping

import numpy as np

from plant.parameters import load
from sil.report.figure import MS, Figure, Panel, Series, Stack
from sil.studies.bound_figures import SHIPPED, levels
from sil.studies.figures import title_of
from sil.studies.kinds.bounds import number
from sil.studies.lower_bound import HeldModel, best_proof, certificate
from sil.studies.policies import GEARBOX, FamilyModel
from sil.studies.rows import RowResult
from sil.studies.study import LoadedStudy, Row
from sil.studies.table import Table

COLUMNS = (
    "certified_m_s",
    "found_m_s",
    "all_valves_m_s",
    "damper_m_s",
    "open_loop_m_s",
    "leaves",
    "failed",
)
NEUTRAL = "N alone"
"""The variant of the shipped study `bounds_valves` with the valves that the proof covers."""
MOST_NODES = 60_000
"""Sets of commands that a proof may look at; beyond it a bound counts as not proven."""


def columns(study: LoadedStudy) -> tuple[str, ...]:
    """Return the certified bound, the softest found with valve N and with all, damper, plain push, size of the proof."""
    return COLUMNS


def run(study: LoadedStudy, row: Row) -> RowResult:
    """Prove the bound of a row. Raises InputError for settings that are wrong or not covered."""
    held = _held_model(study, row)
    bound_m_s, leaves = best_proof(held, MOST_NODES)
    parameters = held.parameters
    plain, damper = (
        float(FamilyModel(parameters, family, 0.0, 0.0).plain.impact_stay_m_s.max())
        for family in (GEARBOX, GEARBOX.under(load="damper"))
    )
    softest = (_found_m_s(held, row.settings, name) for name in ("bounds_valves.csv", "bounds.csv"))
    found = bound_m_s, *softest, damper, plain, len(leaves), 0.0
    return RowResult(dict(zip(COLUMNS, map(float, found), strict=True)))


def _held_model(study: LoadedStudy, row: Row) -> HeldModel:
    """Return the model of a row. Raises InputError for settings that are wrong or not covered."""
    own, model = row.split({"bound": ("delay_s", "extra_s")})
    delay_s = number("delay_s", own.get("delay_s"), 0.0)
    extra_s = number("extra_s", own.get("extra_s", study.study.bounds.extra_s), 0.0)
    parameters = load(study.study.model).override(model)  # type: ignore[arg-type]
    return HeldModel(parameters, delay_s, extra_s)


def _found_m_s(held: HeldModel, settings: Mapping[str, object], name: str) -> float:
    """Return the softest policy, of valve N if there is a choice, in a shipped table; NaN without a row."""
    valves = ("valve.D_rise", "valve.D_fall")
    if set(settings) - {*valves, "bound.delay_s"}:
        return math.nan
    wanted = {name: held.parameters.value(name) for name in valves}
    wanted["bound.delay_s"] = held.delay_s
    with open(SHIPPED.with_name(name), encoding="utf-8", newline="") as file:
        for row in csv.DictReader(file):
            same = all(float(row[path]) == value for path, value in wanted.items())
            if same and row.get("variant", NEUTRAL) == NEUTRAL:
                return float(row["bound_m_s"])
    return math.nan


def files(study: LoadedStudy, table: Table) -> Iterator[tuple[str, str]]:
    """Yield file name and text of the certificate of each row whose bound is above zero."""
    for row, bound_m_s in zip(study.rows(), table.numbers["certified_m_s"], strict=False):
        if bound_m_s > 0.0:
            held = _held_model(study, row)
            leaves = held.prove(bound_m_s, MOST_NODES)
            assert leaves is not None, "the same proof was found for the table"
            text = json.dumps(certificate(held, float(bound_m_s), leaves), indent=None)
            yield f"certificate_{row.number}.json", text + "\n"


def figures(study: LoadedStudy, table: Table) -> dict[str, Figure]:
    """Return certified bound and softest policy found over the information delay, the interval between as a line."""
    delay_ms = MS * table.numbers["bound.delay_s"]
    order = np.argsort(delay_ms)
    certified_m_s, found_m_s = table.numbers["certified_m_s"], table.numbers["found_m_s"]
    lines = [
        Series(name, delay_ms[order], speed_m_s[order], role, "dots", width=4.0)
        for name, speed_m_s, role in (
            ("certified: no braking by valve N is softer", certified_m_s, "series0"),
            ("softest found, valve N", found_m_s, "series1"),
            ("softest found, all valves", table.numbers["all_valves_m_s"], "series3"),
        )
    ]
    lines += [
        Series("", np.full(2, delay_ms[k]), np.array([certified_m_s[k], found_m_s[k]]), "series1")
        for k in order
    ]
    title, rules = "Impact speed at the stop", levels(table.numbers, 0)
    panel = Panel(title, "m/s", lines, rules=rules, limits=(0.0, 1.5), height=380)
    proven = table.numbers["certified_m_s"] > table.numbers["damper_m_s"]
    from_ms = min(delay_ms[proven], default=math.inf)
    headline = "Certified lower bound of braking by the air in N"
    if proven[delay_ms >= from_ms].any() and proven[delay_ms >= from_ms].all():
        headline = (
            f"A controller that knows the release {from_ms:.0f} ms late, or later, cannot match the "
            "oil damper with valve N"
        )
    stack = Stack("information delay, ms", [panel], "gearbox: worst of its loads", width=6.4)
    return {"lower_bound": Figure([stack], title_of(study), headline, same_scale=True)}

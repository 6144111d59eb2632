"""Rows that are policies: how softly any controller could stop, as far as two searches have found.

A row searches on from what is stored of it. Its figures are those of the softest policy that its valves
can carry out: its own, or that of a row with later information or slower valves. Quicker valves move the
plungers as slower ones do, only sooner, as does the plain push: stops and delays against it are the same.
"""

from __future__ import annotations

import math
from functools import cache
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np

from can_dbc import typed_toml
from plant.parameters import load
from sil.report.figure import MS, Figure, Panel, Rule, Series, Stack
from sil.studies.bounds.judge import LATER_S, NOMINAL, SHIFTED, drawn
from sil.studies.bounds.policy import SwitchingDelays
from sil.studies.bounds.search import BoundProblem, SearchProgress, softest_alone
from sil.studies.bounds.store import SEARCHES, read_progress, write_campaign, write_progress
from sil.studies.study import RowResult, Study, StudyFile, StudyRow, Table
from sil.studies.table import markdown

Delay = Annotated[float, msgspec.Meta(ge=0.0, le=0.1)]
COLUMNS = {
    "open_m_s": "open loop",
    "damper_m_s": "oil damper",
    "known_m_s": "known in advance",
    "worst_m_s": "commands ±0.3 ms",
    "exact_m_s": "no scatter",
    "drawn_m_s": "32 draws",
    "drawn_late_share": "of these late",
    "fine_m_s": "grid of 0.25 N s",
    "half_m_s": "half the budget",
    "cma_m_s": "CMA-ES",
    "linear_m_s": "linear programs",
}


class RowKeys(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What the choices of a row set."""

    opening_s: Delay
    closing_s: Delay
    delay_s: Delay
    mesh_n: Annotated[list[Annotated[float, msgspec.Meta(ge=0.0)]], msgspec.Meta(min_length=1)]
    b_with_f: bool = False

    @property
    def folder(self) -> str:
        """The folder of the row's policies."""
        delays = (self.opening_s, self.closing_s, self.delay_s)
        name = "open_{:g}_close_{:g}_delay_{:g}_mesh".format(*(MS * each for each in delays))
        valves = ["b_with_f"] if self.b_with_f else []
        return "_".join([name, *(f"{each:g}" for each in self.mesh_n), *valves])

    def can_imitate(self, row: RowKeys) -> bool:
        """Return whether a policy of another row is one of this row as well, with the same stops."""
        sooner_s = min(row.opening_s - self.opening_s, row.closing_s - self.closing_s)
        return (
            self.opening_s <= row.opening_s
            and self.closing_s <= row.closing_s
            and self.delay_s <= row.delay_s + sooner_s + 1e-9
            and set(self.mesh_n) <= set(row.mesh_n)
            and self.b_with_f >= row.b_with_f
        )

    def problem(self, model: str) -> BoundProblem:
        """Return what is searched for."""
        timing = SwitchingDelays(self.opening_s, self.closing_s)
        return BoundProblem(load(model), timing, self.delay_s, self.mesh_n, self.b_with_f)


class BoundsStudy(StudyFile, frozen=True, kw_only=True, tag_field="kind", tag="bounds"):
    """A row is the search for a policy, and the judgement of the best so far."""

    attempts: Annotated[int, msgspec.Meta(ge=0, le=10_000)] = 20
    """Attempts of each search on a row, stored ones included; 0: judge the stored policies."""
    evaluations: Annotated[int, msgspec.Meta(ge=100)] = 4000
    """Policies that an attempt judges."""
    known_evaluations: Annotated[int, msgspec.Meta(ge=100)] = 3000
    """Policies that are judged for each load that is known in advance."""

    def columns(self) -> tuple[str, ...]:
        """Return hardest stops, evaluations of both searches, and the row whose policy is judged."""
        return (*COLUMNS, "delay_s", *(f"{name}_tried" for name in SEARCHES), "row", "failed")

    def check(self, source: str) -> None:
        """Refuse choices that set anything else. Raises InputError."""
        for row in Study(self, source).rows():
            typed_toml.convert(row.settings, RowKeys, f"{source}: row {row.number}")

    def without_search(self) -> BoundsStudy:
        """Return the study that judges the stored policies."""
        return msgspec.structs.replace(self, attempts=0)

    def run(self, study: Study, row: StudyRow) -> RowResult:
        """Search on, store and judge. Raises InputError for a stored policy that is wrong."""
        rows = [typed_toml.convert(each.settings, RowKeys, study.source) for each in study.rows()]
        keys, roots = rows[row.number], [Path(study.source).parent / "bounds"]
        if study.folder is not None:
            roots.insert(0, study.folder / "policies")
        stored = [read_progress(*(root / each.folder for root in roots)) for each in rows]
        problem, progress = keys.problem(self.model), stored[row.number]
        while self.attempts > min(len(each.history) for each in progress.values()):
            progress["cma"] = problem.cma(progress["cma"], self.evaluations)
            progress["linear"] = problem.linear(progress["linear"], self.evaluations)
            if study.folder is not None:
                write_progress(roots[0] / keys.folder, progress)
        best = min(progress.values(), key=lambda each: each.worst_m_s)
        if study.folder is not None and best.values:
            write_progress(roots[0] / keys.folder, progress)
            write_campaign(roots[0] / keys.folder, problem, best)
        usable = [k for k, each in enumerate(rows) if keys.can_imitate(each)]
        ends = {
            name: min((stored[k][name].worst_m_s, abs(k - row.number), k) for k in usable)
            for name in SEARCHES
        }
        name = min(ends, key=ends.__getitem__)
        origin = ends[name][2]
        best = stored[origin][name]
        if not math.isfinite(best.worst_m_s):
            return study.without_figures("failed", "no policy arrives in time under every load")
        ends_n, budget = {min(keys.mesh_n), max(keys.mesh_n)}, self.known_evaluations
        known = [known_m_s(self.model, problem.timing, each, budget) for each in ends_n]
        figures = judged(rows[origin].problem(self.model), best) | {
            "known_m_s": max(known),
            "half_m_s": best.worst_after(0.5),
            "delay_s": keys.delay_s,
            "row": origin,
            "failed": 0.0,
        }
        for name, (worst_m_s, _, k) in ends.items():
            figures[f"{name}_m_s"] = worst_m_s
            figures[f"{name}_tried"] = sum(x[0] for x in stored[k][name].history[-1:])
        return RowResult({k: v if math.isfinite(v) else math.nan for k, v in figures.items()})

    def draw(self, study: Study, table: Table) -> dict[str, Figure]:
        """Return the hardest stop over the delay, a line for each set of valves."""
        numbers, loads = table.numbers, np.array(table.texts["load"])
        names = np.array([text.split(";")[0] for text in table.texts["variant"]])
        order, stacks = np.argsort(numbers["delay_s"], kind="stable"), []
        for mesh in dict.fromkeys(table.texts["load"]):
            lines = []
            for k, valves in enumerate(dict.fromkeys(names)):
                rows = order[((loads == mesh) & (names == valves))[order]]
                x, y = MS * numbers["delay_s"][rows], numbers["worst_m_s"][rows]
                lines.append(Series(valves, x, y, f"series{k}", "marked"))
            rules = [
                Rule(
                    float(np.fmax.reduce(numbers[name][loads == mesh])), text, "ink", "y", "dashed"
                )
                for name, text in COLUMNS.items()
                if name in ("open_m_s", "damper_m_s")
            ]
            known = np.full(table.size, np.fmax.reduce(numbers["known_m_s"][loads == mesh]))
            x = MS * numbers["delay_s"][order]
            lines.append(Series(COLUMNS["known_m_s"], x, known, "ink", dashed=True))
            panel = Panel("Hardest stop", "m/s", lines, rules=rules, limits=(0.0, 1.6))
            stacks.append(Stack("information delay, ms", [panel], f"mesh force {mesh}", width=4.6))
        return {"bounds": Figure(stacks, "The softest policies found", same_scale=True)}

    def texts(self, study: Study, table: Table) -> dict[str, str]:
        """Return the table of figures, with an interval where the searches differ."""
        rows, numbers = [], table.numbers
        for k, names in enumerate(zip(table.texts["variant"], table.texts["load"], strict=True)):
            cells = {name: f"{numbers[name][k]:.3f}".replace("nan", "none") for name in COLUMNS}
            cells["drawn_late_share"] = f"{100 * numbers['drawn_late_share'][k]:.1f} %"
            ends = [numbers[f"{name}_m_s"][k] for name in SEARCHES]
            if not np.ptp(ends) <= 0.03:
                cells["worst_m_s"] += f" to {np.max(ends):.3f}".replace("nan", "?")
            tried = " + ".join(f"{numbers[f'{name}_tried'][k]:.0f}" for name in SEARCHES)
            origin = table.texts["variant"][int(np.nan_to_num(numbers["row"][k], nan=k))]
            rows.append([*names, *cells.values(), tried, origin])
        head = ["valves; delay", "mesh force", *COLUMNS.values(), "policies tried", "policy of"]
        return {"bounds.md": "\n".join(markdown(head, rows)) + "\n"}


def judged(problem: BoundProblem, policy: SearchProgress) -> dict[str, float]:
    """Return the hardest stops of a policy in each judgement, those of the plain push, and late draws' share."""
    judges = {
        "worst_m_s": problem.judge,
        "exact_m_s": problem.judge_of(NOMINAL),
        "fine_m_s": problem.judge_of(SHIFTED, 0.25),
    }
    figures = {
        name: float(problem.judged(policy, judge).worst_m_s[0]) for name, judge in judges.items()
    }
    draws = problem.judged(policy, problem.judge_of(drawn(problem.parameters), 4.0))
    figures["drawn_m_s"] = float(draws.impact_m_s.max())
    figures["drawn_late_share"] = float((draws.late_s > LATER_S).mean())
    figures["open_m_s"] = float(problem.judge.plain.impact_m_s.max())
    damper = problem.judge_of(NOMINAL, load="damper")
    figures["damper_m_s"] = float(damper.plain.impact_m_s.max())
    return figures


@cache
def known_m_s(model: str, timing: SwitchingDelays, mesh_n: float, evaluations: int) -> float:
    """Return the hardest in m/s of the softest stops found for nine loads, each known in advance."""
    stops_m_s, last = [], list[SearchProgress]()
    for impulse_n_s in np.linspace(18.0, 250.0, 9).tolist():
        last = [softest_alone(load(model), timing, mesh_n, impulse_n_s, evaluations, last)]
        stops_m_s.append(last[0].worst_m_s)
    return max(stops_m_s)

"""Rows that are policies: how softly any controller could stop, as far as two searches have found.

A row searches on from what is stored of it, and judges the best policy. The shipped policies are in
`sil/studies/shipped/bounds`.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np

from can_dbc import typed_toml
from plant.parameters import load
from sil.report.figure import MS, Figure, Panel, Rule, Series, Span, Stack
from sil.studies.bounds.judge import NOMINAL, SHIFTED, drawn
from sil.studies.bounds.policy import Timing
from sil.studies.bounds.search import Problem, Progress, softest_alone_m_s
from sil.studies.bounds.store import SEARCHES, Search, read_progress, write_campaign, write_progress
from sil.studies.policies import GEARBOX, PUSH, FamilyModel
from sil.studies.study import Row, RowResult, Study, StudyFile, Table
from sil.studies.table import markdown

Delay = Annotated[float, msgspec.Meta(ge=0.0, le=0.1)]
COLUMNS = {
    "open_m_s": "open loop",
    "damper_m_s": "oil damper",
    "known_m_s": "known in advance",
    "worst_m_s": "commands ±0.3 ms",
    "exact_m_s": "no scatter",
    "drawn_m_s": "32 draws",
    "drawn_late_s": "latest of the draws, ms",
    "fine_m_s": "grid of 0.25 N s",
    "half_m_s": "half the budget",
    "cma_m_s": "CMA-ES",
    "differential_m_s": "differential evolution",
}


class RowKeys(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What the choices of a row set."""

    opening_s: Delay
    closing_s: Delay
    delay_s: Delay
    mesh_n: Annotated[list[Annotated[float, msgspec.Meta(ge=0.0)]], msgspec.Meta(min_length=1)]

    @property
    def folder(self) -> str:
        """The folder of the row's policies."""
        delays = (self.opening_s, self.closing_s, self.delay_s)
        name = "open_{:g}_close_{:g}_delay_{:g}_mesh".format(*(MS * each for each in delays))
        return "_".join([name, *(f"{each:g}" for each in self.mesh_n)])


class BoundsStudy(StudyFile, frozen=True, kw_only=True, tag_field="kind", tag="bounds"):
    """A row is the search for a policy, and the judgement of the best so far."""

    attempts: Annotated[int, msgspec.Meta(ge=0, le=10_000)] = 20
    """Attempts of each search on a row, stored ones included; 0: judge the stored policies."""
    evaluations: Annotated[int, msgspec.Meta(ge=100)] = 4000
    """Policies that an attempt judges."""
    known_evaluations: Annotated[int, msgspec.Meta(ge=100)] = 3000
    """Policies that are judged for each load that is known in advance."""

    def columns(self) -> tuple[str, ...]:
        """Return hardest stops, and evaluations of both searches."""
        return (*COLUMNS, "delay_s", *(f"{name}_evaluations" for name in SEARCHES), "failed")

    def check(self, source: str) -> None:
        """Refuse choices that set anything else. Raises InputError."""
        study = Study(self, source)
        for row in study.rows():
            typed_toml.convert(row.settings, RowKeys, f"{source}: row {row.number}")

    def without_search(self) -> BoundsStudy:
        """Return the study that judges the stored policies."""
        return msgspec.structs.replace(self, attempts=0)

    def run(self, study: Study, row: Row) -> RowResult:
        """Search on, store and judge. Raises InputError for a stored policy that is wrong."""
        keys = typed_toml.convert(row.settings, RowKeys, study.source)
        parameters, timing = load(self.model), Timing(keys.opening_s, keys.closing_s)
        problem = Problem(parameters, timing, keys.delay_s, keys.mesh_n)
        roots = [Path(study.source).parent / "bounds"]
        if study.folder is not None:
            roots.insert(0, study.folder / "policies")
            (roots[0] / keys.folder).mkdir(parents=True, exist_ok=True)
        progress = _newest(roots, keys.folder)
        while self.attempts > min(len(each.history) for each in progress.values()):
            if len(progress["cma"].history) < self.attempts:
                others = _others(study, keys, roots)
                progress["cma"] = problem.cma(progress["cma"], others, self.evaluations)
            if len(progress["differential"].history) < self.attempts:
                second = problem.differential(progress["differential"], self.evaluations)
                progress["differential"] = second
            if study.folder is not None:
                write_progress(roots[0] / keys.folder, progress)
        best = min(progress.values(), key=lambda each: each.worst_m_s)
        if not math.isfinite(best.worst_m_s):
            return study.without_figures("failed", "no policy arrives in time under every load")
        if study.folder is not None:
            write_progress(roots[0] / keys.folder, progress)
            write_campaign(roots[0] / keys.folder, problem, best)
        figures = judged(problem, best) | {
            "known_m_s": known_m_s(self.model, timing, tuple(keys.mesh_n), self.known_evaluations),
            "half_m_s": best.worst_after(0.5),
            "delay_s": keys.delay_s,
            "failed": 0.0,
        }
        for name, each in progress.items():
            figures[f"{name}_m_s"] = each.worst_m_s
            figures[f"{name}_evaluations"] = each.history[-1][0] if each.history else 0.0
        return RowResult({k: v if math.isfinite(v) else math.nan for k, v in figures.items()})

    def draw(self, study: Study, table: Table) -> dict[str, Figure]:
        """Return the hardest stop over the delay, a line for each set of valves."""
        names = [text.split(";")[0] for text in table.texts["variant"]]
        stacks = []
        for load_ in dict.fromkeys(table.texts["load"]):
            lines, spans = [], []
            here = np.array([text == load_ for text in table.texts["load"]])
            for k, valves in enumerate(dict.fromkeys(names)):
                rows = np.flatnonzero(here & (np.array(names) == valves))
                rows = rows[np.argsort(table.numbers["delay_s"][rows])]
                x, y = MS * table.numbers["delay_s"][rows], table.numbers["worst_m_s"][rows]
                lines.append(Series(valves, x, y, f"series{k}", "marked"))
                highest = np.fmax(*(table.numbers[f"{name}_m_s"][rows] for name in SEARCHES))
                spans += [
                    Span(at - 0.15, at + 0.15, f"series{k}", "", low, high)
                    for at, low, high in zip(x, y, highest, strict=True)
                    if high > low + 0.03
                ]
            rules = [
                Rule(
                    float(np.nanmax(table.numbers[name][here])), COLUMNS[name], "ink", "y", "dashed"
                )
                for name in ("open_m_s", "damper_m_s", "known_m_s")
            ]
            panel = Panel("Hardest stop", "m/s", lines, spans=spans, rules=rules, limits=(0.0, 1.6))
            stacks.append(Stack("information delay, ms", [panel], f"mesh force {load_}", width=4.6))
        title = "The softest policies found (bars: to the second search)"
        return {"bounds": Figure(stacks, title, same_scale=True)}

    def texts(self, study: Study, table: Table) -> dict[str, str]:
        """Return the table of figures, with an interval where the searches differ."""
        rows = []
        for k, names in enumerate(zip(table.texts["variant"], table.texts["load"], strict=True)):
            value = {name: table.numbers[name][k] for name in self.columns()}
            value["drawn_late_s"] *= MS
            cells = {name: f"{value[name]:.3f}".replace("nan", "none") for name in COLUMNS}
            cells["drawn_late_s"] = f"{value['drawn_late_s']:.1f}"
            ends = [value[f"{name}_m_s"] for name in SEARCHES]
            if not np.ptp(ends) <= 0.03:
                cells["worst_m_s"] += f" to {np.max(ends):.3f}".replace("nan", "?")
            spent = [f"{value[f'{name}_evaluations']:.0f}" for name in SEARCHES]
            rows.append([*names, *cells.values(), " + ".join(spent)])
        head = ["valves; delay", "mesh force", *COLUMNS.values(), "policies tried"]
        return {"bounds.md": "\n".join(markdown(head, rows)) + "\n"}


def _others(study: Study, keys: RowKeys, roots: list[Path]) -> list[Progress]:
    """Return what CMA-ES has of other rows; their later information is waited for."""
    rows = [msgspec.convert(row.settings, RowKeys) for row in study.rows()]
    others = [
        (row.delay_s - keys.delay_s, _newest(roots, row.folder)["cma"])
        for row in rows
        if row != keys
    ]
    return [
        msgspec.structs.replace(other, waits_s=max(0.0, other.waits_s + later_s))
        for later_s, other in others
    ]


def _newest(roots: list[Path], name: str) -> dict[Search, Progress]:
    """Return what is stored of a row in the first folder that has it."""
    folders = [root / name for root in roots if (root / name / "policy.toml").exists()]
    return read_progress((folders or [roots[0] / name])[0])


def judged(problem: Problem, policy: Progress) -> dict[str, float]:
    """Return the hardest stops of a policy in each judgement, and those of the plain push.

    Under the draws a policy may be later than allowed; how late is a figure of its own.
    """
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
    figures["drawn_late_s"] = float(draws.late_s.max())
    for name, load_of_stay in (("open_m_s", "none"), ("damper_m_s", "damper")):
        cases = [
            replace(GEARBOX.cases[0], load=load_of_stay, mesh_force_n=mesh, sync_impulse_n_s=x)
            for mesh in problem.mesh_n
            for x in problem.judge.impulses_n_s.tolist()
        ]
        model = FamilyModel(problem.parameters, replace(GEARBOX, cases=tuple(cases)))
        figures[name] = float(model.arrivals([PUSH.commands]).impact_worst_m_s.max())
    return figures


@cache
def known_m_s(model: str, timing: Timing, mesh_n: tuple[float, ...], evaluations: int) -> float:
    """Return the hardest in m/s of the softest stops found for single loads, each known in advance."""
    parameters = load(model)
    return max(
        softest_alone_m_s(parameters, timing, each, impulse_n_s, evaluations)
        for each in {min(mesh_n), max(mesh_n)}
        for impulse_n_s in (18.0, 78.0, 250.0)
    )

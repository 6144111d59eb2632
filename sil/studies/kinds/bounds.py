"""Rows that are policies: how softly any controller could stop, as far as two searches have found.

A row searches on from what is stored of it. Its figures are those of the softest policy that its valves
can carry out: its own, or that of a row with later information or slower valves. Quicker valves move the
plungers as slower ones do, only sooner, as does the plain push: stops and delays against it are the same.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Annotated, Literal, get_args

import msgspec
import numpy as np

from can_dbc import typed_toml
from can_dbc.errors import InputError
from plant.parameters import load
from sil.campaign.campaign import Campaign, CampaignStroke, campaign_toml
from sil.files.atomic import write_atomically
from sil.files.overrides import toml_value
from sil.report.figure import MS, Figure, Panel, Rule, Series, Stack
from sil.studies.bounds.judge import LATER_S, SHIFTED, Scatter, drawn
from sil.studies.bounds.policy import ANSWER, STEM_SIZE, SwitchingDelays, commands_of, edges_of
from sil.studies.bounds.search import BoundProblem, SearchProgress, softest_alone
from sil.studies.policies import GEARBOX
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
            hardest = {name: float(np.fmax.reduce(x[loads == mesh])) for name, x in numbers.items()}
            rules = [
                Rule(hardest[name], COLUMNS[name], "ink", "y", "dashed")
                for name in ("open_m_s", "damper_m_s")
            ]
            known = np.full(table.size, hardest["known_m_s"])
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
        "exact_m_s": problem.judge_of((Scatter(),)),
        "fine_m_s": problem.judge_of(SHIFTED, 0.25),
    }
    stops_m_s = {name: problem.judged(policy, judge).worst_m_s for name, judge in judges.items()}
    figures = {name: float(worst_m_s[0]) for name, worst_m_s in stops_m_s.items()}
    draws = problem.judged(policy, problem.judge_of(drawn(problem.parameters), 4.0))
    figures["drawn_m_s"] = float(draws.impact_m_s.max())
    figures["drawn_late_share"] = float((draws.late_s > LATER_S).mean())
    figures["open_m_s"] = float(problem.judge.plain.impact_m_s.max())
    damper = problem.judge_of((Scatter(),), load="damper")
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


Search = Literal["cma", "linear"]
SEARCHES: tuple[Search, ...] = get_args(Search)


def read_progress(*folders: Path) -> dict[Search, SearchProgress]:
    """Return what each search has done, by the first folder that has it. Raises InputError for a wrong file."""
    paths = [folder / "policy.toml" for folder in folders]
    stored: dict[Search, SearchProgress] = {}
    for path in [path for path in paths if path.exists()][:1]:
        table = typed_toml.read_toml(path)
        stored = typed_toml.convert(table, dict[Search, SearchProgress], str(path))
        for name, each in stored.items():
            size = STEM_SIZE + 2 * sum(ANSWER.values()) * len(each.knots_s)
            if len(each.values) not in (0, size):
                wrong = f"{name}.values: {len(each.values)} numbers; expected {size}"
                raise InputError(f"{path}: {wrong}, for {len(each.knots_s)} knots")
    return dict.fromkeys(SEARCHES, SearchProgress()) | stored


def write_progress(folder: Path, progress: dict[Search, SearchProgress]) -> None:
    """Write what each search has done so far; what the values are: `sil.studies.bounds.policy`."""
    lines = []
    for name, each in progress.items():
        lines.append(f"[{name}]")
        lines += [f"{key} = {toml_value(x)}" for key, x in msgspec.structs.asdict(each).items()]
    folder.mkdir(parents=True, exist_ok=True)
    write_atomically(folder / "policy.toml", "\n".join(lines) + "\n")


def write_campaign(folder: Path, problem: BoundProblem, policy: SearchProgress) -> None:
    """Write strokes of a policy as campaign.toml, and model.toml with the delays of its valves.

    For commands early, as they are and late, and each mesh force: the least and the greatest impulse and
    that of the hardest stop, which the labels state.
    """
    judge, judgement = problem.judge, problem.judged(policy, problem.judge)
    release_s = judge.release_s(policy.policy).reshape(1, -1)
    edges = edges_of(policy.policy, policy.knots_s, release_s, problem.delay_s, judge.timing)
    scatter = np.arange(release_s.size) // (judge.shape[1] * judge.shape[2])
    edges, strokes = judge.shifted(edges, scatter), list[CampaignStroke]()
    for k, m in np.ndindex(judge.shape[:2]):
        impacts = judgement.impact_m_s[0, k, m]
        for i in sorted({0, int(np.argmax(impacts)), len(impacts) - 1}):
            stroke = int(np.ravel_multi_index((k, m, i), judge.shape))
            conditions = replace(
                GEARBOX[0],
                mesh_force_n=judge.mesh_n[m],
                sync_impulse_n_s=float(judge.impulses_n_s[i]),
                commands=tuple(commands_of(edges, stroke)),
            )
            label = f"{judge.mesh_n[m]:g} N, {judge.impulses_n_s[i]:g} N s, commands "
            label += f"{1e3 * judge.scatter[k].shift_s:+g} ms: {impacts[i]:.4f} m/s"
            strokes.append(CampaignStroke(f"stroke_{len(strokes):02}.csv", label, conditions))
    air = GEARBOX[0].atmosphere_pa, GEARBOX[0].temperature_k
    campaign = Campaign(folder, folder.name, "length", *air, 1000.0, strokes=tuple(strokes))
    write_atomically(folder / "campaign.toml", campaign_toml(campaign, strokes))
    delays = zip(("D_rise", "D_fall"), problem.timing, strict=True)
    form = '{} = {{ value = {}, unit = "s", source = "study bounds" }}'
    lines = [form.format(*each) for each in delays]
    text = "\n".join(["[base]", 'model = "nominal"', "", "[valve]", *lines])
    write_atomically(folder / "model.toml", text + "\n")

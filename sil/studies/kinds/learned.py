"""Rows that are trucks: the shifts of one truck in sequence, with one strategy.

All strategies of a study get the same trucks with the same draws; times and impacts are compared
with the open loop's in the same shift. The control unit's memory goes from each shift to the next.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from can_dbc import typed_toml
from controller.learning import Sensitivities
from sil.files.quantity import counted
from sil.report.figure import MS, Figure, Note, Panel, Rule, Series, Stack
from sil.simulation.in_memory import Run, run_in_memory
from sil.simulation.load_scenario import Loaded
from sil.studies.bound_figures import KNOWN, SHIPPED, known_panel
from sil.studies.figures import title_of
from sil.studies.fleet import EXAM_N_S, OWN, Drawn, Truck, TruckTable, truck_table
from sil.studies.rows import FAILED, PASSED, RowResult
from sil.studies.study import LoadedStudy, Row, texts_of
from sil.studies.table import Table, row_groups

Floats = NDArray[np.float64]
Make = Callable[[Sequence[str]], Loaded]
"""Returns the base scenario with settings PATH=VALUE."""

COLUMNS = (
    "impact_median_m_s",
    "impact_p95_m_s",
    "impact_worst_m_s",
    "lost_median_s",
    "lost_p99_s",
    "lost_worst_s",
    "harder_worst_m_s",
    "lost_gears",
    "beyond_limits",
    "examined_worst_m_s",
    "relearned_shifts",
    "energy_year_j",
    "failed",
)
LEARNED = "learned"
"""The strategy that has a memory, and that claims the two limits."""
COLOURS = 8
"""Of lines; from then on they are dashed."""
MODES = "forgets", "knows"
"""Settings of a strategy: see `run_shifts`."""
TABLES_OPEN_S, TABLES_MESH_N = 0.0083, 1300.0
"""Opening delay and meshing force for which the strategy's programmes were made."""
HARDER_M_S = 0.05
LONGER_S = 0.03
"""Limits against the open loop in the same shift."""
DID_NOT_ARRIVE = "did not arrive"
RELEARNING = 10
"""Shifts over which an impact is averaged to say that it is as before the exchange."""
RELEARNED = 1.1
"""Share of the mean impact before the exchange that counts as that impact."""


@dataclass(frozen=True)
class Outcome:
    """What a shift did: hardest impact, energy of all impacts, time from the request to arrival.

    lost: why the gear was not engaged or not confirmed, empty if it was; then the time is infinite.
    memory: of the control unit, after the shift.
    """

    impact_m_s: float
    energy_j: float
    time_s: float
    lost: str
    memory: bytes


def run_shifts(
    make: Make,
    settings: Mapping[str, Any],
    drawn: Sequence[Drawn],
    memory: bytes = b"",
    forgets: bool = False,
    knows: bool = False,
) -> Iterator[Outcome]:
    """Run drawn shifts one after another and yield what each did; the memory is handed on.

    settings: of the control unit and of other hardware. forgets: the memory is erased instead.
    knows: the unit is given the true numbers of each shift instead (`truth`).
    Raises InputError for settings that the scenario does not accept, RunError if a run cannot finish.
    """
    learns = settings.get("controller.strategy") == LEARNED
    for each in drawn:
        known = each.known if learns else {}
        if knows:
            known, memory = truth(each)
        run = run_in_memory(make(texts_of({**each.settings, **known, **settings})), memory)
        memory = b"" if forgets else run.memory
        yield replace(outcome(run), memory=memory)


def outcome(run: Run) -> Outcome:
    """Return what the last shift of a run did."""
    shift = run.shifts[-1]
    lost = "" if shift.confirmed_s is not None else "was not confirmed"
    if shift.shift_time_s is None:
        lost = DID_NOT_ARRIVE
    return Outcome(
        shift.impact_worst_m_s or 0.0,
        sum(impact.energy_j for impact in shift.impacts),
        math.inf if lost else shift.shift_time_s or 0.0,
        lost,
        run.memory,
    )


def truth(drawn: Drawn) -> tuple[dict[str, Any], bytes]:
    """Return the true numbers of a shift as strategy learned takes them: settings and memory.

    The age of the reported speeds stays unknown: without any doubt of the release it does not count.
    """
    own = (OWN + ".{}").format
    exact = {
        "driveline.noise_rad_s": 0.0,
        own("scatter"): 0.0,
        own("close_s"): drawn.settings["valve.D_fall"],
        own("close_per_k"): 0.0,
        own("open_s_per_k"): 0.0,
        own("opens_later_s"): drawn.settings["valve.D_rise"] - TABLES_OPEN_S,
        own("supply_pa"): drawn.settings["plant.supply_pressure_pa"],
        own("impulse_per_rad_s"): drawn.known[own("impulse_per_rad_s")]
        * (drawn.impulse_n_s / drawn.expected_n_s),
    }
    unit = Sensitivities()
    mesh = drawn.settings["plant.mesh_force_n"] / TABLES_MESH_N - 1.0
    unit.values = [*[0.0] * 13, mesh, 0.0, mesh, 0.0]
    return drawn.known | exact, unit.dump()


def columns(study: LoadedStudy) -> tuple[str, ...]:
    """Return the figures of a truck, then impact and lost time of each of its shifts."""
    numbers = range(1, study.study.fleet.shifts + 1)
    exam = EXAM_N_S if study.study.fleet.examined_after else ()
    return (
        *COLUMNS,
        *(f"impact_m_s {k}" for k in numbers),
        *(f"lost_s {k}" for k in numbers),
        *(f"examined_m_s {each:.0f} N s" for each in exam),
    )


def run(study: LoadedStudy, row: Row) -> RowResult:
    """Run the shifts of the row's truck. Raises InputError for settings that are not accepted."""
    changed, own = row.split({"fleet": ("truck", *MODES), "truck": TruckTable.__struct_fields__})
    number = changed.pop("truck")
    modes = {
        name: typed_toml.convert(changed.pop(name, False), bool, key=f"fleet.{name}")
        for name in MODES
    }
    hardware = {
        name: value
        for name, value in own.items()
        if not name.startswith(("controller.strategy", "plant.damper"))
    }
    fleet = study.study.fleet
    assert study.study.truck is not None
    assert isinstance(number, int)
    table = truck_table(study.study.truck, changed)
    values = nominal(study, hardware)
    drawn, exam = Truck(table, study.study.factor, fleet, number, values).shifts()
    for name in Truck.NOMINAL:
        own.pop(name, None)
        hardware.pop(name, None)
    plain = reference(study, hardware, drawn)
    found = plain
    if own != hardware:
        found = list(run_shifts(study.loaded, own, drawn, b"", **modes))
    at = fleet.examined_after
    examined = [
        math.inf if each.lost else each.impact_m_s
        for shift in exam
        for each in run_shifts(study.loaded, own, [shift], found[at - 1].memory, **modes)
    ]
    impact_m_s = np.array([each.impact_m_s for each in found])
    lost_s = np.array([a.time_s - b.time_s if not a.lost else math.nan
                       for a, b in zip(found, plain, strict=True)])  # fmt: skip
    harder_m_s = impact_m_s - [each.impact_m_s for each in plain]
    exchanged = fleet.exchanged_at if number % 2 == 1 else 0
    reasons = [f"shift {k} {each.lost}" for k, each in enumerate(found, 1) if each.lost]
    beyond = int(np.sum((harder_m_s > HARDER_M_S) | (lost_s > LONGER_S)))
    claimed = own.get("controller.strategy") == LEARNED
    if beyond and claimed:
        reasons.append(f"{counted(beyond, 'shift')} beyond the limits against the open loop")
    year = table.shifts_per_year[0] / len(found)
    figures = (
        *np.quantile(impact_m_s, (0.5, 0.95, 1.0)),
        *quantiles_of(lost_s, (0.5, 0.99, 1.0)),
        harder_m_s.max(),
        sum(bool(each.lost) for each in found),
        beyond,
        max(examined, default=math.nan),
        relearned(impact_m_s / [each.impact_m_s for each in plain], exchanged),
        year * sum(each.energy_j for each in found),
        float(bool(reasons)),
        *impact_m_s.round(4),
        *lost_s.round(5),
        *np.round(examined, 4),
    )
    return RowResult(
        dict(zip(columns(study), map(float, figures), strict=True)),
        FAILED if reasons else PASSED,
        "; ".join(reasons),
    )


def quantiles_of(values: Floats, shares: Sequence[float] | Floats) -> Floats:
    """Return quantiles [shares] of the values that are known, in their unit; NaN if none is."""
    known = values[np.isfinite(values)]
    return np.quantile(known, shares) if len(known) else np.full(len(shares), math.nan)


MOST_REFERENCES = 16
_REFERENCE: dict[str, list[Outcome]] = {}


def reference(
    study: LoadedStudy, hardware: Mapping[str, Any], drawn: Sequence[Drawn]
) -> list[Outcome]:
    """Return what the open loop does in the drawn shifts, without a damper; the latest are stored."""
    key = f"{study.digest} {hardware} {[each.settings['seed'] for each in drawn]} {drawn[-1]}"
    if key not in _REFERENCE:
        if len(_REFERENCE) >= MOST_REFERENCES:
            _REFERENCE.clear()
        _REFERENCE[key] = list(run_shifts(study.loaded, hardware, drawn))
    return _REFERENCE[key]


def nominal(study: LoadedStudy, hardware: Mapping[str, Any]) -> dict[str, float]:
    """Return the values that the tolerances are drawn around: those of the scenario with hardware."""
    loaded = study.loaded(texts_of(hardware))
    line, value = loaded.scenario.driveline, loaded.parameters.value
    valves = (value(name) for name in Truck.NOMINAL[:-2])
    return dict(zip(Truck.NOMINAL, (*valves, line.cone_gain_m, line.inertia_kg_m2), strict=True))


def relearned(share: Floats, exchanged_at: int) -> float:
    """Return the shifts after an exchange until the impacts are as they were before it.

    share: [shifts], impact by the open loop's impact; exchanged_at: number of the first shift
    with the other valves, 0 for none (NaN is returned). Infinite if the impacts stay harder.
    """
    if not exchanged_at:
        return math.nan
    before = share[max(0, exchanged_at - 1 - 2 * RELEARNING) : exchanged_at - 1].mean()
    after = share[exchanged_at - 1 :]
    for k in range(len(after) - RELEARNING + 1):
        if after[k : k + RELEARNING].mean() <= RELEARNED * before:
            return float(k)
    return math.inf


def series(table: Table, name: str, rows: NDArray[np.int64]) -> Floats:
    """Return a figure of all shifts [rows, shifts] of a table's rows, in the figure's unit."""
    found = [values[rows] for key, values in table.numbers.items() if key.startswith(f"{name} ")]
    return np.array(found).T


HEAD = ("strategy", "impact, median", "95 %", "worst", "lost, median", "99 %", "worst",
        "harder than open loop", "lost gears", "beyond limits", "examined, median truck",
        "worst truck", "relearned after", "energy a year")  # fmt: skip


def files(study: LoadedStudy, table: Table) -> Iterator[tuple[str, str]]:
    """Yield the table of the groups as Markdown."""
    yield "learned.md", _markdown(study, table)


def _markdown(study: LoadedStudy, table: Table) -> str:
    """Return the strategies side by side over all shifts of all trucks, as a table in Markdown."""
    lines = [HEAD, ["---"] * len(HEAD)]
    for label, rows in row_groups(study, table).items():
        impact_m_s, lost_s = series(table, "impact_m_s", rows), series(table, "lost_s", rows)
        number = {name: table.numbers[name][rows] for name in COLUMNS}
        again = number["relearned_shifts"][~np.isnan(number["relearned_shifts"])]
        exam_m_s = number["examined_worst_m_s"]
        lines.append([
            label,
            *(f"{each:.2f} m/s" for each in np.quantile(impact_m_s, (0.5, 0.95, 1.0))),
            *(f"{MS * each:.0f} ms" for each in quantiles_of(lost_s, (0.5, 0.99, 1.0))),
            f"{number['harder_worst_m_s'].max():.2f} m/s",
            f"{number['lost_gears'].sum():.0f}",
            f"{number['beyond_limits'].sum():.0f}",
            *(f"{each:.2f} m/s" for each in (np.median(exam_m_s), exam_m_s.max())),
            f"{np.median(again):.0f} shifts, at most {again.max():.0f}".replace("inf", "never") if len(again) else "",
            f"{np.mean(number['energy_year_j']) / 1000.0:.0f} kJ",
        ])  # fmt: skip
    return "".join("| " + " | ".join(cells) + " |\n" for cells in lines)


def figures(study: LoadedStudy, table: Table) -> dict[str, Figure]:
    """Return what is possible and how fast it is learned; how often each impact and lost time is."""
    fleet, groups = study.study.fleet, row_groups(study, table)
    text = f"{counted(fleet.trucks, 'truck')}, {counted(fleet.shifts, 'shift')} each"
    stacks = [Stack("shift", [_learning(study, table)], width=7.0)]
    if fleet.examined_after:
        stacks.insert(0, Stack(KNOWN, [_possible(study, table)], width=7.0))
    often = []
    for name, title, axis, factor in (
        ("impact_m_s", "Shifts with a softer impact", "hardest impact, m/s", 1.0),
        ("lost_s", "Shifts that lose less time", "time lost against the open loop, ms", MS),
    ):
        shares = np.linspace(0.0, 100.0, 201)
        lines = [
            Series(label, factor * quantiles_of(series(table, name, rows), 0.01 * shares), shares,
                   f"series{k % COLOURS}", dashed=k >= COLOURS, width=2.0)
            for k, (label, rows) in enumerate(groups.items())
        ]  # fmt: skip
        panel = Panel(title, "%", lines, limits=(0.0, 100.0), height=380)
        often.append(Stack(axis, [panel], width=6.0))
    title = title_of(study)
    return {"learned": Figure(stacks, title, text), "how_often": Figure(often, title, text)}


def _learning(study: LoadedStudy, table: Table) -> Panel:
    """Return median and, of few strategies, 95 % quantile of the impacts over the shifts."""
    lines: list[Series] = []
    groups = row_groups(study, table)
    few = len(groups) <= COLOURS
    for k, (label, rows) in enumerate(groups.items()):
        x, parts = blocks(series(table, "impact_m_s", rows))
        wanted = [(label, 0.5, k >= COLOURS, 2.2)]
        if few:
            wanted.append((f"{label}, 95 %", 0.95, True, 1.2))
        for name, share, dashed, width in wanted:
            y = np.array([np.quantile(part, share) for part in parts])
            lines.append(Series(name, x, y, f"series{k % COLOURS}", dashed=dashed, width=width))
    at = study.study.fleet.exchanged_at
    rules = [Rule(float(at), "valves of every second truck exchanged", "alarm")] if at else []
    title = "Hardest impact, median and 95 %" if few else "Hardest impact, median"
    return Panel(title, "m/s", lines, rules=rules, height=400)


def _possible(study: LoadedStudy, table: Table) -> Panel:
    """Return the bounds over how well an impulse is known, and on them the trucks' examinations.

    A strategy is drawn at two standard deviations of the scatter between shifts: 95 % of them, at 0
    if it is given the true numbers; those at one scatter are drawn next to each other.
    """
    with open(SHIPPED.with_name("bounds_known.csv"), encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    names = "bound.known", "bound.delay_s", "bound_m_s", "open_loop_m_s", "damper_m_s"
    panel = known_panel({name: np.array([float(row[name]) for row in rows]) for name in names})
    assert study.study.truck is not None
    scatter = {choice.name: choice.set.get("truck.cone_shift") for choice in study.study.load}
    knows = {each.name for each in study.study.strategy if each.set.get("fleet.knows")}
    points = []
    groups = row_groups(study, table)
    for k, (label, which) in enumerate(groups.items()):
        sd = scatter.get(label.split(" / ")[-1])
        sd = study.study.truck.cone_shift[0] if sd is None else sd
        x = 0.0 if label.split(" / ")[0] in knows else 200.0 * float(sd)  # type: ignore[arg-type]
        exam_m_s = table.numbers["examined_worst_m_s"][which]
        ends = np.array([np.median(exam_m_s), exam_m_s.max()])
        apart = 0.4 * (k - len(groups) // 2) if x else 0.0
        role, dashed = f"series{k % COLOURS}", k >= COLOURS
        points.append(Series(label, np.full(2, x + apart), ends, role, "marked", dashed, 4.0))
    assumed = 200.0 * study.study.truck.cone_shift[0]
    note = Note(assumed, 0.08, "scatter between shifts, 2 sd: assumed", "faint", "left")
    return replace(
        panel,
        title=f"Hardest of {len(EXAM_N_S)} impulses: median and worst truck",
        series=[*panel.series, *points],
        rules=[*panel.rules, Rule(assumed, "", "faint")],
        notes=[*panel.notes, note],
    )


def blocks(values: Floats) -> tuple[Floats, list[Floats]]:
    """Return the middles of some 20 runs of shifts, and the values [trucks, shifts] of each."""
    edges = np.unique(np.linspace(0, values.shape[1], min(20, values.shape[1]) + 1).astype(int))
    parts = [values[:, a:b].ravel() for a, b in pairwise(edges)]
    return 0.5 * (edges[:-1] + edges[1:] + 1), parts

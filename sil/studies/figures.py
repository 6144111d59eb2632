"""Figures that several kinds of studies share: metrics over what was swept or chosen."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from plant.parameters import load
from sil.files import quantity
from sil.report.figure import Band, ColourScale, Figure, Floats, Note, Panel, Series, Span, Stack
from sil.report.theme import SERIES
from sil.studies.rows import columns
from sil.studies.study import LoadedStudy, Sweep
from sil.studies.table import Table, row_groups

Ints = NDArray[np.int64]
MOST_DOTS = 2000
"""Of a larger study every so-many-th row is drawn as a dot; results.csv has them all."""

COLOURS = SERIES
UNITS = {"_m_s": ("m/s", 1.0), "_s": ("ms", 1e3), "_m": ("mm", 1e3), "_pa": ("bar", 1e-5),
         "_j": ("J", 1.0), "_kg": ("g", 1e3)}  # fmt: skip


def shown(metric: str) -> tuple[str, str, float]:
    """Return title, unit and factor with which a metric is shown."""
    for suffix, (unit, factor) in UNITS.items():
        if metric.endswith(suffix):
            return metric.removesuffix(suffix).replace("_", " "), unit, factor
    return metric.replace("_", " "), "", 1.0


def _scaled(table: Table, metric: str) -> tuple[str, str, Floats]:
    title, unit, factor = shown(metric)
    return title, unit, factor * table.numbers[metric]


def _named(title: str, unit: str) -> str:
    return f"{title}, {unit}" if unit else title


def title_of(study: LoadedStudy) -> str:
    """Return the name of a study as the title of a figure."""
    return study.study.name.replace("_", " ")


def read_metrics(study: LoadedStudy) -> list[str]:
    """Return the metrics to show first."""
    known = columns(study)
    default = ["impact_speed_m_s", "shift_time_s" if "shift_time_s" in known else "arrival_s"]
    return [name for name in study.study.reads or default if name in known]


def swept_figures(study: LoadedStudy, table: Table) -> dict[str, Figure]:
    """Return the figures of a study of shifts or strokes by name: map, lines or choices."""
    found = {}
    numeric = [sweep for sweep in study.study.sweep if sweep.path in table.numbers]
    has_values = np.isfinite(table.numbers[read_metrics(study)[0]]).any()
    is_grid = study.study.design.kind == "grid" and len(numeric) == len(study.study.sweep) == 2
    if is_grid and has_values:
        found["map"] = _map_figure(study, table)
    stacks = [stack for sweep in numeric if (stack := _lines_over(study, table, sweep)) is not None]
    if study.study.design.kind in ("lhs", "sobol") and len(read_metrics(study)) > 1:
        found["pareto"] = pareto_figure(study, table)
    if stacks:
        found["lines"] = Figure(stacks, title_of(study), same_scale=True)
    elif has_values and not study.study.safety:
        found["choices"] = choices_figure(study, table)
    return found


def pareto_figure(
    study: LoadedStudy,
    table: Table,
    references: Mapping[str, Mapping[str, Mapping[str, float]]] | None = None,
) -> Figure:
    """Return the first metric over each of the others shown first, with the front of each group.

    A row is on the front if no other of its group is better in both. references: figures that are
    marked by name, by group.
    """
    first, *others = read_metrics(study)
    title, unit, y = _scaled(table, first)
    stacks = []
    for other in others:
        name, other_unit, x = _scaled(table, other)
        lines, notes = [], []
        for k, (label, rows) in enumerate(row_groups(study, table).items()):
            rows = rows[np.isfinite(x[rows]) & np.isfinite(y[rows])]
            rows = rows[np.argsort(x[rows], kind="stable")]
            lowest = np.minimum.accumulate(y[rows])
            front = rows[np.append(True, lowest[1:] < lowest[:-1])] if len(rows) else rows
            role = f"series{k % COLOURS}"
            dots = rows[:: -(-len(rows) // MOST_DOTS) or 1]
            lines.append(Series("", x[dots], y[dots], role, "dots", width=1.5))
            lines.append(Series(label or "front", x[front], y[front], role, "stepped", width=2.4))
            for text, figures in (references or {}).get(label, {}).items():
                at, high = (shown(metric)[2] * figures[metric] for metric in (other, first))
                lines.append(Series("", np.array([at]), np.array([high]), "ink", "dots", width=3.0))
                notes.append(Note(at, high, text, role, up=6.0 if k % 2 else -6.0, bold=True))
        panel = Panel(title, unit, lines, notes=notes, height=320)
        stacks.append(Stack(f"{name}, {other_unit}", [panel], width=5.5))
    return Figure(stacks, title_of(study), "lines: the front, nothing is better in both")


def unit_of(sweep: Sweep) -> tuple[str, float]:
    """Return the unit in which a swept value is shown, and its factor; times are in ms.

    Without `unit` and `label`, a parameter of the plant has its own and a setting that of its name.
    """
    unit = sweep.unit
    if not unit and not sweep.label:
        model = load()
        own = (
            model.entries[sweep.path].unit if sweep.path in model else quantity.unit_of(sweep.path)
        )
        unit = own.replace("-", "")
    return ("ms", 1e3) if unit == "s" else (unit, 1.0)


def axis_of(sweep: Sweep) -> tuple[str, float]:
    """Return the label of a swept value's axis with its unit, and the factor."""
    unit, factor = unit_of(sweep)
    return _named(sweep.label or sweep.path, unit), factor


def row_labels(study: LoadedStudy, table: Table) -> list[str]:
    """Return the choices and swept values of each row as a label; the study's name without any."""
    parts = [table.texts[name] for name in study.groups]
    for sweep in study.study.sweep:
        unit, factor = unit_of(sweep)
        if sweep.path in table.texts:
            values = [text.strip('"') for text in table.texts[sweep.path]]
        else:
            values = [f"{factor * value:g} {unit}".strip() for value in table.numbers[sweep.path]]
        parts.append([f"{sweep.label or sweep.path} {value}" for value in values])
    return [", ".join(each) for each in zip(*parts, strict=True)] or [study.study.name] * table.size


def _lines_over(study: LoadedStudy, table: Table, sweep: Sweep) -> Stack | None:
    """Return each metric over a swept value, None where it has one value only.

    Where values repeat, a group of rows is a line of medians in a band from least to greatest;
    otherwise each row is a dot.
    """
    axis, factor = axis_of(sweep)
    at = factor * table.numbers[sweep.path]
    if len(np.unique(at)) < 2:
        return None
    groups = row_groups(study, table)
    looks = _group_looks(list(groups))
    panels = []
    for metric in read_metrics(study):
        title, unit, y = _scaled(table, metric)
        lines, bands = [], []
        for name, rows in groups.items():
            role, dashed = looks[name]
            as_line = len(study.study.sweep) == 1 or len(np.unique(at[rows])) < 0.6 * len(rows)
            rows = rows[~np.isnan(y[rows])]
            if as_line:
                levels = np.unique(at[rows])
                values = [y[rows][at[rows] == level] for level in levels]
                low, middle, high = (
                    np.array([f(each) for each in values]) for f in (np.min, np.median, np.max)
                )
                lines.append(Series(name, levels, middle, role, "marked", dashed))
                if len(levels) < len(rows):
                    bands.append(Band(levels, low, high, role))
            else:
                rows = rows[rows % -(-table.size // MOST_DOTS) == 0]
                rows = rows[np.argsort(at[rows], kind="stable")]
                lines.append(Series(name, at[rows], y[rows], role, "dots"))
        lines = [line for line in lines if len(line.x)]
        if lines:
            title += ", median" if bands else ""
            panels.append(Panel(title, unit, lines, bands, height=240))
    if not panels:
        return None
    logarithmic = sweep.scale == "log" and float(np.min(at)) > 0.0
    name = f"Over {sweep.label or sweep.path}"
    return Stack(axis, panels, name, logarithmic=logarithmic, width=5.2)


def _group_looks(names: Sequence[str]) -> dict[str, tuple[str, bool]]:
    """Return colour and dashing of each group: of more than the colours, one for each last choice."""
    if len(names) <= COLOURS:
        return {name: (f"series{k}", False) for k, name in enumerate(names)}
    parts = [name.rpartition(" / ") for name in names]
    first, _, last = (list(dict.fromkeys(each)) for each in zip(*parts, strict=True))
    return {
        name: (f"series{last.index(after) % COLOURS}", first.index(before) % 2 == 1)
        for name, (before, _slash, after) in zip(names, parts, strict=True)
    }


class Choices(NamedTuple):
    """The rows by their choices: the kind with the most options, and combinations of the others.

    option: [rows] number of each row's option in `names`. series: row numbers by combination, in one
    series if there are more combinations than colours.
    """

    kind: str
    names: list[str]
    option: Ints
    series: dict[str, Ints]


def choices(study: LoadedStudy, table: Table) -> Choices:
    """Return the choices of each row: loads and the like, and swept values that are no numbers."""
    kinds = {name: name for name in study.groups}
    kinds |= {s.path: s.label or s.path for s in study.study.sweep if s.path in table.texts}
    if not kinds:
        rows = np.arange(table.size)
        return Choices("", [study.study.name], np.zeros_like(rows), {"": rows})
    options = {kind: list(dict.fromkeys(table.texts[kind])) for kind in kinds}
    widest = max(kinds, key=lambda kind: len(options[kind]))
    index = np.array([options[widest].index(name) for name in table.texts[widest]])
    others = [table.texts[kind] for kind in kinds if kind != widest]
    labels = [" / ".join(parts) for parts in zip(*others, strict=True)]
    if not labels or len(set(labels)) > COLOURS:
        labels = [""] * table.size
    series = {name: np.flatnonzero(np.array(labels) == name) for name in dict.fromkeys(labels)}
    return Choices(kinds[widest], options[widest], index, series)


def choices_figure(study: LoadedStudy, table: Table) -> Figure:
    """Return each metric by choice: a dot at the median, a line from least to greatest."""
    by = choices(study, table)
    offsets = np.linspace(-0.3, 0.3, len(by.series)) if len(by.series) > 1 else [0.0]
    panels = []
    for metric in read_metrics(study):
        title, unit, y = _scaled(table, metric)
        lines, spans, repeated = [], [], False
        for k, (name, rows) in enumerate(by.series.items()):
            role, medians = f"series{k}", {}
            for option in range(len(by.names)):
                values = y[rows[(by.option[rows] == option) & ~np.isnan(y[rows])]]
                if len(values):
                    repeated |= len(values) > 1
                    at = option + offsets[k]
                    medians[at] = float(np.median(values))
                    ends = float(values.min()), float(values.max())
                    spans.append(Span(at - 0.01, at + 0.01, role, "", *ends))
            if medians:
                points = np.array(list(medians.items())).T
                lines.append(Series(name, points[0], points[1], role, "dots", width=3.0))
        if lines:
            title += ", median" if repeated else ""
            panels.append(Panel(title, unit, lines, spans=spans, height=240))
    ticks, width = numbered(by.names), max(6.0, 0.8 * len(by.names))
    stack = Stack(by.kind, panels, f"By {by.kind}" if by.kind else "", ticks=ticks, width=width)
    return Figure([stack], title_of(study))


def _map_figure(study: LoadedStudy, table: Table) -> Figure:
    """Return the greatest value of the first metric over a grid, a map for each group of rows."""
    title, unit, values = _scaled(table, read_metrics(study)[0])
    ends = float(np.nanmin(values)), float(np.nanmax(values))
    scale = ColourScale(_named(title, unit), *ends)
    stacks = []
    for name, rows in row_groups(study, table).items():
        panel = map_panel(study, table, grid_of(study, table, rows, values), scale)
        stacks.append(map_stack(study, table, [panel], name))
    return Figure(stacks, title_of(study), same_scale=True)


def grid_of(study: LoadedStudy, table: Table, rows: Ints, values: Floats) -> Floats:
    """Return the greatest of the values [rows] at each point of a grid [second sweep, first sweep].

    values: of all rows of the table, in any unit. NaN where no row has a value.
    """
    i, j = cells_of(study, table)
    grid = np.full((i.max() + 1, j.max() + 1), np.nan)
    np.fmax.at(grid, (i[rows], j[rows]), values[rows])
    return grid


def cells_of(study: LoadedStudy, table: Table) -> tuple[Ints, Ints]:
    """Return the grid indices [rows] of each row of the table: second sweep, first sweep."""
    first, second = (table.numbers[sweep.path] for sweep in study.study.sweep)
    return np.searchsorted(np.unique(second), second), np.searchsorted(np.unique(first), first)


def map_panel(
    study: LoadedStudy, table: Table, grid: Floats, scale: ColourScale, frames: Sequence[Span] = ()
) -> Panel:
    """Return a map of a grid [second sweep, first sweep], in the unit of the scale."""
    axis, ticks = _swept_ticks(table, study.study.sweep[1])
    spans = [*scale.cells(grid, ("{:.2f}" if grid.size <= 100 else "").format), *frames]
    limits = (-0.5, grid.shape[0] - 0.5)
    return Panel(axis, spans=spans, scale=scale, ticks=ticks, limits=limits, height=260)


def map_stack(study: LoadedStudy, table: Table, panels: Sequence[Panel], title: str) -> Stack:
    """Return maps one above the other over the first swept value."""
    axis, ticks = _swept_ticks(table, study.study.sweep[0])
    return Stack(axis, panels, title, ticks=ticks, width=3.6)


def _swept_ticks(table: Table, sweep: Sweep) -> tuple[str, list[tuple[float, str]]]:
    """Return the axis of a swept value and (index, text) for at most about ten of its values."""
    axis, factor = axis_of(sweep)
    levels = np.unique(factor * table.numbers[sweep.path])
    stride = -(-len(levels) // 10)
    return axis, [(float(k), f"{v:g}") for k, v in enumerate(levels) if k % stride == 0]


def numbered(names: Mapping[str, object] | Sequence[str]) -> list[tuple[float, str]]:
    """Return (index, name) for the ticks of a named axis."""
    return [(float(k), name) for k, name in enumerate(names)]

"""Figures that several kinds of studies share: metrics over what was swept or chosen."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from plant.parameters import load
from sil.files import quantity
from sil.report.figure import Band, ColourScale, Figure, Note, Panel, Series, Span, Stack
from sil.report.theme import SERIES
from sil.studies.design import SweptValue
from sil.studies.study import Study, Table
from sil.studies.table import read_metrics

MAX_DOTS = 2000  # of a larger study every so-many-th row is drawn as a dot


class Metric(NamedTuple):
    """How a metric is shown: its title, its unit, and the factor from SI to it."""

    title: str
    unit: str
    factor: float

    @property
    def axis(self) -> str:
        """The title with the unit."""
        return ", ".join(filter(None, (self.title, self.unit)))


def metric_of(name: str) -> Metric:
    """Return how the metric of a column is shown."""
    if name == "arrival_s":
        return Metric("stop, after the begin of the stroke", "ms", 1e3)
    for suffix, unit, factor in (
        *(("_m_s", "m/s", 1.0), ("_s", "ms", 1e3), ("_m", "mm", 1e3)),
        *(("_pa", "bar", 1e-5), ("_j", "J", 1.0), ("_kg", "g", 1e3)),
    ):
        if name.endswith(suffix):
            return Metric(name.removesuffix(suffix).replace("_", " "), unit, factor)
    return Metric(name.replace("_", " "), "", 1.0)


def sweep_metric(sweep: SweptValue) -> Metric:
    """Return how a swept value is shown, times in ms, without `unit` and `label` in its own unit."""
    unit = sweep.unit
    if not unit and not sweep.label:
        entry = load().entries.get(sweep.path)
        unit = (quantity.unit_of(sweep.path) if entry is None else entry.unit).replace("-", "")
    return Metric(sweep.title, *(("ms", 1e3) if unit == "s" else (unit, 1.0)))


def title_of(study: Study) -> str:
    """Return the name of a study as the title of a figure."""
    return study.file.name.replace("_", " ")


def numbered(names: Mapping[str, object] | Sequence[str]) -> list[tuple[float, str]]:
    """Return (index, name) for the ticks of a named axis."""
    return [(float(k), name) for k, name in enumerate(names)]


def row_labels(study: Study, table: Table) -> list[str]:
    """Return the choices and swept values of each row as a label; the study's name without any."""
    parts = [table.texts[name] for name in study.file.groups]
    for sweep in study.file.sweep:
        title, unit, factor = sweep_metric(sweep)
        if sweep.path in table.texts:
            values = [text.strip('"') for text in table.texts[sweep.path]]
        else:
            values = [f"{factor * value:g} {unit}".strip() for value in table.numbers[sweep.path]]
        parts.append([f"{title} {value}" for value in values])
    return [", ".join(each) for each in zip(*parts, strict=True)] or [study.file.name] * table.size


def swept_figures(study: Study, table: Table, with_choices: bool = True) -> dict[str, Figure]:
    """Return the figures of a study of shifts or strokes by name: map, lines or choices."""
    design, metrics = study.file.design.kind, read_metrics(study)
    numeric = [sweep for sweep in study.file.sweep if sweep.path in table.numbers]
    has_values = np.isfinite(table.numbers[metrics[0]]).any()
    figures = {}
    if design == "grid" and len(numeric) == len(study.file.sweep) == 2 and has_values:
        figures["map"] = _map_figure(study, table)
    if design in ("lhs", "sobol") and len(metrics) > 1:
        figures["pareto"] = pareto_figure(study, table)
    stacks = [stack for sweep in numeric if (stack := _lines_over(study, table, sweep)) is not None]
    if stacks:
        figures["lines"] = Figure(stacks, title_of(study), same_scale=True)
    elif has_values and with_choices:
        figures["choices"] = choices_figure(study, table)
    return figures


def pareto_figure(
    study: Study,
    table: Table,
    references: Mapping[str, Mapping[str, Mapping[str, float]]] | None = None,
) -> Figure:
    """Return the first metric over each other one, with the front of each group: none better in both.

    references: figures that are marked by name, by group.
    """
    first, *others = read_metrics(study)
    title, unit, factor = metric_of(first)
    y = factor * table.numbers[first]
    stacks = []
    for other in others:
        across = metric_of(other)
        x = across.factor * table.numbers[other]
        lines, notes = [], []
        for k, (label, rows) in enumerate(study.row_groups(table).items()):
            rows = rows[np.isfinite(x[rows]) & np.isfinite(y[rows])]
            rows = rows[np.argsort(x[rows], kind="stable")]
            lowest = np.minimum.accumulate(y[rows])
            front = rows[np.append(True, lowest[1:] < lowest[:-1])] if len(rows) else rows
            role = f"series{k % SERIES}"
            dots = rows[:: -(-len(rows) // MAX_DOTS) or 1]
            lines.append(Series("", x[dots], y[dots], role, "dots", width=1.5))
            lines.append(Series(label or "front", x[front], y[front], role, "stepped", width=2.4))
            for text, figures in (references or {}).get(label, {}).items():
                at, high = across.factor * figures[other], factor * figures[first]
                lines.append(Series("", np.array([at]), np.array([high]), "ink", "dots", width=3.0))
                notes.append(Note(at, high, text, role, up=6.0 if k % 2 else -6.0, bold=True))
        panel = Panel(title, unit, lines, notes=notes, height=320)
        stacks.append(Stack(across.axis, [panel], width=5.5))
    return Figure(stacks, title_of(study), "lines: the front, nothing is better in both")


def _lines_over(study: Study, table: Table, sweep: SweptValue) -> Stack | None:
    """Return each metric over a swept value, groups as medians in a band where values repeat, else as dots."""
    across = sweep_metric(sweep)
    at = across.factor * table.numbers[sweep.path]
    if len(np.unique(at)) < 2:
        return None
    groups = study.row_groups(table)
    looks = _group_looks(list(groups))
    panels = []
    for metric in read_metrics(study):
        title, unit, factor = metric_of(metric)
        y = factor * table.numbers[metric]
        lines, bands = [], []
        for name, rows in groups.items():
            role, dashed = looks[name]
            as_line = len(study.file.sweep) == 1 or len(np.unique(at[rows])) < 0.6 * len(rows)
            rows = rows[~np.isnan(y[rows])]
            if as_line:
                levels = np.unique(at[rows])
                values = [y[rows][at[rows] == level] for level in levels]
                ends = [(each.min(), np.median(each), each.max()) for each in values]
                low, middle, high = np.array(ends).reshape(-1, 3).T
                lines.append(Series(name, levels, middle, role, "marked", dashed))
                if len(levels) < len(rows):
                    bands.append(Band(levels, low, high, role))
            else:
                rows = rows[rows % -(-table.size // MAX_DOTS) == 0]
                rows = rows[np.argsort(at[rows], kind="stable")]
                lines.append(Series(name, at[rows], y[rows], role, "dots"))
        lines = [line for line in lines if len(line.x)]
        if lines:
            title += ", median" if bands else ""
            panels.append(Panel(title, unit, lines, bands, height=240))
    if not panels:
        return None
    logarithmic = sweep.scale == "log" and float(np.min(at)) > 0.0
    return Stack(across.axis, panels, f"Over {across.title}", logarithmic=logarithmic, width=5.2)


def _group_looks(names: Sequence[str]) -> dict[str, tuple[str, bool]]:
    """Return colour and dashing of each group: of more than the colours, one for each last choice."""
    if len(names) <= SERIES:
        return {name: (f"series{k}", False) for k, name in enumerate(names)}
    parts = [name.rpartition(" / ") for name in names]
    first, _, last = (list(dict.fromkeys(each)) for each in zip(*parts, strict=True))
    return {
        name: (f"series{last.index(after) % SERIES}", first.index(before) % 2 == 1)
        for name, (before, _slash, after) in zip(names, parts, strict=True)
    }


def choices_figure(study: Study, table: Table) -> Figure:
    """Return each metric by choice: a dot at the median, a line from least to greatest.

    The kind of choice with the most options is the axis; combinations of the others have colours, if enough.
    """
    kinds = {name: name for name in study.file.groups}
    kinds |= {s.path: s.title for s in study.file.sweep if s.path in table.texts}
    names = {kind: list(dict.fromkeys(table.texts[kind])) for kind in kinds}
    widest = max(kinds, key=lambda kind: len(names[kind]), default="")
    ticks = names.get(widest, [study.file.name])
    place = np.array([ticks.index(name) for name in table.texts.get(widest, ticks * table.size)])
    others = [table.texts[kind] for kind in kinds if kind != widest]
    labels = [" / ".join(parts) for parts in zip(*others, strict=True)] or [""] * table.size
    if len(set(labels)) > SERIES:
        labels = [""] * table.size
    series = list(dict.fromkeys(labels))
    offsets = np.linspace(-0.3, 0.3, len(series)) if len(series) > 1 else [0.0]
    panels = []
    for metric in read_metrics(study):
        title, unit, factor = metric_of(metric)
        y = factor * table.numbers[metric]
        lines, spans, repeated = [], [], False
        for k, name in enumerate(series):
            role, medians = f"series{k}", {}
            for option in range(len(ticks)):
                of_choice = (np.array(labels) == name) & (place == option)
                values = y[of_choice & ~np.isnan(y)]
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
    kind, width = kinds.get(widest, ""), max(6.0, 0.8 * len(ticks))
    title = f"By {kind}" if kind else ""
    return Figure([Stack(kind, panels, title, ticks=numbered(ticks), width=width)], title_of(study))


def _map_figure(study: Study, table: Table) -> Figure:
    """Return the greatest value of the first metric over a grid, a map for each group of rows."""
    metric = metric_of(read_metrics(study)[0])
    values = metric.factor * table.numbers[read_metrics(study)[0]]
    scale = ColourScale(metric.axis, float(np.nanmin(values)), float(np.nanmax(values)))
    places, axes, ticks = [], [], []
    for sweep in study.file.sweep:
        levels, place = np.unique(table.numbers[sweep.path], return_inverse=True)
        across, stride = sweep_metric(sweep), -(-len(levels) // 10)
        places.append(place)
        axes.append(across.axis)
        texts = [f"{value:g}" for value in np.unique(across.factor * levels)]
        ticks.append([(float(k), text) for k, text in enumerate(texts) if k % stride == 0])
    stacks = []
    for name, rows in study.row_groups(table).items():
        grid = np.full((places[1].max() + 1, places[0].max() + 1), np.nan)
        np.fmax.at(grid, (places[1][rows], places[0][rows]), values[rows])
        spans = scale.cells(grid, ("{:.2f}" if grid.size <= 100 else "").format)
        limits = (-0.5, grid.shape[0] - 0.5)
        panel = Panel(axes[1], spans=spans, scale=scale, ticks=ticks[1], limits=limits, height=260)
        stacks.append(Stack(axes[0], [panel], name, ticks=ticks[0], width=3.6))
    return Figure(stacks, title_of(study), same_scale=True)

"""Pictures of a study: metrics over what was swept, and curves over time for its variants."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sil.report.theme import LIGHT
from sil.studies import kind_pictures
from sil.studies.figure_style import COLOURS, saved, shown
from sil.studies.kinds.stroke import CHAMBERS, stroke_of
from sil.studies.rows import columns
from sil.studies.study import LoadedStudy
from sil.studies.table import Table, row_groups

Ints = NDArray[np.int64]
LINES = ("-", "--", ":", "-.")
MOST_CURVES = 12
"""The most rows of a plant-only study that are drawn over time."""


def draw(study: LoadedStudy, table: Table, folder: Path) -> list[Path]:
    """All pictures that this study's shape allows, as PNG and SVG files; the PNGs' paths."""
    import matplotlib

    matplotlib.use("Agg")
    if study.study.kind != "runs":
        if study.study.kind == "bounds":
            return [kind_pictures.draw_bounds(study, table, folder)]
        if study.study.kind == "budget":
            return [kind_pictures.draw_budget(study, table, folder)]
        return kind_pictures.draw_tuning(study, table, folder)
    made = []
    numeric = [s.path for s in study.study.sweep if s.path in table.numbers]
    if study.study.design.kind == "grid" and len(numeric) == 2 and len(study.study.sweep) == 2:
        made.append(draw_map(study, table, folder))
    if numeric:
        made.append(draw_lines(study, table, folder))
    if study.study.stroke is not None and study.size <= MOST_CURVES:
        made.append(draw_curves(study, folder))
    if not made and not study.study.safety:
        made.append(draw_choices(study, table, folder))
    return made


def read_metrics(study: LoadedStudy) -> list[str]:
    """The metrics to show first."""
    known = columns(study)
    default = ["impact_speed_m_s", "shift_time_s" if "shift_time_s" in known else "arrival_s"]
    return [name for name in study.study.reads or default if name in known]


def draw_lines(study: LoadedStudy, table: Table, folder: Path) -> Path:
    """Each metric against each swept value; a grid's other values as a band of least to greatest."""
    from matplotlib import pyplot

    metrics = read_metrics(study)
    sweeps = [s for s in study.study.sweep if s.path in table.numbers]
    figure, axes = pyplot.subplots(
        len(metrics),
        len(sweeps),
        figsize=(4.8 * len(sweeps) + 1.5, 3.4 * len(metrics)),
        squeeze=False,
        sharey="row",
    )
    groups = row_groups(study, table)
    looks = line_looks(list(groups))
    for row, metric in enumerate(metrics):
        label, factor = shown(metric)
        for column, sweep in enumerate(sweeps):
            axis = axes[row][column]
            for name, rows in groups.items():
                x = table.numbers[sweep.path][rows]
                y = table.numbers[metric][rows] * factor
                colour, line = looks[name]
                levels = np.unique(x)
                if len(levels) < 0.6 * len(x) or len(sweeps) == 1:
                    with_values = [v for v in levels if not np.all(np.isnan(y[x == v]))]
                    middle = [np.nanmedian(y[x == v]) for v in with_values]
                    low = [np.nanmin(y[x == v]) for v in with_values]
                    high = [np.nanmax(y[x == v]) for v in with_values]
                    axis.plot(
                        with_values, middle, "o", ls=line, ms=3, color=colour, label=name or None
                    )
                    axis.fill_between(with_values, low, high, color=colour, alpha=0.12, lw=0)
                else:
                    axis.plot(x, y, ".", ms=3, alpha=0.5, color=colour, label=name or None)
            if sweep.scale == "log":
                axis.set_xscale("log")
            axis.grid(alpha=0.3)
            if column == 0:
                axis.set_ylabel(label)
            if row == len(metrics) - 1:
                unit = f", {sweep.unit}" if sweep.unit else ""
                axis.set_xlabel(f"{sweep.label or sweep.path}{unit}")
    handles, labels = axes[0][0].get_legend_handles_labels()
    if labels:
        axes[0][-1].legend(
            handles, labels, frameon=False, fontsize=8, loc="upper left", bbox_to_anchor=(1.01, 1.0)
        )
    figure.suptitle(study.study.name.replace("_", " "), x=0.02, ha="left", fontweight="bold")
    return saved(figure, folder / "lines.png")


def line_looks(names: Sequence[str]) -> dict[str, tuple[str, str]]:
    """Colour and line of each group: of more than there are colours, one for load, one for the rest."""
    if len(names) <= len(COLOURS):
        return {name: (COLOURS[k], "-") for k, name in enumerate(names)}
    parts = [name.rpartition(" / ") for name in names]
    first = list(dict.fromkeys(before for before, _slash, _last in parts))
    last = list(dict.fromkeys(after for _before, _slash, after in parts))
    return {
        name: (COLOURS[last.index(after) % len(COLOURS)], LINES[first.index(before) % len(LINES)])
        for name, (before, _slash, after) in zip(names, parts, strict=True)
    }


class Choices(NamedTuple):
    """The rows by their choices: the kind with the most options (names) beside combinations of the others.

    place: of each row, the number of its option; series: rows by combination, all together where there
    are more combinations than colours.
    """

    kind: str
    names: list[str]
    place: Ints
    series: dict[str, Ints]


def choices(study: LoadedStudy, table: Table) -> Choices:
    """What was chosen for each row: loads and the like, and swept values that are no numbers."""
    kinds = {name: name for name, _items in study.groups}
    kinds |= {s.path: s.label or s.path for s in study.study.sweep if s.path in table.texts}
    if not kinds:
        everything = np.arange(table.size)
        return Choices("", [study.study.name], np.zeros_like(everything), {"": everything})
    options = {kind: list(dict.fromkeys(table.texts[kind])) for kind in kinds}
    widest = max(kinds, key=lambda kind: len(options[kind]))
    place = np.array([options[widest].index(name) for name in table.texts[widest]])
    others = [table.texts[kind] for kind in kinds if kind != widest]
    labels = [" / ".join(parts) for parts in zip(*others, strict=True)]
    if not labels or len(set(labels)) > len(COLOURS):
        labels = [""] * table.size
    told = np.array(labels)
    series = {name: np.flatnonzero(told == name) for name in dict.fromkeys(labels)}
    return Choices(kinds[widest], options[widest], place, series)


def draw_choices(study: LoadedStudy, table: Table, folder: Path) -> Path:
    """Each metric by choice: lines from least to greatest, dots at the median."""
    from matplotlib import pyplot

    metrics = read_metrics(study)
    by = choices(study, table)
    count = len(by.series)
    figure, axes = pyplot.subplots(
        1,
        len(metrics),
        figsize=(4.0 + 4.0 * len(metrics), 1.2 + (0.2 + 0.12 * count) * len(by.names)),
        squeeze=False,
        sharey=True,
    )
    for axis, metric in zip(axes[0], metrics, strict=True):
        label, factor = shown(metric)
        for k, (name, rows) in enumerate(by.series.items()):
            level = 0.7 * ((k + 0.5) / count - 0.5)
            axis.plot([], [], "o", color=COLOURS[k], ms=5, label=name)
            for place in np.unique(by.place[rows]):
                values = factor * table.numbers[metric][rows[by.place[rows] == place]]
                values = values[~np.isnan(values)]
                if len(values):
                    at = place + level
                    axis.plot([values.min(), values.max()], [at, at], "-", color=COLOURS[k], lw=1.5)
                    axis.plot(np.median(values), at, "o", color=COLOURS[k], ms=5)
        axis.set_xlabel(label)
        axis.grid(alpha=0.3, axis="x")
        for line in range(1, len(by.names)):
            axis.axhline(line - 0.5, color=LIGHT.grid, lw=0.8, zorder=0)
    axes[0][0].set_yticks(range(len(by.names)), by.names)
    axes[0][0].set_ylim(len(by.names) - 0.5, -0.5)
    if count > 1:
        axes[0][-1].legend(frameon=False, fontsize=8, loc="upper left", bbox_to_anchor=(1.01, 1.0))
    figure.suptitle(study.study.name.replace("_", " "), x=0.02, ha="left", fontweight="bold")
    return saved(figure, folder / "choices.png")


def draw_map(study: LoadedStudy, table: Table, folder: Path) -> Path:
    """The first metric over a grid of two values, one panel a combination of choices; worst = max."""
    from matplotlib import pyplot

    metric = read_metrics(study)[0]
    label, factor = shown(metric)
    first, second = study.study.sweep
    groups = row_groups(study, table)
    figure, axes = pyplot.subplots(
        1, len(groups), figsize=(4.6 * len(groups) + 1, 4.2), squeeze=False, sharey=True
    )
    x = np.unique(table.numbers[first.path])
    y = np.unique(table.numbers[second.path])
    values = table.numbers[metric] * factor
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    mesh: Any = None
    for axis, (name, rows) in zip(axes[0], groups.items(), strict=True):
        grid = np.full((len(y), len(x)), np.nan)
        for index in rows:
            i = int(np.searchsorted(y, table.numbers[second.path][index]))
            j = int(np.searchsorted(x, table.numbers[first.path][index]))
            grid[i, j] = (
                np.nanmax([grid[i, j], values[index]])
                if not np.isnan(values[index])
                else grid[i, j]
            )
        mesh = axis.pcolormesh(x, y, grid, cmap="viridis", vmin=low, vmax=high, shading="nearest")
        axis.set_title(name)
        axis.set_xlabel(f"{first.label or first.path} {first.unit}")
    axes[0][0].set_ylabel(f"{second.label or second.path} {second.unit}")
    figure.colorbar(mesh, ax=list(axes[0]), label=label)
    return saved(figure, folder / "map.png", trimmed=True)


def labelled_strokes(study: LoadedStudy) -> tuple[str, str, list[tuple[str, Any]]]:
    """Driving chamber, opposing chamber, and each row of a plant-only study as (label, stroke)."""
    base = study.study.stroke
    assert base is not None
    driving, passive = CHAMBERS[base.kind]
    found = []
    for row in study.rows():
        sweeps = [
            f"{s.label or s.path} {row.settings[s.path]} {s.unit}".strip()
            for s in study.study.sweep
        ]
        found.append((", ".join([*row.choices, *sweeps]), stroke_of(base, study, row)))
    return driving, passive, found


def draw_curves(study: LoadedStudy, folder: Path) -> Path:
    """Position and pressures over time of each row of a plant-only study."""
    from matplotlib import pyplot

    base = study.study.stroke
    assert base is not None
    driving, passive, strokes = labelled_strokes(study)
    figure, axes = pyplot.subplots(3, 1, figsize=(8.6, 8.4), sharex=True)
    end = 0.0
    for k, (label, stroke) in enumerate(strokes):
        ms = 1e3 * stroke.time_s
        colour = COLOURS[k % len(COLOURS)]
        axes[0].plot(ms, 1e3 * stroke.position_m, color=colour, label=label)
        axes[1].plot(ms, 1e-5 * stroke.pressure_pa(driving), color=colour)
        axes[2].plot(ms, 1e-5 * stroke.pressure_pa(passive), color=colour)
        if stroke.impact:
            end = max(end, stroke.impact.time_s)
    axes[0].set_ylabel("stay, mm")
    axes[1].set_ylabel(f"P{driving}, bar abs")
    axes[2].set_ylabel(f"P{passive}, bar abs")
    axes[2].set_xlabel("time, ms")
    axes[2].set_xlim(0.0, 1e3 * min(base.until_s, 1.6 * end + 0.02 if end else base.until_s))
    for axis in axes:
        axis.grid(alpha=0.3)
    axes[0].legend(frameon=False, fontsize=8)
    figure.suptitle(study.study.description or study.study.name, x=0.02, ha="left", wrap=True)
    return saved(figure, folder / "curves.png")

"""Interactive plots of a study: metrics over what was swept, strokes over time.

Checked by: tests/unit/sil/studies/test_whatif.py, tests/browser/
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from sil.report.interactive import Group, Panel, Series, Window, plots
from sil.report.theme import LIGHT
from sil.studies.figure_style import shown
from sil.studies.pictures import MOST_CURVES, choices, labelled_strokes, read_metrics
from sil.studies.study import LoadedStudy, Sweep
from sil.studies.table import Table, row_groups

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
MOST_ROWS = 2000
"""Of a larger study every so-many-th row is drawn; results.csv has them all."""

MOST_GROUPS = len(LIGHT.series)


def study_plots(study: LoadedStudy, table: Table) -> list[Group]:
    """A group over time for the strokes of a small study, one over each swept number, else over the choices."""
    found = []
    if study.study.stroke is not None and study.size <= MOST_CURVES:
        found.append(_strokes(study))
    numeric = [sweep for sweep in study.study.sweep if sweep.path in table.numbers]
    swept = [group for sweep in numeric if (group := _over(study, table, sweep)) is not None]
    if not swept and not study.study.safety and (group := _choices(study, table)) is not None:
        swept = [group]
    return found + swept


def _choices(study: LoadedStudy, table: Table) -> Group | None:
    """Metrics by choice, each as a point."""
    by = choices(study, table)
    x = np.arange(float(len(by.names)))
    panels = _panels(study, table, by.series, by.place, len(x), lined=False)
    if not panels:
        return None
    return plots(by.kind, x, panels, title=f"By {by.kind}", twin=True, names=by.names)


def _over(study: LoadedStudy, table: Table, sweep: Sweep) -> Group | None:
    """Metrics over one swept value, as lines where values repeat, else each row as a point."""
    stride = max(1, -(-table.size // MOST_ROWS))
    drawn = np.arange(table.size) % stride == 0
    at = table.numbers[sweep.path]
    x = np.unique(at[drawn])
    if len(x) < 2:
        return None
    lined = len(study.study.sweep) == 1 or len(x) < 0.6 * int(np.count_nonzero(drawn))
    groups = list(row_groups(study, table).items())[:MOST_GROUPS]
    rows = {name: found[drawn[found]] for name, found in groups}
    panels = _panels(study, table, rows, np.searchsorted(x, at), len(x), lined)
    if not panels:
        return None
    unit = f", {sweep.unit}" if sweep.unit else ""
    logarithmic = sweep.scale == "log" and float(x[0]) > 0.0
    name = sweep.label or sweep.path
    return plots(
        f"{name}{unit}", x, panels, title=f"Over {name}", twin=True, logarithmic=logarithmic
    )


def _panels(
    study: LoadedStudy,
    table: Table,
    groups: Mapping[str, Ints],
    place: Ints,
    count: int,
    lined: bool,
) -> list[Panel]:
    """A panel a metric, a series a group of rows: medians where several rows have the same place.

    place: of every row, out of `count` on the axis.
    """
    repeated = any(len(np.unique(place[rows])) < len(rows) for rows in groups.values())
    panels = []
    for metric in read_metrics(study):
        label, factor = shown(metric)
        series = []
        for k, (name, rows) in enumerate(groups.items()):
            y = np.full(count, np.nan)
            values = factor * table.numbers[metric][rows]
            for i in np.unique(place[rows]):
                inside = values[place[rows] == i]
                if not np.all(np.isnan(inside)):
                    y[i] = np.nanmedian(inside)
            if not np.all(np.isnan(y)):
                series.append(
                    Series(name or study.study.name, y, f"series{k}", dotted=not lined, joined=True)
                )
        if series:
            title, _, unit = label.partition(", ")
            panels.append(Panel(title + (", median" if repeated else ""), unit, series, 200))
    return panels


def _strokes(study: LoadedStudy) -> Group:
    """Position and pressures of each row over time."""
    driving, passive, strokes = labelled_strokes(study)
    longest = max((stroke for _label, stroke in strokes), key=lambda stroke: len(stroke.time_s))
    time_s = longest.time_s
    positions: list[Series] = []
    pushing: list[Series] = []
    opposing: list[Series] = []
    end_s = 0.0
    for k, (label, stroke) in enumerate(strokes):
        role, dashed = f"series{k % MOST_GROUPS}", k >= MOST_GROUPS
        for lines, values in (
            (positions, 1e3 * stroke.position_m),
            (pushing, 1e-5 * stroke.pressure_pa(driving)),
            (opposing, 1e-5 * stroke.pressure_pa(passive)),
        ):
            over = np.interp(time_s, stroke.time_s, values, right=np.nan)
            lines.append(Series(label, over, role, dashed=dashed))
        if stroke.impact:
            end_s = max(end_s, stroke.impact.time_s)
    panels = [
        Panel("Position of the stay", "mm", positions, 220),
        Panel(f"Pressure {driving}, absolute", "bar", pushing),
        Panel(f"Pressure {passive}, absolute", "bar", opposing),
    ]
    windows = [Window("strokes", 0.0, 1e3 * (1.2 * end_s + 0.01))] if end_s else []
    return plots("time, ms", 1e3 * time_s, panels, windows, title="Over time", twin=True)

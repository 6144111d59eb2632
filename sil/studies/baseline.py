"""The row of a study that others are compared with, and the table of differences to it."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from can_dbc.errors import InputError, unknown_name
from sil.studies.figures import metric_of, row_labels
from sil.studies.study import Study, StudyFile, Table
from sil.studies.table import baseline_rows, differences, read_metrics

MOST_LISTED_ROWS = 40
"""A study of more rows shows groups, by their medians."""


def check_baseline(file: StudyFile, source: str) -> None:
    """Refuse a baseline that no row has. Raises InputError naming key and value."""
    values: dict[str, list[str]] = {
        name: [choice.name for choice in choices] for name, choices in file.groups.items()
    }
    for sweep in () if file.design.is_drawn else file.sweep:
        values[sweep.path] = list(map(str, sweep.levels()))
    for key, value in file.baseline.items():
        if key not in values:
            raise InputError(f"{source}: baseline.{key}: {unknown_name(key, values)}")
        if str(value) not in values[key]:
            raise InputError(
                f"{source}: baseline.{key}: {value!r}; expected one of {', '.join(values[key])}"
            )


def shown_rows(study: Study, table: Table) -> tuple[list[str], list[list[str]]]:
    """Return head and rows of what a reader sees: metrics and differences to the baseline, or medians of groups."""
    metrics = [name for name in read_metrics(study)[:6] if np.isfinite(table.numbers[name]).any()]
    baseline = baseline_rows(study, table)
    if table.size <= MOST_LISTED_ROWS:
        groups = {label: np.array([k]) for k, label in enumerate(row_labels(study, table))}
    else:
        groups = study.row_groups(table)
    head = [""]
    for name in metrics:
        head += [metric_of(name).axis] + ([] if baseline is None else ["difference"])
    return head, [
        [label or "all", *_cells(table, baseline, metrics, rows)] for label, rows in groups.items()
    ]


def _cells(
    table: Table, baseline: NDArray[np.int64] | None, metrics: list[str], rows: NDArray[np.int64]
) -> Iterator[str]:
    for name in metrics:
        factor = metric_of(name).factor
        values = factor * table.numbers[name][rows]
        values = values[np.isfinite(values)]
        if not len(values):
            yield from ("none",) if baseline is None else ("none", "")
            continue
        middle, least, greatest = (
            f"{x:.4g}" for x in (np.median(values), values.min(), values.max())
        )
        yield middle if least == greatest else f"{middle} ({least} to {greatest})"
        if baseline is not None:
            change = factor * differences(table, baseline, name)[rows]
            change = change[np.isfinite(change)]
            is_baseline = len(rows) == 1 and baseline[rows[0]] == rows[0]
            yield "baseline" if is_baseline else _change(change, float(np.median(values)))


def _change(changes: NDArray[np.float64], value: float) -> str:
    """Return the median of the changes, "=" where four digits of the value do not show it."""
    if not len(changes):
        return ""
    middle = float(np.median(changes))
    return f"{middle:+.3g}" if abs(middle) > 5e-5 * abs(value) else "="

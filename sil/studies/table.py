"""The table of a finished study: read back, summed up by groups of rows, written as Markdown."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from sil.studies.study import Outcome, Study, Table

RESULTS = "results.csv"
Z95 = 1.959964  # half width of a 95 % interval in standard deviations


def read_table(study: Study, folder: Path) -> Table:
    """Read a study's results.csv."""
    choices = {*study.file.groups, "outcome", "reason"}
    with open(folder / RESULTS, encoding="utf-8", newline="") as file:
        names, *cells = csv.reader(file)
    texts: dict[str, list[str]] = {}
    numbers = {}
    for name, column in zip(names, map(list, zip(*cells, strict=True)), strict=True):
        values = None if name in choices else numbers_of(column)
        if values is None:
            texts[name] = column
        else:
            numbers[name] = values
    return Table(texts, numbers, len(cells))


def numbers_of(cells: list[str]) -> NDArray[np.float64] | None:
    """Return cells as numbers [rows] in their column's unit, NaN for empty; None if one is a text."""
    try:
        return np.array([float(cell) if cell else math.nan for cell in cells])
    except ValueError:
        return None


def read_metrics(study: Study) -> list[str]:
    """Return the metrics to show first."""
    columns = study.file.columns()
    default = ["impact_speed_m_s", "shift_time_s" if "shift_time_s" in columns else "arrival_s"]
    return [name for name in study.file.reads or default if name in columns]


def baseline_rows(study: Study, table: Table) -> NDArray[np.int64] | None:
    """Return the number of the row that each row [rows] is compared with, None for a drawn design.

    It has the values of `baseline`, else the first ones, and the same load unless `baseline` names one.
    """
    file = study.file
    if file.design.is_drawn:
        return None
    columns = {name: np.array(table.texts[name]) for name in file.groups}
    for sweep in file.sweep:
        columns[sweep.path] = np.array(table.numbers.get(sweep.path, table.texts.get(sweep.path)))
    chosen = np.ones(table.size, dtype=bool)
    for name, values in columns.items():
        if name != "load" or name in file.baseline:
            chosen &= values == file.baseline.get(name, values[0])
    loads = (
        columns["load"]
        if "load" in columns and "load" not in file.baseline
        else np.zeros(table.size)
    )
    rows = np.flatnonzero(chosen)
    return np.array([rows[np.argmax(loads[rows] == load)] for load in loads])


def summary(study: Study, table: Table) -> dict[str, Any]:
    """Return counts of outcomes, reasons, and figures of each combination of choices.

    Figures: least, median, greatest, and the median difference to the rows in the baseline's place.
    """
    groups: dict[str, Any] = {}
    baseline = baseline_rows(study, table)
    for label, rows in study.row_groups(table).items():
        entry: dict[str, Any] = {"rows": len(rows)}
        for name in study.file.columns():
            column = table.numbers[name]
            values = column[rows][~np.isnan(column[rows])]
            if len(values):
                parts = (("min", np.min), ("median", np.median), ("max", np.max))
                entry[name] = {key: float(part(values)) for key, part in parts}
            if baseline is not None and len(values):
                change = column[rows] - column[baseline[rows]]
                entry[name]["difference"] = float(np.median(change))
        failed = table.numbers["failed"][rows] > 0.0
        entry["failed_share"] = float(np.mean(failed))
        if study.file.design.is_drawn:
            entry["failed_interval"] = share_interval(int(failed.sum()), len(rows))
            for name in read_metrics(study):
                entry[name] |= quantiles(table.numbers[name][rows])
        groups[label or "all"] = entry
    counts = table.outcomes
    return {
        "study": study.file.name,
        "rows": table.size,
        "outcomes": {name.replace(" ", "_"): counts[name] for name in get_args(Outcome)},
        "reasons": _reasons(table)[:100],
        "baseline_rows": None if baseline is None else sorted(set(baseline.tolist())),
        "groups": groups,
    }


def _reasons(table: Table) -> list[dict[str, Any]]:
    """Return each reason with its outcome, number of rows and first row, the most frequent first."""
    rows: dict[tuple[str, str], list[int]] = {}
    for k, key in enumerate(zip(table.texts["outcome"], table.texts["reason"], strict=True)):
        if key[1]:
            rows.setdefault(key, []).append(k)
    reasons = [
        {"outcome": outcome, "reason": reason, "rows": len(which), "first_row": which[0]}
        for (outcome, reason), which in rows.items()
    ]
    order = get_args(Outcome).index
    return sorted(reasons, key=lambda e: (order(e["outcome"]), e["rows"]), reverse=True)


def share_interval(count: int, size: int) -> list[float]:
    """Return the 95 % interval of a share that was observed `count` times of `size` (Wilson)."""
    from scipy.stats import binomtest

    return [float(end) for end in binomtest(count, size).proportion_ci(method="wilson")]


def quantiles(values: NDArray[np.float64]) -> dict[str, list[float]]:
    """Return the 5, 50 and 95 % quantiles of values [rows], each with a 95 % interval of order statistics."""
    ordered = np.sort(values[np.isfinite(values)])
    size, quantile = len(ordered), {}
    for share in (0.05, 0.5, 0.95) if size else ():
        half = Z95 * math.sqrt(size * share * (1.0 - share))
        ends = np.clip([size * share - half, size * share + half], 0, size - 1).round().astype(int)
        triple = [np.quantile(ordered, share), *ordered[ends]]
        quantile[f"p{100 * share:.0f}"] = [float(x) for x in triple]
    return quantile


def exit_code(table: Table) -> int:
    """Return 3 if a row could not run, else 1 if a row failed, else 0."""
    return 3 if table.outcomes["not run"] else 1 if table.outcomes["failed"] else 0


def markdown(head: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """Return the lines of a Markdown table."""
    return [f"| {' | '.join(row)} |" for row in (head, ("---",) * len(head), *rows)]

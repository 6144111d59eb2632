"""The page of a study: its question, figures, plots and numbers; offline, in one file."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sil.files.atomic import write_atomically
from sil.files.quantity import noun
from sil.report.picture import save
from sil.report.plots import plots
from sil.report.shell import Head, Picture, render
from sil.studies import fault_table
from sil.studies.figures import metric_of, row_labels
from sil.studies.kinds.runs import RunsStudy
from sil.studies.study import Study, Table
from sil.studies.table import baseline_rows, read_metrics


def write_page(
    study: Study, table: Table, summary: dict[str, Any], folder: Path, again: str
) -> None:
    """Write the figures and report.html; `again` is the command that made the study."""
    safety = isinstance(study.file, RunsStudy) and study.file.safety
    entries, counts = summary["groups"], summary["outcomes"]
    failed = float(table.numbers["failed"].mean())
    words = [f"{counts['failed']} failed"] if counts["failed"] else []
    words += [f"{counts['not_run']} could not run"] if counts["not_run"] else []
    head = Head(
        command="whatif",
        name=study.file.name,
        verdict=", ".join(words) or "all rows passed",
        good=not words,
        tiles=[
            (str(summary["rows"]), noun(summary["rows"], "row")),
            (str(len(entries)), noun(len(entries), "group")),
            (f"{100 * failed:.3g} %", "shift not done" if safety else "failed"),
        ],
        again=again,
    )
    row_again = ""
    if isinstance(study.file, RunsStudy):
        row_again = f"opc4 run {study.file.scenario} --set PATH=VALUE ..."
    figures = study.file.draw(study, table)
    heads, rows = shown_rows(study, table)
    page = render(
        "whatif.html",
        head,
        [group for figure in figures.values() for group in plots(figure)],
        description=study.file.description,
        sentences=summary.get("safe_states", ()),
        pictures=[
            Picture(save(figure, folder, name), name, f"{name}.png, {name}.svg")
            for name, figure in figures.items()
        ],
        faults=[fault_table.FAULT_TABLE_HEAD, *fault_table.rows(study, table)] if safety else [],
        faults_are=fault_table.LEGEND,
        reasons=summary["reasons"][:20],
        figures_are="Difference: to the row in the baseline's place, under the same load. Of many rows: "
        "the median of each group, in brackets least to greatest.",
        heads=heads,
        rows=[] if safety else rows,
        row_again=row_again,
    )
    write_atomically(folder / "report.html", page)


def shown_rows(study: Study, table: Table) -> tuple[list[str], list[list[str]]]:
    """Return head and rows of the shown table: metrics and differences, or of more than 40 rows the medians of groups."""
    metrics = [name for name in read_metrics(study)[:6] if np.isfinite(table.numbers[name]).any()]
    baseline = baseline_rows(study, table)
    if table.size <= 40:
        groups = {label: np.array([k]) for k, label in enumerate(row_labels(study, table))}
    else:
        groups = study.row_groups(table)
    head = [""]
    for name in metrics:
        head += [metric_of(name).axis] + ([] if baseline is None else ["difference"])
    cells = {label: _cells(table, baseline, metrics, rows) for label, rows in groups.items()}
    return head, [[label or "all", *texts] for label, texts in cells.items()]


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
        figures = np.median(values), values.min(), values.max()
        middle, least, greatest = (f"{x:.4g}" for x in figures)
        yield middle if least == greatest else f"{middle} ({least} to {greatest})"
        if baseline is not None:
            column = table.numbers[name]
            change = factor * (column[rows] - column[baseline[rows]])
            change = change[np.isfinite(change)]
            is_baseline = len(rows) == 1 and baseline[rows[0]] == rows[0]
            yield "baseline" if is_baseline else _change(change, float(np.median(values)))


def _change(changes: NDArray[np.float64], value: float) -> str:
    """Return the median of the changes, "=" where four digits of the value do not show it."""
    if not len(changes):
        return ""
    middle = float(np.median(changes))
    return f"{middle:+.3g}" if abs(middle) > 5e-5 * abs(value) else "="

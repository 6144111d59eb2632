"""The page of a study: its question, figures, plots and numbers; offline, in one file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from sil.files.atomic import write_atomically
from sil.files.quantity import noun
from sil.report.picture import save
from sil.report.plots import plots
from sil.report.shell import Head, Picture, render
from sil.studies import fault_table
from sil.studies.baseline import shown_rows
from sil.studies.kinds.runs import RunsStudy
from sil.studies.study import Study, Table


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
        row_again=f"opc4 run {study.file.scenario} --set PATH=VALUE ..."
        if isinstance(study.file, RunsStudy)
        else "",
    )
    write_atomically(folder / "report.html", page)

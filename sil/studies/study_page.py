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
from sil.studies.figures import read_metrics, shown
from sil.studies.rows import kind_of
from sil.studies.study import LoadedStudy
from sil.studies.table import Table

MOST_COLUMNS = 6
MOST_REASONS = 20


def write_page(
    study: LoadedStudy, table: Table, found: dict[str, Any], folder: Path, again: str
) -> None:
    """Write the figures and report.html; `found` is the summary, `again` the command that made it."""
    metrics = ["shift_time_s", "arrival_s", "impact_speed_m_s", "impact_energy_j"]
    if study.study.kind != "runs":
        metrics = read_metrics(study)[:MOST_COLUMNS]
    entries = found["groups"]
    metrics = [name for name in metrics if any(name in entry for entry in entries.values())]
    failed = float(table.numbers["failed"].mean())
    counts, safety = found["outcomes"], study.study.safety
    words = [f"{counts['failed']} failed"] if counts["failed"] else []
    words += [f"{counts['not_run']} could not run"] if counts["not_run"] else []
    head = Head(
        command="whatif",
        name=study.study.name,
        verdict=", ".join(words) or "all rows passed",
        good=not words,
        tiles=[
            (str(found["rows"]), noun(found["rows"], "row")),
            (str(len(entries)), noun(len(entries), "group")),
            (f"{100 * failed:.3g} %", "shift not done" if safety else "failed"),
            *_ranges(study, table),
        ],
        again=again,
    )
    figures = kind_of(study).figures(study, table)
    of_runs = study.study.kind == "runs" and study.study.scenario is not None
    page = render(
        "whatif.html",
        head,
        [group for figure in figures.values() for group in plots(figure)],
        description=study.study.description,
        sentences=found.get("safe_states", ()),
        pictures=[
            Picture(save(figure, folder, name), name, f"{name}.png, {name}.svg")
            for name, figure in figures.items()
        ],
        faults=[fault_table.HEAD, *fault_table.rows(study, table)] if safety else [],
        faults_are=fault_table.LEGEND,
        reasons=found["reasons"][:MOST_REASONS],
        figures_are="Median of the rows of each group, and in brackets least to greatest.",
        metrics=[", ".join(filter(None, shown(name)[:2])) for name in metrics],
        rows=[
            {
                "name": name,
                "rows": entry["rows"],
                "cells": [_cell(name, entry.get(name)) for name in metrics],
                "failed": f"{100 * entry['failed_share']:.3g} %",
            }
            for name, entry in ({} if safety else entries).items()
        ],
        row_again=f"opc4 run {study.study.scenario} --set PATH=VALUE ..." if of_runs else "",
    )
    write_atomically(folder / "report.html", page)


def _cell(name: str, entry: dict[str, float] | None) -> str:
    if entry is None:
        return ""
    factor = shown(name)[2]
    least, middle, greatest = (f"{factor * entry[k]:.4g}" for k in ("min", "median", "max"))
    return middle if least == greatest else f"{middle} ({least} to {greatest})"


def _ranges(study: LoadedStudy, table: Table) -> list[tuple[str, str]]:
    """Return least and greatest of the metrics shown first."""
    found = []
    for name in read_metrics(study)[:2]:
        values = table.numbers[name][table.numbers[name] == table.numbers[name]]
        if len(values):
            title, unit, factor = shown(name)
            ends = (factor * values.min(), factor * values.max())
            least, greatest = (f"{float(f'{end:.3g}'):g}" for end in ends)  # 2430, not 2.43e+03
            label = ", ".join(filter(None, (title, unit)))
            found.append((least if least == greatest else f"{least} to {greatest}", label))
    return found

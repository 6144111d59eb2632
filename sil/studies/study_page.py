"""The page of a study: its question, pictures, plots and figures; offline, in one file.

Checked by: tests/unit/sil/studies/test_whatif.py, tests/browser/
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from sil.report.shell import Head, Picture, render
from sil.studies import fault_table
from sil.studies.figure_style import shown
from sil.studies.pictures import read_metrics
from sil.studies.plots import study_plots
from sil.studies.study import LoadedStudy
from sil.studies.table import Table

MOST_COLUMNS = 6
MOST_REASONS = 20


def page(
    study: LoadedStudy, table: Table, told: dict[str, Any], pictures: Sequence[Path], again: str
) -> str:
    """The report as HTML text; `again` is the call that made it."""
    metrics = ["shift_time_s", "arrival_s", "impact_speed_m_s", "impact_energy_j"]
    if study.study.kind != "runs":
        metrics = read_metrics(study)[:MOST_COLUMNS]
    entries = told["groups"]
    metrics = [name for name in metrics if any(name in entry for entry in entries.values())]
    failed = float(table.numbers["failed"].mean())
    counts = told["outcomes"]
    head = Head(
        command="whatif",
        name=study.study.name,
        verdict=verdict(counts),
        good=not counts["failed"] and not counts["not_run"],
        tiles=[
            (str(told["rows"]), "rows"),
            (str(len(entries)), "groups"),
            (f"{100 * failed:.3g} %", "shift not done" if study.study.safety else "failed"),
            *_ranges(study, table),
        ],
        again=again,
    )
    safety = study.study.safety
    of_runs = study.study.kind == "runs" and study.study.scenario is not None
    return render(
        "whatif.html",
        head,
        study_plots(study, table),
        description=study.study.description,
        sentences=told.get("kept", ()),
        pictures=[
            Picture(path.read_bytes(), path.stem, f"{path.stem}.png, {path.stem}.svg")
            for path in pictures
        ],
        faults=[fault_table.HEAD, *fault_table.rows(study, table)] if safety else [],
        faults_are=fault_table.LEGEND,
        reasons=told["reasons"][:MOST_REASONS],
        figures_are="Median of the rows of each group, and in brackets least to greatest.",
        metrics=[shown(name)[0] for name in metrics],
        rows=[
            {
                "name": name or study.study.name,
                "rows": entry["rows"],
                "cells": [_cell(name, entry.get(name)) for name in metrics],
                "failed": f"{100 * entry['failed_share']:.3g} %",
            }
            for name, entry in ({} if safety else entries).items()
        ],
        row_again=f"opc4 run {study.study.scenario} --set PATH=VALUE ..." if of_runs else "",
    )


def verdict(counts: dict[str, int]) -> str:
    """Return how many rows failed or could not run, for the head of the page."""
    parts = [f"{counts[name]} {words}" for name, words in
             (("failed", "failed"), ("not_run", "could not run")) if counts[name]]  # fmt: skip
    return ", ".join(parts) or "all rows passed"


def _cell(name: str, entry: dict[str, float] | None) -> str:
    if entry is None:
        return ""
    factor = shown(name)[1]
    least, middle, greatest = (f"{factor * entry[k]:.4g}" for k in ("min", "median", "max"))
    return middle if least == greatest else f"{middle} ({least} to {greatest})"


def _ranges(study: LoadedStudy, table: Table) -> list[tuple[str, str]]:
    """Least and greatest of the metrics shown first."""
    found = []
    for name in read_metrics(study)[:2]:
        values = table.numbers[name][table.numbers[name] == table.numbers[name]]
        if len(values):
            label, factor = shown(name)
            ends = (factor * values.min(), factor * values.max())
            least, greatest = (f"{float(f'{end:.3g}'):g}" for end in ends)  # 2430, not 2.43e+03
            found.append((least if least == greatest else f"{least} to {greatest}", label))
    return found

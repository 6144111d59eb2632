"""The summary of a finished study: outcomes, reasons, figures of each combination of choices."""

from __future__ import annotations

from typing import Any

import numpy as np

from sil.studies.rows import FAILED, NOT_RUN, OUTCOMES, columns
from sil.studies.study import LoadedStudy
from sil.studies.table import Table, row_groups

MOST_REASONS = 100
"""Different reasons in a summary; results.csv has the reason of every row."""


def reasons(table: Table) -> list[dict[str, Any]]:
    """Return each reason with its outcome, number of rows and first row, the most frequent first."""
    rows: dict[tuple[str, str], list[int]] = {}
    for k, key in enumerate(zip(table.texts["outcome"], table.texts["reason"], strict=True)):
        if key[1]:
            rows.setdefault(key, []).append(k)
    found = [
        {"outcome": outcome, "reason": reason, "rows": len(which), "first_row": which[0]}
        for (outcome, reason), which in rows.items()
    ]
    found.sort(
        key=lambda entry: (OUTCOMES.index(str(entry["outcome"])), entry["rows"]), reverse=True
    )
    return found


def summary(study: LoadedStudy, table: Table) -> dict[str, Any]:
    """Return counts of outcomes, reasons, and of each combination of choices the figures.

    A figure is its least, median and greatest value over the rows of the combination.
    """
    groups: dict[str, Any] = {}
    for label, rows in row_groups(study, table).items():
        entry: dict[str, Any] = {"rows": len(rows)}
        for name in columns(study):
            values = table.numbers[name][rows]
            values = values[~np.isnan(values)]
            if len(values):
                entry[name] = {
                    "min": float(np.min(values)),
                    "median": float(np.median(values)),
                    "max": float(np.max(values)),
                }
        entry["failed_share"] = float(np.mean(table.numbers["failed"][rows]))
        groups[label or "all"] = entry
    counts = table.outcomes
    return {
        "study": study.study.name,
        "rows": table.size,
        "outcomes": {name.replace(" ", "_"): counts[name] for name in OUTCOMES},
        "reasons": reasons(table)[:MOST_REASONS],
        "groups": groups,
    }


def exit_code(table: Table) -> int:
    """Return 3 if a row could not run, else 1 if a row failed, else 0."""
    counts = table.outcomes
    return 3 if counts[NOT_RUN] else 1 if counts[FAILED] else 0

"""The summary of a finished study: outcomes, reasons, figures of each combination of choices."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sil.studies.figures import read_metrics
from sil.studies.rows import FAILED, NOT_RUN, OUTCOMES, columns
from sil.studies.study import DRAWN, LoadedStudy
from sil.studies.table import Table, row_groups

Z95 = 1.959964
"""Half width of a 95 % interval in standard deviations of a normal distribution."""
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


def share_interval(count: int, size: int) -> list[float]:
    """Return the 95 % interval of a share that was observed `count` times of `size` (Wilson)."""
    share, z2 = count / size, Z95**2
    middle = (share + 0.5 * z2 / size) / (1.0 + z2 / size)
    half = math.sqrt(share * (1.0 - share) / size + 0.25 * z2 / size**2) * Z95 / (1.0 + z2 / size)
    return [max(0.0, middle - half), min(1.0, middle + half)]


def quantiles(values: NDArray[np.float64]) -> dict[str, list[float]]:
    """Return the 5, 50 and 95 % quantiles of values [rows], each with its 95 % interval.

    The ends of an interval are order statistics, which assume nothing of the distribution.
    """
    ordered = np.sort(values[np.isfinite(values)])
    size, found = len(ordered), {}
    for share in (0.05, 0.5, 0.95) if size else ():
        half = Z95 * math.sqrt(size * share * (1.0 - share))
        ends = np.clip([size * share - half, size * share + half], 0, size - 1).round().astype(int)
        figures = [np.quantile(ordered, share), *ordered[ends]]
        found[f"p{100 * share:.0f}"] = [float(x) for x in figures]
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
        failed = table.numbers["failed"][rows] > 0.0
        entry["failed_share"] = float(np.mean(failed))
        if study.study.design.kind in DRAWN:
            entry["failed_interval"] = share_interval(int(failed.sum()), len(rows))
            for name in read_metrics(study):
                entry[name] |= quantiles(table.numbers[name][rows])
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

"""The table of a finished study, read back, and its summary."""

from __future__ import annotations

import csv
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sil.studies.executor import RESULTS
from sil.studies.rows import columns
from sil.studies.study import LoadedStudy


@dataclass(frozen=True)
class Table:
    """Columns of results.csv: texts for choices, numbers for the rest (nan for none)."""

    texts: dict[str, list[str]]
    numbers: dict[str, np.ndarray]
    size: int


def read_table(study: LoadedStudy, folder: Path) -> Table:
    """Read a study's results.csv."""
    choices = [name for name, _items in study.groups]
    with open(folder / RESULTS, encoding="utf-8", newline="") as file:
        reader = csv.reader(file)
        names = next(reader)
        cells = list(reader)
    texts, numbers = {}, {}
    for k, name in enumerate(names):
        column = [row[k] for row in cells]
        if name in choices:
            texts[name] = column
            continue
        try:
            numbers[name] = np.array([float(c) if c else math.nan for c in column])
        except ValueError:
            texts[name] = column
    return Table(texts, numbers, len(cells))


def summary(study: LoadedStudy, table: Table) -> dict[str, Any]:
    """Per choice and metric: least, median, greatest, and the share that failed."""
    groups: dict[str, Any] = {}
    keys = [name for name, _items in study.groups]
    labels = (
        [" / ".join(parts) for parts in zip(*(table.texts[k] for k in keys), strict=True)]
        if keys
        else ["all"] * table.size
    )
    for label in dict.fromkeys(labels):
        chosen = np.array([found == label for found in labels])
        entry: dict[str, Any] = {"rows": int(np.count_nonzero(chosen))}
        for name in columns(study):
            values = table.numbers[name][chosen]
            values = values[~np.isnan(values)]
            if len(values):
                entry[name] = {
                    "min": float(np.min(values)),
                    "median": float(np.median(values)),
                    "max": float(np.max(values)),
                }
        entry["failed_share"] = float(np.mean(table.numbers["failed"][chosen]))
        groups[label] = entry
    return {"study": study.study.name, "rows": table.size, "groups": groups}

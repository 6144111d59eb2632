"""The table of a finished study, read back."""

from __future__ import annotations

import csv
import math
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sil.studies.study import LoadedStudy

RESULTS = "results.csv"


@dataclass(frozen=True)
class Table:
    """Columns of results.csv by name: texts, and numbers [rows] in the unit of their name.

    Numbers that a row does not have are NaN. Texts are the choices, `outcome` and `reason`, and
    swept values that are no numbers.
    """

    texts: dict[str, list[str]]
    numbers: dict[str, NDArray[np.float64]]
    size: int

    @property
    def outcomes(self) -> Counter[str]:
        """Return how many rows have each outcome."""
        return Counter(self.texts["outcome"])


def read_table(study: LoadedStudy, folder: Path) -> Table:
    """Read a study's results.csv."""
    choices = {*study.groups, "outcome", "reason"}
    with open(folder / RESULTS, encoding="utf-8", newline="") as file:
        names, *cells = csv.reader(file)
    texts: dict[str, list[str]] = {}
    numbers = {}
    for name, column in zip(names, map(list, zip(*cells, strict=True)), strict=True):
        found = None if name in choices else numbers_of(column)
        if found is None:
            texts[name] = column
        else:
            numbers[name] = found
    return Table(texts, numbers, len(cells))


def numbers_of(cells: list[str]) -> NDArray[np.float64] | None:
    """Return cells as numbers [rows] in their column's unit, NaN for empty; None if one is a text."""
    try:
        return np.array([float(cell) if cell else math.nan for cell in cells])
    except ValueError:
        return None


def row_groups(study: LoadedStudy, table: Table) -> dict[str, NDArray[np.int64]]:
    """Return the row numbers [rows of the group] of each combination of choices, by its label."""
    keys = list(study.groups)
    if not keys:
        return {"": np.arange(table.size)}
    labels = [" / ".join(parts) for parts in zip(*(table.texts[k] for k in keys), strict=True)]
    found: dict[str, list[int]] = {}
    for k, label in enumerate(labels):
        found.setdefault(label, []).append(k)
    return {label: np.array(rows) for label, rows in found.items()}

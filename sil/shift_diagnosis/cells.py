"""The shifts of one truck, summed over cells that get longer as they get older: memory is bounded.

Checked by: tests/unit/sil/shift_diagnosis/test_track.py
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray

from sil.shift_diagnosis.scatter import Scatter

Floats = NDArray[np.float64]

BLOCK: Final = 20
"""Shifts that are summed before anything is tested."""
CELLS: Final = 256
"""Cells that a truck has at most; then two neighbours are merged for every new one."""


@dataclass
class Cells:
    """Information and score of the tracked sizes, and how they scatter.

    names: of the parameters [p]. count, first, time_s [cells]; information [cells, p, p] and
    score [cells, p] of the sizes; trips [cells]: how many trips a cell is, in all 1 for each trip;
    trip_first, trip_cells, last_s: of the present trip, its first shift, the number of its cells before
    any were merged, and the time of its latest shift; is_open: the last cell takes more.
    """

    names: tuple[str, ...]
    count: NDArray[np.int64]
    first: NDArray[np.int64]
    time_s: Floats
    information: Floats
    score: Floats
    trips: Floats
    scatter: Scatter
    shifts: int = 0
    trip_first: int = 0
    trip_cells: int = 0
    last_s: float = float("inf")
    is_open: bool = False

    @classmethod
    def of(cls, names: tuple[str, ...]) -> Self:
        """Return the state of a truck of which nothing is known."""
        p = len(names)
        return cls(
            names, np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0),
            np.zeros((0, p, p)), np.zeros((0, p)), np.zeros(0), Scatter.of(p),
        )  # fmt: skip

    def begin_cell(self, time_s: float) -> None:
        """Begin the cell of the next shift, which is at this time [s]."""
        p, k = len(self.names), self.trip_cells
        self.count = np.append(self.count, 0)
        self.first = np.append(self.first, self.shifts)
        self.time_s = np.append(self.time_s, time_s)
        self.information = np.concatenate([self.information, np.zeros((1, p, p))])
        self.score = np.concatenate([self.score, np.zeros((1, p))])
        self.trips[self.first[:-1] >= self.trip_first] *= k / (k + 1)
        self.trips = np.append(self.trips, 1.0 / (k + 1))
        self.trip_cells += 1
        self.is_open = True

    def merge(self, since: int, borders: Collection[int]) -> None:
        """Merge two neighbours, the finest for their distance from now and from a shift `since`.

        Not across borders: numbers of shifts.
        """
        if len(self.count) < CELLS:
            return
        second = self.first[1:]
        reach = np.minimum(self.shifts - second, np.abs(second - since)) + BLOCK
        width = (self.count[:-1] + self.count[1:]) / reach
        width[np.isin(second, [since, self.trip_first, *borders])] = np.inf
        groups = np.delete(np.arange(len(self.count)), int(np.argmin(width)) + 1)
        for name in ("count", "information", "score", "trips"):
            setattr(self, name, np.add.reduceat(getattr(self, name), groups, axis=0))
        self.first, self.time_s = self.first[groups], self.time_s[groups]

    def variances(self, cells: slice | NDArray[np.bool_]) -> tuple[Floats, Floats]:
        """Return the variances [m, p] of cells' estimates, by their shifts and by their trips."""
        h = np.diagonal(self.information[cells], axis1=1, axis2=2)
        within = self.scatter.within2 / np.maximum(h, 1e-12)
        return within, self.scatter.between2 / self.trips[cells, None]

    def segment(self, since: int) -> tuple[slice, Floats, Floats, Floats]:
        """Return the cells since a shift, their precision and estimates [m, p], mid shifts [m]."""
        cells = slice(int(np.searchsorted(self.first, since)), len(self.count))
        h = np.diagonal(self.information[cells], axis1=1, axis2=2)
        estimates = self.score[cells] / np.maximum(h, 1e-12)
        precision = 1.0 / np.sum(self.variances(cells), axis=0)
        return cells, precision, estimates, self.first[cells] + 0.5 * self.count[cells]

    def estimates(self, k: int) -> tuple[Floats, Floats]:
        """Return the estimate [cells] of parameter k in each cell, and its standard deviation."""
        h = np.maximum(self.information[:, k, k], 1e-12)
        variance = np.sum(self.variances(slice(None)), axis=0)[:, k]
        return self.score[:, k] / h, np.sqrt(variance)

    def level(self, k: int, begin: int, end: int | None = None) -> tuple[float, float]:
        """Return the mean size of parameter k over shifts from begin to end, and its deviation."""
        first = self.first
        own = (first >= begin) & (first < (end if end is not None else self.shifts))
        if not own.any():
            return float("nan"), float("inf")
        estimates, deviations = (each[own] for each in self.estimates(k))
        weights = deviations**-2.0
        return float(np.average(estimates, weights=weights)), float(weights.sum() ** -0.5)

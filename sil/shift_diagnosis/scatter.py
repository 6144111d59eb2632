"""How much the shifts of one truck scatter: from shift to shift, and from trip to trip.

Temperature, load and sampling phase differ between two trips, and what a model gets wrong of them
is the same in all shifts of a trip. So the mean of a trip is less certain than its shifts say.
Checked by: tests/unit/sil/shift_diagnosis/test_track.py
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

PAUSE_S: Final = 1800.0
"""Time between two shifts from which a new trip begins, as where time goes back: another log."""
PSEUDO_BLOCKS: Final = 5.0
"""Blocks that the stated scatter of a shift counts as, when the scatter is estimated."""
PSEUDO_TRIPS: Final = 2.0
"""Pairs of trips that the assumed difference between trips counts as, when that is estimated."""
ASSUMED: Final = 0.5
"""Standard deviation between trips that is assumed before any is known, by that between shifts."""
CLIPPED: Final = 12.0
"""Square by its expected value above which one pair counts no more: it may be a change."""


@dataclass
class Scatter:
    """Variances of p parameters.

    squares [p], pairs: of adjacent blocks within a trip, by the stated variance. excess [p]: of the
    means of adjacent trips, half the square of their difference beyond what their shifts explain,
    with a weight that is larger for longer trips; weight, weight2 [p]: sums of that and of its
    square. h, score [p]: sums of the present trip; last_h, last [p]: information and mean of the
    trip before it, empty if there is none to compare with. total_h [p], shifts, trips: of all.
    """

    squares: Floats
    excess: Floats
    weight: Floats
    weight2: Floats
    h: Floats
    score: Floats
    total_h: Floats
    last_h: Floats
    last: Floats
    pairs: float = 0.0
    shifts: int = 0
    trips: int = 0

    @classmethod
    def of(cls, p: int) -> Scatter:
        """Return what is known of a truck without shifts, of p parameters."""
        a, b, c, d, e, f, g = np.zeros((7, p))
        return cls(a, b, c, d, e, f, g, np.zeros(0), np.zeros(0))

    @classmethod
    def from_stored(cls, stored: dict[str, Any]) -> Scatter:
        """Return what `vars` of it gave, arrays as lists."""
        found = cls.of(0)
        for name, value in stored.items():
            setattr(found, name, np.array(value) if isinstance(value, list) else value)
        return found

    @property
    def within2(self) -> Floats:
        """Variance of the shifts of a trip [p] relative to the stated one."""
        return np.asarray((PSEUDO_BLOCKS + self.squares) / (PSEUDO_BLOCKS + self.pairs))

    @property
    def of_shift2(self) -> Floats:
        """Variance of a parameter [p] that one shift leaves, in squared sizes."""
        return self.within2 * self.shifts / np.maximum(self.total_h, 1e-12)

    @property
    def freedom(self) -> tuple[float, Floats]:
        """Degrees of freedom with which `within2`, and `between2` [p], are known."""
        pairs = self.weight**2 / np.maximum(self.weight2, 1e-300)
        return PSEUDO_BLOCKS + self.pairs, PSEUDO_TRIPS + pairs

    @property
    def between2(self) -> Floats:
        """Variance of a parameter [p] between trips, in squared sizes; 0 while there is one trip."""
        if self.trips < 2:
            return np.zeros_like(self.squares)
        own = PSEUDO_TRIPS / (2.0 * ASSUMED**2 * self.of_shift2) ** 2
        found = own * ASSUMED**2 * self.of_shift2 + self.excess
        return np.asarray(np.maximum(0.0, found) / (own + self.weight))

    def add(self, h: Floats, score: Floats, shifts: int) -> None:
        """Add shifts of the present trip: sums of their information and score [p]."""
        self.h, self.score = self.h + h, self.score + score
        self.total_h, self.shifts = self.total_h + h, self.shifts + shifts

    def compare(self, h: Floats, score: Floats) -> None:
        """Compare two adjacent blocks of a trip: information and score [2, p]."""
        h = np.maximum(h, 1e-12)
        a = score / h
        square = (a[1] - a[0]) ** 2 / (1.0 / h).sum(axis=0)
        self.squares += np.minimum(square, CLIPPED * self.within2)
        self.pairs += 1.0

    def begin_trip(self) -> None:
        """End the present trip, if there is one: compare its mean with that of the trip before it."""
        self.trips += 1
        if not self.h.any():
            return
        h = np.maximum(self.h, 1e-12)
        mean = self.score / h
        if len(self.last):
            expected = self.within2 * (1.0 / h + 1.0 / self.last_h)
            most = CLIPPED * (expected + 2.0 * self.between2)
            weight = (expected + 2.0 * ASSUMED**2 * self.of_shift2) ** -2.0
            self.excess += 0.5 * weight * (np.minimum((mean - self.last) ** 2, most) - expected)
            self.weight, self.weight2 = self.weight + weight, self.weight2 + weight**2
        self.last_h, self.last = h, mean
        self.h, self.score = np.zeros_like(h), np.zeros_like(h)

    def restart(self) -> None:
        """Compare no trip with one from before a change."""
        self.h, self.score = np.zeros_like(self.h), np.zeros_like(self.h)
        self.last_h, self.last = np.zeros(0), np.zeros(0)

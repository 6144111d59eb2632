"""What a unit learns of its clocks and valves from shift to shift: when they open, and how old reports are."""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite
from typing import NamedTuple

JUMP_S, SAME_S, FOLLOWED = 0.0015, 0.0008, 0.3
"""An onset that is further from the latest ones of its direction than the first, seven times its scatter, is
in doubt until another is within the second of it; else it moves them by the third of the way."""
SPEEDS_S, UNKNOWN_S = 0.0017, 0.003
"""Scatter of a release that is found from two reports of the speeds; of their age between units."""
UNLIKELY = 4.0
OUTLIERS = 3
"""Standard deviations from which on an age is refused, until so many in a row were."""
SETTLED = 16.0
"""The origin is the mean of so many onsets."""
UNSEEN, SEEN, DOUBTED = 0.0, 1.0, 2.0
"""State of the onsets of a direction."""
AGE, VARIANCE, REFUSED, ORIGIN, COUNT, FIRST = range(6)
SIZE = 3
"""Of a direction, from `FIRST` on: latest onset after the origin, one that jumped, state."""


class Delays(NamedTuple):
    """How much later valves open than they did at first, in s.

    driving: the one of the direction; neutral: as far as the two tell. is_doubted: not to be relied on.
    """

    driving_s: float = 0.0
    neutral_s: float = 0.0
    is_doubted: bool = False


class Clocks:
    """Age of the reported speeds, and onsets of the pushes in each direction.

    An onset tells by how much a driving valve opens later than it did at first: it is measured against
    the commands by samples of the position, whose age is constant in a unit. How late the first ones
    were cannot be told from that age: they are taken to be nominal.
    """

    fresh: tuple[float, ...] = (0.0, UNKNOWN_S**2, 0.0, 0.0, 0.0, *(0.0, 0.0, UNSEEN) * 2)
    largest = 0.02, 1.0, 10.0, 1.0, SETTLED, *(0.5, 0.5, DOUBTED) * 2

    def __init__(self) -> None:
        self.values = list(self.fresh)

    @classmethod
    def is_valid(cls, values: Sequence[float]) -> bool:
        """Return whether numbers can be those of a unit."""
        pairs = zip(values, cls.largest, strict=True)
        return all(isfinite(each) and abs(each) <= most for each, most in pairs)

    @property
    def age_s(self) -> float:
        """How much older than assumed the speeds are in the step that has them first."""
        return self.values[AGE]

    @property
    def variance(self) -> float:
        """Of the age, s2."""
        return self.values[VARIANCE]

    @property
    def origin_s(self) -> float | None:
        """When the valves for the gears moved the stay at first; None before the first push."""
        return self.values[ORIGIN] if self.values[COUNT] > 0.0 else None

    def aged(self, later_s: float) -> bool:
        """Take by how much later the speeds told a release than the position did. Return whether it fits."""
        age_s, variance, refused = self.values[:ORIGIN]
        total = variance + SPEEDS_S * SPEEDS_S
        if later_s * later_s > UNLIKELY * UNLIKELY * total:
            self.values[REFUSED] = refused + 1.0
            if refused + 1.0 >= OUTLIERS:
                self.values[VARIANCE], self.values[REFUSED] = UNKNOWN_S * UNKNOWN_S, 0.0
            return False
        gain = variance / total
        moved_s = age_s + gain * later_s
        self.values[:ORIGIN] = min(max(moved_s, -0.02), 0.02), (1.0 - gain) * variance, 0.0
        return True

    def delays(self, direction: int, onset_s: float | None) -> Delays:
        """Return how much later the valves open: the driving one by this onset, or the latest if None.

        Of the neutral one nothing is measured in a push into a gear. If both others are late it is taken to be
        so, too (a block was exchanged), as far as the sooner one; if one is late alone it is taken to be in time.
        """
        latest_s, _, state = self._of(direction)
        others_s, _, other_state = self._of(1 - direction)
        if state == UNSEEN:
            return Delays()
        driving_s, is_doubted = latest_s, state == DOUBTED
        if onset_s is not None:
            driving_s = onset_s - self.values[ORIGIN]
            is_doubted = not self._is_confirmed(direction, driving_s)
        is_doubted |= other_state == DOUBTED and driving_s > others_s + JUMP_S
        neutral_s = driving_s if other_state == UNSEEN else min(driving_s, others_s)
        return Delays(driving_s, neutral_s, is_doubted)

    def began(self, direction: int, onset_s: float) -> None:
        """Follow the onsets; one that jumps is taken when another confirms it.

        Until then the other direction is in doubt as well: its valve may have been exchanged with this one.
        """
        if self.origin_s is None:
            self.values[ORIGIN] = onset_s
        own, other = FIRST + SIZE * direction, FIRST + SIZE * (1 - direction)
        later_s = onset_s - self.values[ORIGIN]
        latest_s, _, state = self._of(direction)
        if (
            state == UNSEEN and later_s < -JUMP_S
        ):  # the other valve was exchanged: this one is nominal
            self.values[ORIGIN] += later_s
            self.values[other] -= later_s
            later_s = 0.0
        if state == UNSEEN:
            self.values[own : own + SIZE] = later_s, 0.0, SEEN
        elif self._is_confirmed(direction, later_s):
            share = FOLLOWED if abs(later_s - latest_s) <= JUMP_S else 1.0
            self.values[own : own + SIZE] = latest_s + share * (later_s - latest_s), 0.0, SEEN
        else:
            self.values[own + 1 : own + SIZE] = later_s, DOUBTED
            if self.values[other + 2] == SEEN:
                self.values[other + 2] = DOUBTED
        if abs(later_s) <= JUMP_S and self.values[COUNT] < SETTLED:
            self._settle(later_s)

    def _settle(self, later_s: float) -> None:
        """Move the origin to the mean of the first onsets."""
        self.values[COUNT] += 1.0
        moved_s = later_s / self.values[COUNT]
        self.values[ORIGIN] += moved_s
        for at in (FIRST, FIRST + SIZE):
            self.values[at] -= moved_s

    def _of(self, direction: int) -> list[float]:
        """Return of a direction: latest onset, the one that jumped, state."""
        at = FIRST + SIZE * direction
        return self.values[at : at + SIZE]

    def _is_confirmed(self, direction: int, later_s: float) -> bool:
        """Return whether an onset is near the latest, the one that jumped, or the other direction's."""
        latest_s, jumped_s, _ = self._of(direction)
        others_s, _, other_state = self._of(1 - direction)
        if abs(later_s - latest_s) <= JUMP_S:
            return True
        if jumped_s != 0.0 and abs(later_s - jumped_s) <= SAME_S:
            return True
        return other_state == SEEN and abs(later_s - others_s) <= SAME_S

"""What a unit learns of its clocks and valves from shift to shift: when they open, and how old reports are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from math import isfinite
from typing import NamedTuple

JUMP_S, SAME_S, FOLLOWED = 0.0015, 0.0008, 0.3
"""An onset that is further from the latest ones of its direction than the first, seven times its scatter, is
in doubt until another is within the second of it; else it moves them by the third of the way."""
SPEEDS_S, UNKNOWN_S = 0.0017, 0.003
"""Scatter of a release that is found from two reports of the speeds; of their age between units."""
LARGEST_S = 0.02
"""No age is further from the one assumed."""
UNLIKELY, REFUSED = 4.0, 3.0
"""Standard deviations from which on an age is refused, until so many in a row were."""
SETTLED = 16.0
"""The origin is the mean of so many onsets."""
UNSEEN, SEEN, DOUBTED = 0.0, 1.0, 2.0
"""State of the onsets of a direction."""


class Delays(NamedTuple):
    """How much later valves open than they did at first, in s.

    driving: the one of the direction; neutral: as far as the two tell. is_doubted: not to be relied on.
    """

    driving_s: float = 0.0
    neutral_s: float = 0.0
    is_doubted: bool = False


@dataclass
class Onsets:
    """Of one direction, in s after the origin: the latest ones, and one that jumped, 0 for none."""

    latest_s: float = 0.0
    jumped_s: float = 0.0
    state: float = UNSEEN


@dataclass
class Clocks:
    """Age of the reported speeds, and onsets of the pushes in each direction.

    age_s: how much older than assumed the speeds are in the step that has them first; variance: of that, in
    s2; refused: how many ages in a row. An onset tells by how much a driving valve opens later than it
    did at first: it is measured against the commands by samples of the position, whose age is constant
    in a unit. How late the first ones were cannot be separated from that age: they are taken to be nominal, and
    origin_s is the mean of the first ones, count.
    """

    age_s: float = 0.0
    variance: float = UNKNOWN_S * UNKNOWN_S
    refused: float = 0.0
    origin_s: float = 0.0
    count: float = 0.0
    directions: tuple[Onsets, Onsets] = field(default_factory=lambda: (Onsets(), Onsets()))

    LARGEST = LARGEST_S, 1.0, REFUSED, 1.0, SETTLED, *(0.5, 0.5, DOUBTED) * 2
    """No number of `values` is further from zero."""

    @property
    def values(self) -> tuple[float, ...]:
        """All numbers, as they are kept in the memory."""
        both = [each for own in self.directions for each in (own.latest_s, own.jumped_s, own.state)]
        return self.age_s, self.variance, self.refused, self.origin_s, self.count, *both

    @classmethod
    def of(cls, values: Sequence[float]) -> Clocks | None:
        """Return the clocks with these numbers, None if they cannot be those of a unit."""
        pairs = zip(values, cls.LARGEST, strict=True)
        if not all(isfinite(each) and abs(each) <= most for each, most in pairs):
            return None
        age_s, variance, refused, origin_s, count = values[:5]
        both = Onsets(*values[5:8]), Onsets(*values[8:])
        return cls(age_s, variance, refused, origin_s, count, both)

    def aged(self, later_s: float) -> bool:
        """Take by how much later the speeds showed a release than the position did. Return whether it fits."""
        total = self.variance + SPEEDS_S * SPEEDS_S
        if later_s * later_s > UNLIKELY * UNLIKELY * total:
            self.refused += 1.0
            if self.refused >= REFUSED:
                self.variance, self.refused = UNKNOWN_S * UNKNOWN_S, 0.0
            return False
        gain = self.variance / total
        self.age_s = min(max(self.age_s + gain * later_s, -LARGEST_S), LARGEST_S)
        self.variance *= 1.0 - gain
        self.refused = 0.0
        return True

    def delays(self, direction: int, onset_s: float | None) -> Delays:
        """Return how much later the valves open: the driving one by this onset, or the latest if None.

        Of the neutral one nothing is measured in a push into a gear. If both others are late it is taken to be
        so, too (a block was exchanged), as far as the sooner one; if one is late alone it is taken to be in time.
        """
        own, other = self.directions[direction], self.directions[1 - direction]
        if own.state == UNSEEN:
            return Delays()
        driving_s, is_doubted = own.latest_s, own.state == DOUBTED
        if onset_s is not None:
            driving_s = onset_s - self.origin_s
            is_doubted = not self._is_confirmed(direction, driving_s)
        is_doubted |= other.state == DOUBTED and driving_s > other.latest_s + JUMP_S
        neutral_s = driving_s if other.state == UNSEEN else min(driving_s, other.latest_s)
        return Delays(driving_s, neutral_s, is_doubted)

    def began(self, direction: int, onset_s: float) -> None:
        """Follow the onsets; one that jumps is taken when another confirms it.

        Until then the other direction is in doubt as well: its valve may have been exchanged with this one.
        """
        if self.count == 0.0:
            self.origin_s = onset_s
        own, other = self.directions[direction], self.directions[1 - direction]
        later_s = onset_s - self.origin_s
        if (
            own.state == UNSEEN and later_s < -JUMP_S
        ):  # the other valve was exchanged: this one is nominal
            self.origin_s += later_s
            other.latest_s -= later_s
            later_s = 0.0
        if own.state == UNSEEN:
            own.latest_s, own.state = later_s, SEEN
        elif self._is_confirmed(direction, later_s):
            moved_s = later_s - own.latest_s
            own.latest_s += FOLLOWED * moved_s if abs(moved_s) <= JUMP_S else moved_s
            own.jumped_s, own.state = 0.0, SEEN
        else:
            own.jumped_s, own.state = later_s, DOUBTED
            self.doubt(1 - direction)
        if abs(later_s) <= JUMP_S and self.count < SETTLED:
            self._settle(later_s)

    def doubt(self, *directions: int) -> None:
        """Need another onset: after power-on, or a push that hid its own."""
        for direction in directions:
            if self.directions[direction].state == SEEN:
                self.directions[direction].state = DOUBTED

    def _settle(self, later_s: float) -> None:
        """Move the origin to the mean of the first onsets."""
        self.count += 1.0
        moved_s = later_s / self.count
        self.origin_s += moved_s
        for each in self.directions:
            each.latest_s -= moved_s

    def _is_confirmed(self, direction: int, later_s: float) -> bool:
        """Return whether an onset is near the latest, the one that jumped, or the other direction's."""
        own, other = self.directions[direction], self.directions[1 - direction]
        if abs(later_s - own.latest_s) <= JUMP_S:
            return True
        if own.jumped_s != 0.0 and abs(later_s - own.jumped_s) <= SAME_S:
            return True
        return other.state == SEEN and abs(later_s - other.latest_s) <= SAME_S

"""What a unit learns from shift to shift: how far its releases are from those of the tables.

Each method keeps numbers in a bounded memory and answers with an offset of the release to expect.
Sources: adaptation map per context, as in production transmissions (clutch fill and synchronizer
positions kept in the unit); run-to-run correction by sensitivities, a Kalman filter of slowly
drifting parameters; iterative learning control of first order (Bristow, Tharayil and Alleyne 2006);
extremum seeking from run to run (Ariyur and Krstic 2003).
"""

from __future__ import annotations

import abc
import struct
import zlib
from collections.abc import Callable, Mapping
from math import isfinite, sqrt
from typing import ClassVar, NamedTuple

from controller.clocks import Clocks

MAGIC = b"OPC4"
VERSION = 5
UNKNOWN_MESH = 0.054
"""Scatter of the meshing force between gears, relative."""
HEADER = struct.Struct("<4sBBIBbbf")
CHECKSUM = struct.Struct("<I")
RELEASE_S = 0.0005
"""Scatter of a release that was measured under a plain push."""
SURPRISING, OUTLYING, RECENT = 6.0, 20.0, 16.0
"""The square of an error, by its variance, counts up to the first, that of an outlier up to the second;
the mean is over so many shifts."""

STOPS, LIGHT, LIGHT_PER_PA = 0.28, 1.943, 3.316e-6
PASSES_S, NEAR_S, FREE_S, PASSED = 0.0140, 0.00503, 0.0028, 0.042
STOPPED_S, STOPPED_AT_S, STOPPED_PER_S, STOPPED = 0.034, 0.1211, 2.745, 0.024
HEAVIEST = 3.4
"""By which share the teeth resist a plain push: over the logarithm of its impulse in N s and the pressure,
and over the time from the release to the arrival, of one that passed the teeth and of one that stopped at them;
the scatter of both; and the logarithm up to which they are fitted (512 pushes of 14 to 28 N s in 16 trucks)."""
ALIKE = 0.015
"""What all measurements of the meshing force in a unit have in common, by friction and flows of its
actuator: scatter in 20 trucks with known forces."""


def heavier_by(spent: float, travel_s: float, supply_pa: float) -> tuple[float, float] | None:
    """Return by which share the teeth resisted a plain push more than those of the tables, and its variance.

    spent: logarithm of its impulse in N s. travel_s: from its release to its arrival. A push of a
    light shift hardly passes the teeth, or stops at them until the chamber is full. None for one
    that says nothing of them: a larger impulse, or no resistance.
    """
    if travel_s < PASSES_S or spent > HEAVIEST:
        return None
    by_impulse = STOPS * (spent - LIGHT + LIGHT_PER_PA * (supply_pa - 9e5))
    if travel_s > STOPPED_S:
        return by_impulse + STOPPED_PER_S * (travel_s - STOPPED_AT_S), STOPPED * STOPPED
    return by_impulse - NEAR_S / (travel_s - FREE_S), PASSED * PASSED


class Context(NamedTuple):
    """What a shift has in common with others: direction 0 or 1, and the impulse to expect.

    slope_s: change of the release by the logarithm of the impulse. share: where that logarithm is
    between the ends of the tables, 0 to 1. drag: by how much more a drag torque adds to the impulse
    than it does when warm, negative where it takes from it. scatter: of the impulse from shift to
    shift and of the speeds before it, relative.
    """

    direction: int
    slope_s: float
    share: float
    drag: float = 0.0
    scatter: float = 0.02


class Offset(NamedTuple):
    """How much later than in the tables a release comes, apart from the valves' delays, and its variance in s2."""

    later_s: float
    variance: float


class Correction(abc.ABC):
    """A method: numbers in `values`, which survive power-off."""

    number: ClassVar[int]
    fresh: ClassVar[tuple[float, ...]]
    """The numbers of a unit that has learned nothing."""
    largest: ClassVar[tuple[float, ...]]
    """No number is further from zero than this."""

    def __init__(self) -> None:
        self.shifts = 0
        self.plain = 0
        """How many pushes are yet to be plain, after a fault or an outlier."""
        self.values = list(self.fresh)
        self.clocks = Clocks()
        self.outliers = [0, 0]
        """By direction, outliers in a row, signed by their side."""
        self.surprise = 1.0
        """Mean square of the latest errors, each by the variance that was expected of it."""

    @abc.abstractmethod
    def offset(self, context: Context) -> Offset:
        """Return how much later than in the tables the release comes."""

    @abc.abstractmethod
    def learn(
        self, context: Context, error_s: float, impact_m_s: float, variance: float = RELEASE_S**2
    ) -> None:
        """Take how much later than expected a release came, and how hard the stop was.

        variance: of the error as it was measured, s2.
        """

    def heavier(self, direction: int) -> tuple[float, float]:
        """Return by which share the teeth resist more than those of the tables, and its variance."""
        return 0.0, UNKNOWN_MESH * UNKNOWN_MESH

    def resisted(self, direction: int, share: float, variance: float) -> None:  # noqa: B027
        """Take by which share the teeth resisted more, and how well that was measured."""

    def is_evidence(self, direction: int, error_s: float, needed: int) -> bool:
        """Count an outlier; `needed` in a row on the same side make the method forget the direction.

        Any number below `needed` is refused.
        """
        side = 1 if error_s > 0.0 else -1
        before = self.outliers[direction]
        count = before + side if before * side > 0 else side
        self.outliers[direction] = 0 if abs(count) >= needed else count
        if abs(count) < needed:
            return False
        self.forget(direction)
        return True

    def note(self, error_s: float, variance: float, is_outlier: bool = False) -> None:
        """Take how far a release was from what was expected, and the variance expected of that.

        A unit whose errors are larger than it expects knows less than it says; gross outliers count
        for more, since a valve that failed twice, as by a loose contact, will fail again.
        """
        square = min(error_s * error_s / variance, OUTLYING if is_outlier else SURPRISING)
        self.surprise += (square - self.surprise) / RECENT

    def forget(self, direction: int) -> None:
        """Begin anew with a direction."""
        size = len(self.fresh) // 2
        begin = direction * size
        self.values[begin : begin + size] = self.fresh[begin : begin + size]

    def dump(self) -> bytes:
        """Return the memory: version, method, shifts, surprise, numbers, checksum."""
        head = MAGIC, VERSION, self.number, self.shifts, self.plain, *self.outliers, self.surprise
        values = (*self.values, *self.clocks.values)
        body = HEADER.pack(*head) + struct.pack(f"<{len(values)}f", *values)
        return body + CHECKSUM.pack(zlib.crc32(body))

    def load(self, memory: bytes) -> None:
        """Take a memory of this version and method; any other leaves the defaults."""
        own = len(self.fresh)
        count = own + len(Clocks.LARGEST)
        size = HEADER.size + 4 * count
        if len(memory) != size + CHECKSUM.size:
            return
        body = memory[:size]
        if CHECKSUM.unpack(memory[size:])[0] != zlib.crc32(body):
            return
        magic, version, number, shifts, plain, *outliers, surprise = HEADER.unpack(
            body[: HEADER.size]
        )
        values = struct.unpack(f"<{count}f", body[HEADER.size :])
        if (magic, version, number) != (MAGIC, VERSION, self.number):
            return
        pairs = zip(values[:own], self.largest, strict=True)
        are_valid = all(isfinite(value) and abs(value) <= most for value, most in pairs)
        clocks = Clocks.of(values[own:])
        if clocks is None or not (are_valid and 0.0 <= surprise <= OUTLYING):
            return
        self.shifts, self.plain, self.outliers = shifts, plain, outliers
        self.surprise = surprise
        self.values, self.clocks = list(values[:own]), clocks


def _diagonal(*sd: float) -> list[float]:
    size = len(sd)
    return [sd[k % size] ** 2 if k % (size + 1) == 0 else 0.0 for k in range(size * size)]


class Sensitivities(Correction):
    """Friction of each synchronizer, and drag.

    release = table + slope * (friction + drag * its factor): a Kalman filter of three numbers that
    drift. What one shift says counts by its scatter: of the friction from shift to shift and of the
    measured release. Errors that lean to one side make them uncertain again: the oil was changed.
    """

    number = 1
    fresh = (0.0, 0.0, 0.015, *_diagonal(0.065, 0.065, 0.007), 0.0)
    fresh += (0.0, UNKNOWN_MESH**2) * 2
    largest = (0.5, 0.5, 0.2, *(1.0,) * 9, 20.0, *(1.0,) * 4)
    mesh_drift = 0.002**2
    drift = (0.0045**2, 0.0045**2, 0.0003**2)
    again = (0.03**2, 0.03**2, 0.003**2)
    """Added to the variances when the errors lean to one side."""
    leaning, forgets = 4.0, 0.75

    def offset(self, context: Context) -> Offset:
        """Return slope * (friction + drag), and what is known of it with the scatter."""
        own, slope_s, drag = context.direction, context.slope_s, context.drag
        by = self.values
        first = 3 + 3 * own
        with_drag = by[first + 2]
        known = by[first + own] + drag * (with_drag + with_drag + drag * by[11])
        known += context.scatter * context.scatter
        return Offset(slope_s * (by[own] + drag * by[2]), slope_s * slope_s * known)

    def learn(
        self, context: Context, error_s: float, impact_m_s: float, variance: float = RELEASE_S**2
    ) -> None:
        """Update the numbers and their covariances."""
        for k, added in enumerate(self.drift):
            self.values[3 + 4 * k] += added
        total = self.offset(context).variance + variance
        slope_s, own = context.slope_s, context.direction
        drag_s = slope_s * context.drag
        of = [slope_s * self.values[at + own] + drag_s * self.values[at + 2] for at in (3, 6, 9)]
        for k in range(3):
            gain = of[k] / total
            moved = self.values[k] + gain * error_s
            self.values[k] = min(max(moved, -self.largest[k]), self.largest[k])
            for j, each in enumerate(of, 3 + 3 * k):
                self.values[j] -= gain * each
        leans = self.forgets * self.values[12] + error_s / sqrt(total)
        if abs(leans) > self.leaning:
            leans = 0.0
            for k, added in enumerate(self.again):
                self.values[3 + 4 * k] += added
        self.values[12] = leans

    def heavier(self, direction: int) -> tuple[float, float]:
        """Return what the pushes of this direction have shown."""
        at = 13 + 2 * direction
        return self.values[at], max(self.values[at + 1], ALIKE * ALIKE)

    def resisted(self, direction: int, share: float, variance: float) -> None:
        """Move to what was measured, by how well it is known, half of the way at most.

        One measurement alone, by a sensor that is about to fail, must not be relied on.
        """
        at = 13 + 2 * direction
        mean, known = self.values[at : at + 2]
        known = min(known + self.mesh_drift, UNKNOWN_MESH * UNKNOWN_MESH)
        weight = min(known / (known + variance), 0.5)
        moved, rest = mean + weight * (share - mean), 1.0 - weight
        known = rest * rest * known + weight * weight * variance
        self.values[at : at + 2] = min(max(moved, -0.5), 0.5), known

    def forget(self, direction: int) -> None:
        """Begin anew: what both directions have in common is in doubt as well, but not the clocks."""
        self.values = list(self.fresh)


BINS = 8
UNKNOWN, WELL_KNOWN, KNOWN_AFTER = 0.065, 0.04, 4.0
"""Scatter of the impulse, relative, before and after so many shifts of a context."""


class Map(Correction):
    """An offset for each direction and range of impulses, the mean of the latest errors.

    A range that has not been met takes the offset of the nearest one that has.
    """

    number = 2
    fresh = (0.0, 0.0) * BINS * 2
    largest = (0.03, 255.0) * BINS * 2
    least_share = 0.15

    def _at(self, context: Context) -> int:
        index = min(int(context.share * BINS), BINS - 1)
        return 2 * (BINS * context.direction + index)

    def offset(self, context: Context) -> Offset:
        """Return the offset of the context; it is well known after some shifts."""
        own = self._at(context)
        sd_s = context.slope_s * (WELL_KNOWN if self.values[own + 1] >= KNOWN_AFTER else UNKNOWN)
        return Offset(self._later_s(context), sd_s * sd_s)

    def _later_s(self, context: Context) -> float:
        own, first = self._at(context), 2 * BINS * context.direction
        met = [at for at in range(first, first + 2 * BINS, 2) if self.values[at + 1] > 0.0]
        return self.values[min(met, key=lambda at: abs(at - own))] if met else 0.0

    def learn(
        self, context: Context, error_s: float, impact_m_s: float, variance: float = RELEASE_S**2
    ) -> None:
        """Move the offset of the context towards what would have been right."""
        at = self._at(context)
        right_s = self._later_s(context) + error_s
        count = self.values[at + 1]
        share = self._share(count)
        moved_s = right_s if count == 0.0 else self.values[at] + share * (right_s - self.values[at])
        self.values[at : at + 2] = (min(max(moved_s, -0.03), 0.03), min(count + 1.0, 255.0))

    def _share(self, count: float) -> float:
        return max(1.0 / (count + 1.0), self.least_share)


class Iterative(Map):
    """Iterative learning control of first order: the offset moves by a share of the last error."""

    number = 3
    share = 0.5

    def _share(self, count: float) -> float:
        return self.share


class Search(Map):
    """Extremum seeking: try a little earlier and a little later, and move to the softer side.

    It uses only how hard the stop was. The second number of a context is signed by the side that is
    tried next, and its size is the impact of the trial before.
    """

    number = 4
    probe_s = 0.001
    step_s = 0.001

    def note(self, error_s: float, variance: float, is_outlier: bool = False) -> None:
        """Do nothing: errors teach this method nothing, so they need not become smaller."""

    def _later_s(self, context: Context) -> float:
        """Return the offset of the context and the probe of this shift."""
        offset_s, last = self.values[self._at(context) : self._at(context) + 2]
        return offset_s + (-self.probe_s if last < 0.0 else self.probe_s)

    def learn(
        self, context: Context, error_s: float, impact_m_s: float, variance: float = RELEASE_S**2
    ) -> None:
        """Compare with the trial on the other side."""
        at = self._at(context)
        offset_s, last = self.values[at : at + 2]
        later = last >= 0.0
        if last != 0.0:
            softer = impact_m_s < abs(last)
            offset_s += self.step_s if softer is later else -self.step_s
        tried = max(impact_m_s, 1e-3)
        self.values[at : at + 2] = (min(max(offset_s, -0.03), 0.03), -tried if later else tried)


METHODS: Mapping[str, Callable[[], Correction]] = {
    "sensitivities": Sensitivities,
    "map": Map,
    "iterative": Iterative,
    "search": Search,
}

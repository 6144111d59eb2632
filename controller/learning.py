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
from math import isfinite
from typing import ClassVar, NamedTuple

MAGIC = b"OPC4"
VERSION = 1
HEADER = struct.Struct("<4sBBIB")
CHECKSUM = struct.Struct("<I")


class Context(NamedTuple):
    """What a shift has in common with others: direction 0 or 1, and the impulse to expect.

    slope_s: change of the release by the logarithm of the impulse. share: where that logarithm is
    between the ends of the tables, 0 to 1.
    """

    direction: int
    slope_s: float
    share: float


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
        """How many pushes are yet to be plain, after a fault."""
        self.values = list(self.fresh)
        self._outliers = [0, 0]

    @abc.abstractmethod
    def offset_s(self, context: Context) -> tuple[float, float]:
        """Return how much later than in the tables the release comes, and which part is delay."""

    @abc.abstractmethod
    def learn(self, context: Context, error_s: float, impact_m_s: float) -> None:
        """Take how much later than expected a release came, and how hard the stop was."""

    def is_evidence(self, direction: int, error_s: float, needed: int) -> bool:
        """Count an outlier; `needed` in a row on the same side make the method forget the direction.

        Any number below `needed` is refused.
        """
        side = 1 if error_s > 0.0 else -1
        before = self._outliers[direction]
        count = before + side if before * side > 0 else side
        self._outliers[direction] = 0 if abs(count) >= needed else count
        if abs(count) < needed:
            return False
        size = len(self.fresh) // 2
        begin = direction * size
        self.values[begin : begin + size] = self.fresh[begin : begin + size]
        return True

    def dump(self) -> bytes:
        """Return the memory: version, method, shifts, numbers, checksum."""
        body = HEADER.pack(MAGIC, VERSION, self.number, self.shifts, self.plain)
        body += struct.pack(f"<{len(self.values)}f", *self.values)
        return body + CHECKSUM.pack(zlib.crc32(body))

    def load(self, memory: bytes) -> None:
        """Take a memory of this version and method; any other leaves the defaults."""
        size = HEADER.size + 4 * len(self.fresh)
        if len(memory) != size + CHECKSUM.size:
            return
        body = memory[:size]
        if CHECKSUM.unpack(memory[size:])[0] != zlib.crc32(body):
            return
        magic, version, number, shifts, plain = HEADER.unpack(body[: HEADER.size])
        values = struct.unpack(f"<{len(self.fresh)}f", body[HEADER.size :])
        if (magic, version, number) != (MAGIC, VERSION, self.number):
            return
        pairs = zip(values, self.largest, strict=True)
        if all(isfinite(value) and abs(value) <= most for value, most in pairs):
            self.shifts, self.plain, self.values = shifts, plain, list(values)


class Sensitivities(Correction):
    """Friction level and delay of each direction, by the sensitivities of the tables.

    release = table + slope * gain + delay: a Kalman filter of two numbers that drift. What one shift
    tells counts by its scatter: of the friction from shift to shift and of the measured release.
    """

    number = 1
    fresh = (0.0, 0.0, 0.08**2, 0.0, 0.0015**2) * 2
    largest = (0.5, 0.02, 1.0, 1.0, 1.0) * 2
    scatter = 0.022
    measured_s = 0.0008
    drift = (0.004**2, 0.00015**2)

    def offset_s(self, context: Context) -> tuple[float, float]:
        """Return slope * gain + delay, and the delay."""
        at = 5 * context.direction
        gain, delay_s = self.values[at : at + 2]
        return context.slope_s * gain + delay_s, delay_s

    def learn(self, context: Context, error_s: float, impact_m_s: float) -> None:
        """Update the two numbers and their covariances."""
        at = 5 * context.direction
        gain, delay_s, gg, gd, dd = self.values[at : at + 5]
        gg, dd = gg + self.drift[0], dd + self.drift[1]
        slope_s = context.slope_s
        of_gain, of_delay = slope_s * gg + gd, slope_s * gd + dd
        scatter_s = slope_s * self.scatter
        noise = scatter_s * scatter_s + self.measured_s * self.measured_s
        total = slope_s * of_gain + of_delay + noise
        k_gain, k_delay = of_gain / total, of_delay / total
        gain = min(max(gain + k_gain * error_s, -0.5), 0.5)
        delay_s = min(max(delay_s + k_delay * error_s, -0.02), 0.02)
        gg, gd, dd = gg - k_gain * of_gain, gd - k_gain * of_delay, dd - k_delay * of_delay
        self.values[at : at + 5] = (gain, delay_s, gg, gd, dd)


BINS = 8


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

    def offset_s(self, context: Context) -> tuple[float, float]:
        """Return the offset of the context, none of it as delay."""
        own, first = self._at(context), 2 * BINS * context.direction
        met = [at for at in range(first, first + 2 * BINS, 2) if self.values[at + 1] > 0.0]
        if not met:
            return 0.0, 0.0
        return self.values[min(met, key=lambda at: abs(at - own))], 0.0

    def learn(self, context: Context, error_s: float, impact_m_s: float) -> None:
        """Move the offset of the context towards what would have been right."""
        at = self._at(context)
        right_s = self.offset_s(context)[0] + error_s
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

    def offset_s(self, context: Context) -> tuple[float, float]:
        """Return the offset of the context and the probe of this shift."""
        offset_s, last = self.values[self._at(context) : self._at(context) + 2]
        return offset_s + (-self.probe_s if last < 0.0 else self.probe_s), 0.0

    def learn(self, context: Context, error_s: float, impact_m_s: float) -> None:
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

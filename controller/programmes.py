"""Programmes of the neutral valve over the expected release of the synchronizer, computed off line.

`releases.csv` holds when the plain push is released, over the impulse, for some supply pressures.
`programmes.csv` holds, for these pressures, a row for each of a series of such releases, and in it for
each strength: when the programme is released, how the one follows the other, and its fillings.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from functools import cache
from importlib.resources import files
from math import log
from typing import NamedTuple

NEVER = 1 << 30
"""A step that never comes."""
CAREFUL, STRONG = range(2)
"""Strengths: for what a new unit knows; the first of those for a release and a meshing force that are
well known, one for each level of the force."""
LIGHTEST, PER_LEVEL, LEVELS = 0.01, 0.045, 5
"""Meshing force of the first level, by which share more than that of the tables, and from one to the next."""
LATE = STRONG + LEVELS
"""The last strength: a single filling, for a release that became known when the others had to begin."""
SOFTEST = STRONG, STRONG + 1, STRONG + 2, CAREFUL, STRONG + 3, LATE, STRONG + 4
"""The strengths in the order of their mean impact under a usual meshing force."""


class Filling(NamedTuple):
    """The neutral valve is commanded from a step on, counted from the start of the push.

    end_s: when it is to have closed, from the command of the push on.
    """

    start: int
    end_s: float


class Programme(NamedTuple):
    """A row: plain_s, released_s: release under the plain push and under this programme.

    gain: change of the latter by the former. begin: the first step of its fillings.
    """

    plain_s: float
    released_s: float
    gain: float
    fillings: tuple[Filling, ...]
    begin: int


class Table(NamedTuple):
    """Releases and programmes for one supply pressure.

    log_impulse: logarithm of the first impulse in N s, and the step from one to the next. plain_s:
    releases of the plain push with these impulses. rows: by strength, over rows_s, which are step_s apart.
    """

    supply_pa: float
    log_impulse: tuple[float, float]
    plain_s: tuple[float, ...]
    rows_s: tuple[float, ...]
    step_s: float
    rows: tuple[tuple[Programme, ...], ...]

    def row(self, plain_s: float, step: int, strengths: Sequence[int]) -> Programme | None:
        """Return the programme whose release under the plain push is nearest, of the first strength.

        The second nearest if only that can still begin, then those of the next strength; None if none can,
        or beyond the table.
        """
        at = (plain_s - self.rows_s[0]) / self.step_s
        if at < 0.0 or plain_s >= self.rows_s[-1]:
            return None
        before = int(at)
        after = before + 1
        nearest = (before, after) if at - before < 0.5 else (after, before)
        for strength in strengths:
            for index in nearest:
                programme = self.rows[strength][index]
                if step <= programme.begin:
                    return programme
        return None

    def release(self, log_impulse: float) -> tuple[float, float]:
        """Return when the plain push is released, s, and its slope over the logarithm, s."""
        first, step = self.log_impulse
        at = (log_impulse - first) / step
        before = int(min(max(at, 0.0), len(self.plain_s) - 2))
        rise_s = self.plain_s[before + 1] - self.plain_s[before]
        return self.plain_s[before] + (at - before) * rise_s, rise_s / step

    def spent(self, after_s: float) -> tuple[float, float]:
        """Return the logarithm of the impulse given by a time, and the slope of `release` there."""
        times = self.plain_s
        before = min(max(bisect_right(times, after_s), 1), len(times) - 1) - 1
        rise_s = times[before + 1] - times[before]
        first, step = self.log_impulse
        return first + step * (before + (after_s - times[before]) / rise_s), rise_s / step


class Nearby(NamedTuple):
    """The tables around a supply pressure: `low` and `high`, and `between`, 0 at the lower one."""

    nearest: Table
    low: Table
    high: Table
    between: float

    def release(self, log_impulse: float) -> tuple[float, float, float]:
        """Return when the plain push is released, s, its slope over the logarithm, s, and the row.

        The row is that of the impulse, as a share of the last one. Both tables have the same impulses.
        """
        low, high, share = self.low.plain_s, self.high.plain_s, self.between
        first, step = self.low.log_impulse
        last = len(low) - 1
        at = (log_impulse - first) / step
        before = min(int(max(at, 0.0)), last - 1)
        after = before + 1
        begin_s, rise_s = low[before], low[after] - low[before]
        rise_s += share * (high[after] - high[before] - rise_s)
        begin_s += share * (high[before] - begin_s)
        return begin_s + (at - before) * rise_s, rise_s / step, at / last


class Library:
    """All tables, by ascending supply pressure."""

    def __init__(self, tables: Sequence[Table]) -> None:
        self.tables = tables

    def near(self, supply_pa: float) -> Nearby:
        """Return the tables around a supply pressure, the last two beyond them."""
        tables, above = self.tables, 1
        while above < len(tables) - 1 and tables[above].supply_pa <= supply_pa:
            above += 1
        low, high = tables[above - 1], tables[above]
        between = (supply_pa - low.supply_pa) / (high.supply_pa - low.supply_pa)
        return Nearby(high if between > 0.5 else low, low, high, between)


def _programme(plain_s: float, fields: list[str]) -> Programme:
    released, gain, *numbers = fields
    pairs = zip(numbers[::2], numbers[1::2], strict=True)
    fillings = tuple(Filling(int(step), 1e-4 * int(end)) for step, end in pairs if int(step) >= 0)
    begin = fillings[0].start if fillings else NEVER
    return Programme(plain_s, 1e-4 * int(released), float(gain), fillings, begin)


def _lines(name: str) -> list[str]:
    text = files("controller").joinpath(name).read_text(encoding="utf-8")
    return [line for line in text.splitlines() if not line.startswith("#")]


@cache
def library() -> Library:
    """Return the tables that come with the firmware."""
    numbers = [[float(each) for each in line.split(",")] for line in _lines("releases.csv")]
    logs = [log(impulse_n_s) for impulse_n_s, *_ in numbers]
    axis = logs[0], (logs[-1] - logs[0]) / (len(logs) - 1)
    rows: dict[float, list[list[Programme]]] = {}
    for line in _lines("programmes.csv"):
        head, *strengths = line.split(";")
        bar, plain = map(float, head.split(","))
        found = [_programme(1e-4 * plain, each.split(",")) for each in strengths]
        rows.setdefault(bar, []).append(found)
    tables = []
    for k, (bar, found_of) in enumerate(sorted(rows.items())):
        programmes = tuple(zip(*found_of, strict=True))
        plain_s = tuple(1e-4 * times[1 + k] for times in numbers)
        rows_s = tuple(row.plain_s for row in programmes[CAREFUL])
        step_s = (rows_s[-1] - rows_s[0]) / (len(rows_s) - 1)
        tables.append(Table(1e5 * bar, axis, plain_s, rows_s, step_s, programmes))
    return Library(tables)

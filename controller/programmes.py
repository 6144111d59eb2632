"""Programmes of the valves over the expected release of the synchronizer, computed off line.

`programmes.csv` holds, for some supply pressures and closing delays, a row for each of a series of
impulses and for each strength: when the plain push would be released, when the programme is, how the
one follows the other, and the programme in steps of the firmware.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Mapping, Sequence
from functools import cache
from importlib.resources import files
from math import log
from typing import NamedTuple

NEVER = 1 << 30
"""A step that never comes."""
CAREFUL, STRONG = range(2)
"""Strengths: for what a new unit knows; the first of those for a release and a meshing force that are
well known, one for each level of the force."""
LIGHTEST, PER_LEVEL, LEVELS = -0.08, 0.04, 7
"""Meshing force of the first level, by which share more than that of the tables, and from one to the next."""


class Pulse(NamedTuple):
    """Steps from `start` on, before `end`, counted from the start of the push."""

    start: int
    end: int


class Programme(NamedTuple):
    """A row: plain_s, released_s: release under the plain push and under this programme.

    gain: change of the latter by the former. vents: steps without filling the driving chamber;
    brakes: steps of filling the neutral one. begin: the first step of either.
    """

    plain_s: float
    released_s: float
    gain: float
    vents: tuple[Pulse, ...]
    brakes: tuple[Pulse, ...]
    begin: int


class Table(NamedTuple):
    """Programmes for one supply pressure and closing delay, over ascending impulses.

    log_impulse: logarithm of the first impulse in N s, and the step from row to row. rows: by
    strength.
    """

    supply_pa: float
    close_s: float
    log_impulse: tuple[float, float]
    rows: tuple[tuple[Programme, ...], ...]
    plain_s: tuple[float, ...]

    def row(self, plain_s: float, step: int, strength: int) -> Programme | None:
        """Return the programme of a strength whose release under the plain push is nearest.

        The second nearest if only that can still begin; None if neither can, or beyond the table.
        """
        times, rows = self.plain_s, self.rows[strength]
        after = bisect_right(times, plain_s)
        if not 0 < after < len(times):
            return None
        before = after - 1
        nearer = plain_s - times[before] < times[after] - plain_s
        for index in (before, after) if nearer else (after, before):
            if step <= rows[index].begin:
                return rows[index]
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
    """The tables around a supply pressure: `low` and `high`, and `between`, 0 at the lower one.

    safe: the table whose programmes are used, for no more pressure than there is: with less than it was
    made for, a programme stalls thirty times as often at 0.25 bar.
    """

    nearest: Table
    low: Table
    high: Table
    between: float
    safe: Table

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
    """All tables, for closing delays and, for each, ascending supply pressures."""

    def __init__(self, tables: Mapping[float, Sequence[Table]]) -> None:
        self._tables = tables

    def near(self, supply_pa: float, close_s: float) -> Nearby:
        """Return the tables around a supply pressure, for the nearest closing delay."""
        column = self._tables[min(self._tables, key=lambda delay_s: abs(delay_s - close_s))]
        above = 1
        while above < len(column) - 1 and column[above].supply_pa <= supply_pa:
            above += 1
        low, high = column[above - 1], column[above]
        between = (supply_pa - low.supply_pa) / (high.supply_pa - low.supply_pa)
        safe = high if between >= 1.0 else low
        return Nearby(high if between > 0.5 else low, low, high, between, safe)


def _pulses(fields: list[str]) -> tuple[Pulse, ...]:
    numbers = [int(field) for field in fields]
    pairs = zip(numbers[::2], numbers[1::2], strict=True)
    return tuple(Pulse(start, start + length) for start, length in pairs if length > 0)


def _programme(plain_s: float, fields: list[str]) -> Programme:
    released, gain, *steps = fields
    vents, brakes = _pulses(steps[:4]), _pulses(steps[4:])
    begin = min((act.start for act in (*vents, *brakes)), default=NEVER)
    return Programme(plain_s, 1e-4 * int(released), float(gain), vents, brakes, begin)


@cache
def library() -> Library:
    """Return the tables that come with the firmware."""
    rows: dict[tuple[float, float], list[tuple[float, list[Programme]]]] = {}
    text = files("controller").joinpath("programmes.csv").read_text(encoding="utf-8")
    for line in text.splitlines():
        if line.startswith("#"):
            continue
        head, *strengths = line.split(";")
        supply, close, impulse, plain = head.split(",")
        found = [_programme(1e-4 * int(plain), each.split(",")) for each in strengths]
        table = 1e-3 * float(close), 1e5 * float(supply)
        rows.setdefault(table, []).append((log(float(impulse)), found))
    tables: dict[float, list[Table]] = {}
    for (close_s, supply_pa), pairs in sorted(rows.items()):
        logs, found_of = zip(*pairs, strict=True)
        axis = (logs[0], (logs[-1] - logs[0]) / (len(logs) - 1))
        programmes = tuple(zip(*found_of, strict=True))
        plain_s = tuple(row.plain_s for row in programmes[CAREFUL])
        tables.setdefault(close_s, []).append(Table(supply_pa, close_s, axis, programmes, plain_s))
    return Library(tables)

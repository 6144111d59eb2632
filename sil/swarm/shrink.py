"""The shortest scenario near a failing one that still breaks the same rule.

hypothesis does not carry here: it shrinks only what it has drawn itself in the same process, and the
runs of a swarm are drawn from seeds and executed elsewhere.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from sil.rules import Violation
from sil.simulation.scenario import FAULT_TABLES
from sil.swarm.draw import Table

Judge = Callable[[Mapping[str, Any]], Violation | None]


def shrink(table: Mapping[str, Any], broken: Judge, runs: int = 400) -> Table:
    """Return a table with fewer faults and requests, shorter, and with rounder numbers.

    broken: returns where a table breaks the rule, None if it keeps it. Takes the first simpler table that
    still fails, until none does or `runs` are spent.
    """
    smallest = copy.deepcopy(dict(table))
    candidates = _simpler(smallest, broken)
    for _ in range(runs):
        simpler = next(candidates, None)
        if simpler is None:
            break
        if simpler != smallest and broken(simpler):
            smallest = simpler
            candidates = _simpler(smallest, broken)
    return smallest


def _simpler(table: Table, broken: Judge) -> Iterator[Table]:
    """Yield simpler tables, those first that take most away."""
    lists = (*FAULT_TABLES, "request")
    if violation := broken(table):
        end_s = round(violation.time_s + 0.06, 1)
        last_s = max((request["at_s"] for request in table["request"]), default=0.0)
        if max(violation.time_s, last_s) < end_s < table["duration_s"]:
            yield {**table, "duration_s": end_s}
    for name in lists:
        for index in range(len(table.get(name, ()))):
            yield _with(table, name, [*table[name][:index], *table[name][index + 1 :]])
    for name in ("controller", "driveline", "plant", "clock", "bus"):
        if name in table:
            yield {key: value for key, value in table.items() if key != name}
            for key in table[name]:
                yield _with(table, name, {k: v for k, v in table[name].items() if k != key})
            for key, part in table[name].items():
                for inner in part if isinstance(part, dict) else ():
                    rest = {k: v for k, v in part.items() if k != inner}
                    yield _with(table, name, {**table[name], key: rest})
    yield {**table, "seed": 1}
    for name in lists:
        for index, row in enumerate(table.get(name, ())):
            for simpler in _simpler_rows(row):
                yield _with(table, name, [*table[name][:index], simpler, *table[name][index + 1 :]])


def _simpler_rows(row: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    for key in row:
        if key not in ("kind", "gear", "at_s"):
            yield {k: v for k, v in row.items() if k != key}
    for key, value in row.items():
        if isinstance(value, float):
            for digits in (0, 1, 2, 3):
                yield {**row, key: round(value, digits)}


def _with(table: Table, name: str, value: Any) -> Table:
    """Return the table with another value, or without it if the value is empty."""
    rest = {key: other for key, other in table.items() if key != name}
    return {**rest, name: value} if value or name == "request" else rest

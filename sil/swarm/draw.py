"""Scenario tables drawn at random, new ones and neighbours of earlier ones.

A table depends on the generator that it is given and nothing else.
"""

from __future__ import annotations

import copy
import random
from collections.abc import Mapping
from typing import Any

from sil.simulation.scenario import FAULT_TABLES
from sil.swarm.vocabulary import state, vocabulary

Table = dict[str, Any]
GEARS = ("neutral", "backward", "forward")

SETTINGS: dict[str, tuple[Any, ...]] = {
    "period_s": (0.0025, 0.005, 0.01),
    "filter": (False, True),
    "windows": ({"samples": 1}, {"samples": 4}, {}),
    "blow": ({"duration_s": 0.0}, {"duration_s": 0.05}, {"cut": "none"}, {"cut": "confirmation"}),
    "shift": (
        {"push_timeout_s": 0.2, "retries": 0},
        {"push_timeout_s": 0.2, "retries": 1, "retry_pause_s": 0.02},
        {"push_timeout_s": 0.15, "no_motion_s": 0.1},
        {"wait_for_sync": True, "sync_wait_s": 0.1, "push_timeout_s": 0.3},
        {"hold_s": 0.0, "vent_s": 0.0, "push_timeout_s": 0.3},
        {"vent_s": 0.5, "push_timeout_s": 0.3},
        {"interlock_s": 0.4, "reversal_settle_s": 0.0},
    ),
    "strategy": ("blow_cut", "air_cushion", "sliding_mode", "synchro_brake", "bang_bang"),
}
"""Settings of the firmware that change its sequence; short limits reach more of it in the same time."""


def new_table(rng: random.Random, base: Mapping[str, Any]) -> Table:
    """Return a scenario table drawn over all that a scenario can state, around a base."""
    table = copy.deepcopy(dict(base))
    table["seed"] = rng.randrange(1 << 32)
    table["duration_s"] = rng.choice([0.6, 1.2, 2.0, 4.0])
    table["trace_period_s"] = 0.001
    table["initial_gear"] = rng.choice(GEARS)
    table["request"] = []
    for _ in range(rng.choice([1, 1, 2, 3, 4])):
        _add_request(table, rng)
    table["plant"] = {
        **table.get("plant", {}),
        "mounted": rng.random() < 0.7,
        "mesh_force_n": round(rng.uniform(0.0, 1300.0)),
        "pull_force_n": round(rng.uniform(0.0, 1100.0)),
        "supply_pressure_pa": round(rng.uniform(2.5e5, 1e6), -3),
    }
    table["driveline"] = table.get("driveline", {}) | {
        f"impulse_{gear}_n_s": rng.choice([0.0, 18.0, 78.0, 250.0])
        for gear in ("backward", "forward")
    }
    for _ in range(rng.choice([0, 1, 1, 2, 3])):
        _add_fault(table, rng)
    for _ in range(rng.choice([0, 0, 1, 2])):
        _change_setting(table, rng)
    return table


def neighbour(rng: random.Random, table: Mapping[str, Any]) -> Table:
    """Return a copy of a table in which one to three things differ."""
    changed = copy.deepcopy(dict(table))
    for _ in range(rng.choice([1, 1, 2, 3])):
        rng.choice(_MOVES)(changed, rng)
    return changed


def _add_request(table: Table, rng: random.Random) -> None:
    at_s = round(rng.uniform(0.02, table["duration_s"] - 0.05), 3)
    taken = {request["at_s"] for request in table["request"]}
    if at_s not in taken:
        table["request"].append({"at_s": at_s, "gear": rng.choice(GEARS)})
        table["request"].sort(key=lambda request: request["at_s"])


def _move_request(table: Table, rng: random.Random) -> None:
    if table["request"]:
        table["request"].pop(rng.randrange(len(table["request"])))
    _add_request(table, rng)


def _add_fault(table: Table, rng: random.Random) -> None:
    group = rng.choice(list(vocabulary().values()))
    state(table, rng.choice(group), rng)


def _faults(table: Mapping[str, Any]) -> list[tuple[str, int]]:
    return [(name, k) for name in FAULT_TABLES for k in range(len(table.get(name, ())))]


def _drop_fault(table: Table, rng: random.Random) -> None:
    if faults := _faults(table):
        name, index = rng.choice(faults)
        table[name].pop(index)


def _move_fault(table: Table, rng: random.Random) -> None:
    if faults := _faults(table):
        name, index = rng.choice(faults)
        fault = table[name][index]
        by_s = round(rng.gauss(0.0, 0.05), 4)
        by_s = max(by_s, -fault["start_s"])
        for key in {"start_s", "end_s"} & set(fault):
            fault[key] = round(fault[key] + by_s, 4)


def _change_setting(table: Table, rng: random.Random) -> None:
    name = rng.choice(list(SETTINGS))
    table.setdefault("controller", {})[name] = copy.deepcopy(rng.choice(SETTINGS[name]))


def _lengthen(table: Table, rng: random.Random) -> None:
    table["duration_s"] = min(2.0 * table["duration_s"], 6.0)


def _reseed(table: Table, rng: random.Random) -> None:
    table["seed"] = rng.randrange(1 << 32)


_MOVES = (
    *(_add_fault, _add_fault, _drop_fault, _move_fault, _add_request, _move_request),
    *(_change_setting, _lengthen, _reseed),
)

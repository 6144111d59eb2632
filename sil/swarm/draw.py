"""Scenario tables drawn at random; a table depends on the generator that it is given, and nothing else."""

from __future__ import annotations

import copy
import random
from collections.abc import Mapping
from typing import Any

from sil.swarm.vocabulary import GUARDED, state, vocabulary

Table = dict[str, Any]
GEARS = ("neutral", "backward", "forward")

SUPPLIES_PA = ((1.2e5, 3e5), (4e5, 1e6), (4e5, 1e6))  # too low for most shifts, and usual

DRAWN_SETTINGS: dict[str, tuple[Any, ...]] = {
    "period_s": (0.0025, 0.005),
    "filter": (False,),
    "windows.samples": (1, 4),
    "blow.duration_s": (0.0, 0.05),
    "blow.cut": ("none", "confirmation"),
    "shift.push_timeout_s": (0.15, 0.2, 0.3),
    "shift.retries": (0, 1, 2),
    "shift.retry_pause_s": (0.0, 0.02, 0.3),
    "shift.no_motion_s": (0.1,),
    "shift.wait_for_sync": (True,),
    "shift.sync_wait_s": (0.1, 0.4),
    "shift.hold_s": (0.0, 0.3),
    "shift.vent_s": (0.0, 0.3),
    "shift.interlock_s": (0.0, 0.3, 0.6),
    "shift.reversal_settle_s": (0.0, 0.3),
    "strategy": ("blow_cut", "air_cushion", "sliding_mode", "synchro_brake"),
}
"""Settings of the firmware that change its sequence, with values at which it takes other ways."""


def new_table(rng: random.Random, base: Mapping[str, Any]) -> Table:
    """Return a scenario table drawn over all that a scenario can state, around a base."""
    table = copy.deepcopy(dict(base))
    table["seed"] = rng.randrange(1 << 32)
    table["duration_s"] = rng.choice([0.6, 1.2, 2.0, 4.0])
    table["trace_period_s"] = 0.001
    table["initial_gear"] = rng.choice(GEARS)
    table["request"] = []
    _add_request(table, rng, rng.uniform(0.0, 0.4))
    for _ in range(rng.choice([0, 1, 2, 3])):
        _add_request(table, rng)
    table["plant"] = {
        **table.get("plant", {}),
        "mounted": rng.random() < 0.7,
        "mesh_force_n": round(rng.uniform(0.0, 1300.0)),
        "pull_force_n": round(rng.uniform(0.0, 1100.0)),
        "supply_pressure_pa": round(rng.uniform(*rng.choice(SUPPLIES_PA)), -3),
    }
    table["driveline"] = table.get("driveline", {}) | {
        f"impulse_{gear}_n_s": rng.choice([0.0, 18.0, 78.0, 250.0])
        for gear in ("backward", "forward")
    }
    for _ in range(rng.choice([0, 1, 1, 2, 3])):
        _add_fault(table, rng)
    if rng.random() < 0.1:
        _start_clock(table, rng)
    if rng.random() < 0.6:  # a push that fails soon leaves time for what follows
        _set(table, "shift.push_timeout_s", rng)
    for _ in range(rng.choice([0, 1, 3, 6])):
        _set(table, rng.choice(list(DRAWN_SETTINGS)), rng)
    return table


def _add_request(table: Table, rng: random.Random, at_s: float | None = None) -> None:
    """Add a request for another gear: any time, or while the one before it is still served."""
    requests, end_s = table["request"], table["duration_s"] - 0.05
    if at_s is None:
        at_s = rng.uniform(0.02, end_s)
        if requests and rng.random() < 0.6:
            at_s = rng.choice(requests)["at_s"] + rng.uniform(0.0, rng.choice([0.15, 0.8]))
    at_s = round(at_s, 3)
    if at_s < end_s and all(request["at_s"] != at_s for request in requests):
        before = [request["gear"] for request in requests if request["at_s"] < at_s]
        last = before[-1] if before else table["initial_gear"]
        requests.append({"at_s": at_s, "gear": rng.choice([g for g in GEARS if g != last])})
        requests.sort(key=lambda request: request["at_s"])


def _add_fault(table: Table, rng: random.Random) -> None:
    group = rng.choice(list(vocabulary().values()))
    kind = rng.choice(sorted({fault.kind for fault in group}))
    faults = [fault for fault in group if fault.kind == kind]
    guarded = [fault for fault in faults if fault.whom in GUARDED]
    state(table, rng.choice(guarded if guarded and rng.random() < 0.7 else faults), rng)


def _set(table: Table, path: str, rng: random.Random) -> None:
    part, _, name = path.rpartition(".")
    controller = table.setdefault("controller", {})
    within = controller.setdefault(part, {}) if part else controller
    within[name] = rng.choice(DRAWN_SETTINGS[path])


def _start_clock(table: Table, rng: random.Random) -> None:
    """Let a counter of the firmware overflow within the run."""
    # 32-bit counters of microseconds and of milliseconds overflow
    overflows_s = (2**31 * 1e-6, 2**32 * 1e-6, 2**31 * 1e-3, 2**32 * 1e-3)
    start_s = rng.choice(overflows_s) - rng.uniform(0.0, table["duration_s"])
    table.setdefault("clock", {})["controller_start_s"] = round(start_s, 3)

"""Scenarios with up to two faults, drawn at random over everything that a scenario lets fail."""

from __future__ import annotations

import random
from typing import Any

from sil.simulation.load_scenario import Loaded, from_table
from sil.swarm.draw import FaultKind, state, vocabulary

SHIFTS = {"N-B": ("neutral", "backward"), "B-N": ("backward", "neutral"),
          "N-F": ("neutral", "forward"), "F-N": ("forward", "neutral"),
          "B-F": ("backward", "forward")}  # fmt: skip


def base(shift: str) -> dict[str, Any]:
    """One shift in the truck, requested at 0.1 s."""
    start, end = SHIFTS[shift]
    return {
        "name": "drawn",
        "duration_s": 1.2,
        "initial_gear": start,
        "trace_period_s": 0.001,
        "request": [{"at_s": 0.1, "gear": end}],
        "plant": {"mounted": True, "mesh_force_n": 600.0, "pull_force_n": 500.0},
        "driveline": {"impulse_backward_n_s": 18.0, "impulse_forward_n_s": 18.0},
    }


def faults_of(number: int) -> list[FaultKind]:
    """Faults of scenario `number`: the first have every fault once, shuffled; a second one is drawn by group, then by fault."""
    groups = vocabulary()
    every = [fault for group in groups.values() for fault in group]
    turn, place = divmod(number, len(every))
    random.Random(f"turn {turn}").shuffle(every)
    rng = random.Random(f"faults {number}")
    second = rng.choice(rng.choice(list(groups.values())))
    return [every[place], second] if rng.random() < 0.7 else [every[place]]


def draw(number: int) -> Loaded:
    """Scenario `number`: a shift, or two, and up to two faults."""
    rng = random.Random(f"scenario {number}")
    table = base(rng.choice(list(SHIFTS)))
    table["seed"] = number + 1
    if rng.random() < 0.2:  # long enough for a second try, and for giving up
        table["duration_s"] = 3.0
    if rng.random() < 0.3:
        gears = {"neutral", "backward", "forward"} - {table["request"][0]["gear"]}
        again = {"at_s": round(rng.uniform(0.15, 1.0), 3), "gear": rng.choice(sorted(gears))}
        table["request"].append(again)
    for fault in faults_of(number):
        state(table, fault, rng)
    valves = table.get("valve_fault", [])
    if len(valves) == 2 and valves[0]["kind"] == valves[1]["kind"]:
        valves[1]["valve"] = "BNF"["FBN".index(valves[0]["valve"])]
    return from_table(table, f"drawn {number}")

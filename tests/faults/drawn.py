"""Scenarios with up to two faults, drawn at random over everything that can fail."""

from __future__ import annotations

import random
from typing import Any

from sil.scenario import Loaded, from_table

SHIFTS = {"N-B": ("neutral", "backward"), "B-N": ("backward", "neutral"),
          "N-F": ("neutral", "forward"), "F-N": ("forward", "neutral"),
          "B-F": ("backward", "forward")}  # fmt: skip
FRAMES = ("ShiftRequest", "ValveCommand", "SafetyBlow", "PositionPulse", "DrivelineSpeeds",
          "ControllerStatus")  # fmt: skip


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


def window(rng: random.Random) -> dict[str, float]:
    """When a fault acts: from the start, or from some moment around the shift; for good or not."""
    start = rng.choice([0.0, rng.uniform(0.05, 0.5)])
    if rng.random() < 0.5:
        return {"start_s": round(start, 4)}
    return {"start_s": round(start, 4), "end_s": round(start + rng.uniform(0.01, 0.5), 4)}


def draw_fault(rng: random.Random) -> tuple[str, dict[str, Any]]:
    """One fault: the scenario's list it belongs to, and its table."""
    where = rng.choice(["fault", "sensor_fault", "temperature_fault", "speed_fault", "valve_fault"])
    told: dict[str, Any] = window(rng)
    if where == "sensor_fault":
        told["kind"] = rng.choice(["stuck", "garbage", "wrong", "off", "slow", "delayed", "intermittent"])
        if told["kind"] == "wrong":
            told["offset_s"] = round(rng.uniform(-4e-4, 4e-4), 6)
        if told["kind"] == "delayed":
            told["late"] = rng.randint(1, 30)
    elif where == "temperature_fault":
        told["kind"] = rng.choice(["off", "stuck", "wrong", "garbage", "intermittent"])
        told["value_k"] = round(rng.uniform(230.0, 430.0), 1)
        told["offset_k"] = round(rng.uniform(-80.0, 80.0), 1)
    elif where == "speed_fault":
        told["kind"] = rng.choice(["off", "stuck", "wrong", "garbage", "slow", "delayed", "intermittent"])
    elif where == "valve_fault":
        told["valve"] = rng.choice("BNF")
        told["kind"] = rng.choice(["off", "stuck", "garbage", "wrong", "slow", "delayed", "intermittent"])
    else:
        told["kind"] = rng.choice(["loss", "error_frame", "corruption", "delay", "frozen_counter",
                                   "bus_off", "dead", "stalled"])  # fmt: skip
        if told["kind"] in ("bus_off", "dead", "stalled"):
            told["node"] = rng.choice(["driver", "controller"])
            if told["kind"] == "dead":
                told.pop("end_s", None)
            elif told["kind"] == "stalled":
                told.setdefault("end_s", told["start_s"] + 0.2)
        else:
            told["message"] = rng.choice(FRAMES)
            told["probability"] = rng.choice([1.0, 0.5, 0.1])
            if told["kind"] == "corruption":
                told["bits"] = rng.randint(1, 12)
            if told["kind"] == "delay":
                told["delay_s"] = round(rng.uniform(0.001, 0.2), 4)
    return where, told


def draw(number: int) -> Loaded:
    """Scenario `number`: a shift and up to two faults."""
    rng = random.Random(f"faults {number}")
    table = base(rng.choice(list(SHIFTS)))
    table["seed"] = number + 1
    for _ in range(rng.choice([1, 2, 2])):
        where, told = draw_fault(rng)
        table.setdefault(where, []).append(told)
    valves = table.get("valve_fault", [])
    if len(valves) == 2 and valves[0]["kind"] == valves[1]["kind"]:
        valves[1]["valve"] = "BNF"["FBN".index(valves[0]["valve"])]
    return from_table(table, f"drawn {number}")

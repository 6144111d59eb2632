"""Scenario tables drawn at random; a table depends on the generator that it is given, and nothing else."""

from __future__ import annotations

import copy
import functools
import random
import typing
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import msgspec

from can_dbc.e2e import PROTECTED
from can_dbc.frame import DP_BIT, EDP_BIT
from plant.devices.position_circuit import SensorFault
from plant.devices.signal_faults import SpeedFault, TemperatureFault
from plant.devices.valve_faults import ValveFault
from sil.coupling.faults import BusFault, FrozenCounter

GUARDED = {kind.__name__ for kind in PROTECTED}  # messages with end-to-end protection

Draw = Callable[[random.Random], Any]


class FaultKind(NamedTuple):
    """One fault of the vocabulary: the scenario's list, its kind, whom it hits, its record's type."""

    where: str
    kind: str
    whom: str = ""
    type: Any = None


def _of_device(where: str, record: type, whom: Sequence[str] = ("",)) -> list[FaultKind]:
    kinds = typing.get_args(typing.get_type_hints(record)["kind"])
    return [FaultKind(where, kind, each, record) for kind in kinds for each in whom]


@functools.cache
def vocabulary() -> dict[str, list[FaultKind]]:
    """Return every fault that a scenario may state, as the scenario's own types tell it, in groups."""
    frames: list[FaultKind] = []
    nodes: list[FaultKind] = []
    intruders: list[FaultKind] = []
    for fault in typing.get_args(BusFault):
        kind, hints = str(fault.__struct_config__.tag), typing.get_type_hints(fault)
        place = "node" if "node" in hints else "message"
        whom = typing.get_args(hints[place]) if place in hints else ("",)
        stated = [FaultKind("fault", kind, each, fault) for each in whom]
        if fault is FrozenCounter:  # frames without a counter are refused
            stated = [f for f in stated if f.whom in GUARDED]
        others = frames if "probability" in hints else intruders
        (nodes if place == "node" else others).extend(stated)
    return {
        "frames": frames,
        "nodes": nodes,
        "intruders": intruders,
        "position": _of_device("sensor_fault", SensorFault),
        "temperature": _of_device("temperature_fault", TemperatureFault),
        "speeds": _of_device("speed_fault", SpeedFault),
        "valves": _of_device("valve_fault", ValveFault, ("B", "N", "F")),
        "bus and clocks": [FaultKind("bus", "load"), FaultKind("clock", "controller"),
                           FaultKind("clock", "driver")],
    }  # fmt: skip


def _between(low: float, high: float) -> Draw:
    return lambda rng: round(rng.uniform(low, high), 6)


def _whole(low: int, high: int) -> Draw:
    return lambda rng: rng.randint(low, high)


PARAMETERS: dict[str, Draw] = {
    "probability": _between(0.05, 1.0),
    "every": _whole(2, 8),
    "count": _whole(1, 100),
    "attempts": _whole(1, 32),
    "bits": _whole(1, 64),
    "delay_s": _between(0.001, 0.4),
    "jitter_s": _between(0.0, 0.05),
    "load": _between(0.1, 2.0),
    "priority": _whole(0, 7),
    "can_id": lambda rng: rng.randint(0, 0x1FFF_FFFF) & ~(DP_BIT | EDP_BIT),
    "data": lambda rng: rng.randbytes(rng.randint(0, 8)).hex(),
    "period_s": _between(0.0005, 0.02),
    "pulse_s": _between(0.0, 0.0015),
    "garbage_s": _between(1e-4, 0.004),
    "offset_s": _between(-4e-4, 4e-4),
    "late": _whole(1, 30),
    "value_k": _between(230.0, 430.0),
    "offset_k": _between(-80.0, 80.0),
    "offset_rad_s": _between(-100.0, 100.0),
    "garbage_rad_s": _between(1.0, 400.0),
    "factor": _between(1.0, 20.0),
}
"""How the parameters of faults are drawn; a parameter that is not in here cannot be left out."""


def window(rng: random.Random, requests_s: Sequence[float]) -> dict[str, float]:
    """When a fault acts: from the start, or from some moment around a shift; for good or not."""
    start = max(0.0, rng.choice([0.0, *requests_s]) + rng.uniform(-0.05, 0.6))
    start = rng.choice([0.0, start, start])
    if rng.random() < 0.5:
        return {"start_s": round(start, 4)}
    return {"start_s": round(start, 4), "end_s": round(start + rng.uniform(0.01, 0.5), 4)}


def state(table: dict[str, Any], fault: FaultKind, rng: random.Random) -> None:
    """Enter a fault into a scenario, with a window and parameters drawn at random."""
    if fault.where == "clock":
        table.setdefault("clock", {})[f"{fault.kind}_ppm"] = round(rng.uniform(-5e4, 5e4))
        return
    if fault.where == "bus":
        load = {"extra_load": round(rng.uniform(0.2, 1.5), 3), "extra_priority": rng.randint(0, 7)}
        table.setdefault("bus", {}).update(load, send_buffer=32)
        return
    stated: dict[str, Any] = {
        "kind": fault.kind,
        **window(rng, [request["at_s"] for request in table["request"]]),
    }
    needed = ("delay_s", "period_s", "can_id")
    for name in (f.name for f in msgspec.structs.fields(fault.type)):
        if name in ("message", "node", "valve"):
            stated[name] = fault.whom
        elif name not in stated and name != "end_s" and (name in needed or rng.random() < 0.5):
            stated[name] = PARAMETERS[name](rng)
    if fault.kind == "replayed" and rng.random() < 0.5:  # when the counter has come round
        period_s = 0.02 if fault.whom == "ShiftRequest" else 0.01
        stated["delay_s"] = round(period_s * rng.uniform(15.0, 16.0), 6)
    if fault.kind in ("dead", "sent"):
        stated.pop("end_s", None)
    elif fault.kind == "stalled":
        stated.setdefault("end_s", round(stated["start_s"] + 0.2, 4))
    elif fault.kind == "babbling":
        table.setdefault("bus", {})["send_buffer"] = 32
    table.setdefault(fault.where, []).append(stated)


Table = dict[str, Any]
GEARS = ("neutral", "backward", "forward")


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
    low, usual = (1.2e5, 3e5), (4e5, 1e6)  # too low for most shifts, and usual
    table["plant"] = {
        **table.get("plant", {}),
        "mounted": rng.random() < 0.7,
        "mesh_force_n": round(rng.uniform(0.0, 1300.0)),
        "pull_force_n": round(rng.uniform(0.0, 1100.0)),
        "supply_pressure_pa": round(rng.uniform(*rng.choice((low, usual, usual))), -3),
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

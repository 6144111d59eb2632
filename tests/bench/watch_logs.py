"""`opc4 watch` on logs by tests/reference, trip by trip: false alarms, dates, and the hidden cause in what is reported."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from sil.cli import main
from tests.hidden_effects import effects
from tests.reference.truck import PERIOD_S, StalledError, drawn_truck, write_log

CAUSES = (
    "dynamic_friction", "static_friction", "piston_leak", "leak_to_atmosphere", "supply_low",
    "valve_open_delay", "valve_slow_close", "exhaust_clog", "inlet_clog", "sensor_temperature",
    "sensor_gain", "sensor_delay",
)  # fmt: skip
"""Causes that the reference can have and that `opc4 watch` tracks."""
TRIP_SUPPLY = 0.01
"""Standard deviation of the supply between trips; the sampling phase is anew in each, too."""


def one(seed: int, trips: int, of_trip: int, folder: Path) -> dict[str, Any]:
    """Watch one truck, every second one with a change between two trips; return what was found.

    of_trip: mean number of shifts of a trip, at least 5.
    """
    rng = np.random.default_rng([seed, 31])
    at = int(rng.integers(trips * 2 // 5, trips * 3 // 4)) if seed % 2 else trips
    name = str(rng.choice(CAUSES)) if seed % 2 else ""
    change = effects.draw(name, 0.7, rng) if name else {}
    shifts = []
    for trip in range(trips):
        own = np.random.default_rng([seed, 32, trip])
        count = 5 + int(own.exponential(of_trip - 5))
        # drawn again for each trip from the same seed: the same truck
        truck = drawn_truck(np.random.default_rng([seed, 33]), change if trip >= at else {})
        supply_pa = truck.supply_pa * float(np.exp(TRIP_SUPPLY * own.normal()))
        truck = replace(truck, phase_s=own.uniform(0.0, PERIOD_S), supply_pa=supply_pa)
        write_log(folder / "truck" / f"{trip:03d}.log", truck, count, own)
        shifts.append(count)
    main(["watch", str(folder), "--out", str(folder / "out"), "--quiet"])
    (found,) = json.loads((folder / "out" / "watch.json").read_text())["trucks"]
    return {
        "seed": seed,
        "hidden": name,
        "at": sum(shifts[:at]) if name else None,
        "shifts": sum(shifts),
        "changes": [
            {key: one[key] for key in ("name", "kind", "shift", "low", "high", "alike", "sigma")}
            for one in found["changes"]
        ],
    }


def measure(
    trucks: int = 20,
    trips: int = 20,
    of_trip: int = 40,
    first: int = 0,
    store: Path = Path("watch_logs.jsonl"),
) -> Iterator[str]:
    """Watch drawn trucks; results are added to `store` as they come."""
    for seed in range(first, first + trucks):
        with TemporaryDirectory() as folder:
            (Path(folder) / "truck").mkdir()
            try:
                found = one(seed, trips, of_trip, Path(folder))
            except StalledError:
                continue
        with store.open("a") as file:
            file.write(json.dumps(found) + "\n")
    yield from table([json.loads(line) for line in store.read_text().splitlines()])


def table(rows: list[dict[str, Any]]) -> Iterator[str]:
    """Yield what was found of steady and of changed trucks."""
    steady = [row for row in rows if not row["hidden"]]
    alarms = sum(len(row["changes"]) for row in steady)
    shifts = sum(row["shifts"] for row in steady)
    yield f"{len(steady)} steady trucks, {shifts} shifts: {alarms} changes reported"
    yield "| hidden | shifts | at | found | 95 % | reported first | alike | other changes |"
    yield "|---|---|---|---|---|---|---|---|"
    for row in (row for row in rows if row["hidden"]):
        own = next((c for c in row["changes"] if c["low"] <= row["at"] <= c["high"]), None)
        if own is None:
            others = ", ".join(f"{c['name']} at {c['shift']}" for c in row["changes"])
            yield f"| {row['hidden']} | {row['shifts']} | {row['at']} | no | | | | {others} |"
            continue
        others = ", ".join(f"{c['name']} at {c['shift']}" for c in row["changes"] if c is not own)
        yield (
            f"| {row['hidden']} | {row['shifts']} | {row['at']} | {own['shift']} "
            f"| {own['low']} to {own['high']} | {own['name']} | {', '.join(own['alike'])} | {others} |"
        )

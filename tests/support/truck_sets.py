"""Sets of a truck's logs, drawn over everything in which healthy trucks differ, within a set too."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sil.logs import LogFrame, open_writer
from sil.simulation import load_scenario
from sil.simulation.in_memory import run_in_memory
from tests.support.truck_logs import drawn_truck

TRIP_S = 3600


def drawn_trips(rng: np.random.Generator, shifts: int) -> tuple[list[dict[str, Any]], dict]:
    """Return the scenarios of one healthy truck's trips, together of so many shifts, and its settings.

    Of the truck: tolerances, gearbox, filter, and whether it waits for the shafts to synchronise. Of the
    trip: barriers, impulses of the cones, supply, temperature, sampling phase.
    """
    _table, settings = drawn_truck(rng, 1)
    waits = bool(rng.random() < 0.4)
    settings["controller.filter"] = bool(rng.random() < 0.7)
    cuts = sorted(rng.choice(np.arange(1, shifts), min(int(rng.integers(0, 3)), shifts - 1), False))
    trips = []
    for count in np.diff([0, *cuts, shifts]).tolist():
        kelvin = float(rng.uniform(263.0, 363.0))
        trips.append(
            {
                **_requests(rng, count, waits),
                "name": "drawn trip",
                "plant": {
                    "mounted": True,
                    "mesh_force_n": float(rng.uniform(0.0, 1200.0)),
                    "pull_force_n": float(rng.uniform(0.0, 700.0)),
                    "supply_pressure_pa": float(rng.uniform(7e5, 9.5e5)),
                    "truth_period_s": 1.0,
                },
                "driveline": {"noise_rad_s": 0.1}
                | ({} if waits else {
                    f"impulse_{gear}_n_s": float(np.exp(rng.uniform(np.log(5.0), np.log(400.0))))
                    for gear in ("backward", "forward")
                }),
                "sensor": {
                    "phase_s": float(rng.uniform(0.0, 0.0099)),
                    "noise_sd_s": 2e-7,
                    "coil_temperature_k": kelvin,
                },
                "clock": {"controller_ppm": float(rng.uniform(-60.0, 60.0))},
            }
        )  # fmt: skip
        if waits:
            trips[-1]["controller"] = {"shift": {"wait_for_sync": True}}
    return trips, settings


def _requests(rng: np.random.Generator, count: int, waits: bool) -> dict[str, Any]:
    """Return the requests of so many shifts, with long enough for each."""
    at_s, gear, requests = 0.3, "neutral", []
    for _ in range(count):
        gear = str(rng.choice(["backward", "forward"])) if gear == "neutral" else "neutral"
        requests.append({"at_s": round(at_s, 4), "gear": gear})
        at_s += float(rng.uniform(0.8, 1.0)) + (1.0 if waits else 0.25) * (gear != "neutral")
    return {"duration_s": round(at_s + 0.6, 3), "request": requests}


def write_trips(
    folder: Path, trips: Sequence[dict[str, Any]], settings: dict[str, Any], seed: int
) -> list[str]:
    """Run the trips of a truck; return the logs written, one each."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for number, raw in enumerate(trips):
        loaded = load_scenario.from_table(raw, "drawn", settings=settings, seed=100 * seed + number)
        begin_ns = number * TRIP_S * 1_000_000_000
        paths.append(str(folder / f"{number}.log"))
        with open_writer(paths[-1]) as writer:
            for entry in run_in_memory(loaded).record.frames:
                frame = entry.frame
                writer.write(LogFrame(begin_ns + entry.arrival_ns, frame.can_id, frame.data))
    return paths


def drawn_set(
    folder: Path, seed: int, cause: dict[str, float] | None = None, shifts: int | None = None
) -> list[str]:
    """Write the logs of a drawn truck of 3 to 12 shifts, with further settings (`cause`)."""
    rng = np.random.default_rng([seed, 11])
    trips, settings = drawn_trips(rng, shifts or int(rng.integers(3, 13)))
    return write_trips(folder, trips, settings | (cause or {}), seed)


def same_but(
    folder: Path, seed: int, own: Sequence[dict[str, Any]], cause: dict[str, float] | None = None
) -> list[str]:
    """Write one log of torque to torque for each row of `own`, which replaces tables of the scenario."""
    trips = []
    for tables in own:
        raw: dict[str, Any] = {
            "name": "torque to torque",
            "duration_s": 4.2,
            "initial_gear": "backward",
            "request": [{"at_s": 0.5, "gear": "forward"}],
            "plant": {"mounted": True, "pull_force_n": 300.0, "mesh_force_n": 800.0},
            "driveline": {"noise_rad_s": 0.05},
            "sensor": {"phase_s": 0.002},
        }
        for key, table in tables.items():
            raw[key] = raw.get(key, {}) | table
        trips.append(raw)
    return write_trips(folder, trips, cause or {}, seed)

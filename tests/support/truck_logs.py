"""Truck logs with no or one cause through `opc4 diagnose LOG`: detection and false alarms."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from plant.parameters import load
from sil.logs import LogFrame, open_writer
from sil.simulation import load_scenario
from sil.simulation.in_memory import run_in_memory
from tests.hidden_effects import effects
from tests.reference.truck import StalledError, write_log
from tests.reference.truck import drawn_truck as drawn_reference

NEUTRAL_S = (0.55, 0.75)
"""Time between two requests."""


def drawn_truck(
    generator: np.random.Generator, shifts: int
) -> tuple[dict[str, Any], dict[str, float]]:
    """Return a scenario of one truck and the settings that make it differ from the nominal one."""
    normal, uniform = generator.normal, generator.uniform
    at_s, gear, requests = 0.3, "neutral", []
    for _ in range(shifts):
        gear = str(generator.choice(["backward", "forward"])) if gear == "neutral" else "neutral"
        requests.append({"at_s": round(at_s, 4), "gear": gear})
        at_s += uniform(*NEUTRAL_S) + (0.25 if gear != "neutral" else 0.0)
    unit = load("nominal").value
    delay = unit("repeatability.unit_valve_delay_sd")
    friction = np.exp(unit("repeatability.unit_friction_sd") * normal())
    settings = {
        "valve.D_rise": unit("valve.D_rise") + delay * normal(),
        "valve.D_fall": unit("valve.D_fall") + 3.0 * delay * normal(),
        "truck.m_gearbox": unit("truck.m_gearbox") * np.exp(0.2 * normal()),
        "truck.F_gearbox": unit("truck.F_gearbox") * np.exp(0.25 * normal()),
        "length.V_N0": unit("length.V_N0") * np.exp(0.01 * normal()),
    }
    for name in ("F_sf_s", "F_sf_p", "F_rf_s", "F_rf_p", "beta_s", "beta_p"):
        settings[f"friction_length.{name}"] = unit(f"friction_length.{name}") * friction
    volume = np.exp(0.01 * normal())
    for name in ("V_B0", "V_F0"):
        settings[f"length.{name}"] = unit(f"length.{name}") * volume
    raw = {
        "name": "drawn truck",
        "duration_s": round(at_s + 0.6, 3),
        "request": requests,
        "plant": {
            "mounted": True,
            "mesh_force_n": float(uniform(200.0, 1200.0)),
            "pull_force_n": float(uniform(0.0, 900.0)),
            "supply_pressure_pa": float(9e5 * (1.0 + 0.015 * normal())),
            "truth_period_s": 1.0,
        },
        "driveline": {
            "residual_rad_s": float(uniform(-12.0, 12.0)),
            "cone_gain_m": float(0.09 * np.exp(0.15 * normal())),
            "noise_rad_s": 0.1,
        },
        "sensor": {"phase_s": float(uniform(0.0, 0.0099)), "noise_sd_s": 2e-7},
        "clock": {"controller_ppm": float(uniform(-60.0, 60.0))},
    }
    return raw, {name: float(value) for name, value in settings.items()}


def truck_log(
    path: Path, seed: int, shifts: int, cause: dict[str, float] | None = None, nominal: bool = False
) -> dict[str, Any]:
    """Write the log of a drawn truck with further settings, or else nominal; return its scenario."""
    raw, settings = drawn_truck(np.random.default_rng(seed), shifts)
    if nominal:
        settings = {}
        raw["plant"] |= {"mesh_force_n": 600.0, "pull_force_n": 300.0, "supply_pressure_pa": 9e5}
        raw["driveline"] = {"residual_rad_s": 8.0}
        raw["sensor"] |= {"noise_sd_s": 0.0}
    settings |= cause or {}
    _write(path, load_scenario.from_table(raw, "drawn", settings=settings, seed=seed))
    return raw


def _write(path: Path, loaded: load_scenario.Loaded, begin_ns: int = 0) -> None:
    with open_writer(str(path)) as writer:
        for entry in run_in_memory(loaded).record.frames:
            frame = entry.frame
            writer.write(LogFrame(begin_ns + entry.arrival_ns, frame.can_id, frame.data))


CAUSES: dict[str, tuple[str, float, float]] = {
    "valve_open_delay": ("effect.valve_open_delay.delay_s", 0.001, 0.012),
    "valve_slow_close": ("effect.valve_slow_close.delay_s", 0.004, 0.06),
    "sensor_delay": ("sensor.delay_s", 0.001, 0.012),
    "dynamic_friction": ("effect.dynamic_friction.factor", 1.2, 4.0),
    "inlet_clog": ("effect.inlet_clog.factor", 0.9, 0.4),
    "exhaust_clog": ("effect.exhaust_clog.factor", 0.9, 0.3),
    "piston_leak": ("effect.piston_leak.cda_m2", 5e-8, 1e-6),
    "leak_to_atmosphere": ("effect.leak_to_atmosphere.cda_m2", 1e-7, 2e-6),
    "supply_low": ("effect.supply_low.deficit", 0.03, 0.4),
    "back_pressure": ("effect.back_pressure.pressure_pa", 5e3, 8e4),
    "friction_asymmetry": ("effect.friction_asymmetry.asymmetry", 0.1, 0.8),
    "detent": ("effect.detent.force_n", 30.0, 400.0),
    "free_play": ("effect.free_play.travel_m", 2e-4, 3e-3),
    "seal_pressure_friction": ("effect.seal_pressure_friction.mu", 0.02, 0.2),
}
"""Settings of a cause, and the sizes between which its severity, 0 to 1, lies on a logarithmic scale."""
OPTIONAL = {"effect.detent.force_n": {"effect.detent.width_m": 0.002}}


def drawn_cause(severity: float, generator: np.random.Generator) -> tuple[str, dict[str, float]]:
    """Return the id and the settings of a drawn cause of a severity."""
    name = str(generator.choice(list(CAUSES)))
    path, low, high = CAUSES[name]
    return name, {path: float(low * (high / low) ** severity), **OPTIONAL.get(path, {})}


FOREIGN_CAUSES = (
    "dynamic_friction", "static_friction", "friction_asymmetry", "seal_pressure_friction",
    "piston_leak", "leak_to_atmosphere", "supply_low", "hose_droop", "valve_open_delay",
    "valve_slow_close", "exhaust_clog", "inlet_clog", "free_play", "stop_wear", "external_force",
    "detent", "sensor_temperature", "sensor_gain", "sensor_delay", "added_mass",
)  # fmt: skip
"""Causes of a log by the other implementation (tests/reference), sizes as in tests/hidden_effects."""
LAYOUTS: dict[str, dict[str, bool]] = {
    "steady": {},
    "air": {"air": True},
    "varying": {"varying": True},
    "silent": {"speeds": False},
    "both": {"speeds": False, "varying": True},
}
"""What differs on the bus, and whether the loads of the gearbox do from shift to shift."""


def by_reference(
    path: Path, seed: int, shifts: int, severity: float | None, layout: str = "steady"
) -> tuple[str, dict[str, float], float | None]:
    """Write a log by tests/reference, its cause weaker until it shifts; return cause, changes, severity."""
    rng = np.random.default_rng([seed, 8])
    name = "" if severity is None else str(rng.choice(FOREIGN_CAUSES))
    for weaker in (1.0, 0.6, 0.36, 0.2, 0.1, 0.0):
        hidden = None if severity is None else weaker * severity
        change = effects.draw(name, hidden or 0.0, rng) if name else {}
        truck = drawn_reference(rng, change, **LAYOUTS[layout])
        try:
            write_log(path, truck, shifts, rng)
        except StalledError:
            if not name:
                raise
            continue
        return name, change, hidden
    raise StalledError(f"{name}, drawn six times")


ALARMS = ("named", "ambiguous", "unnamed")
TRIP_S = 3600


def drawn_trips(rng: np.random.Generator, shifts: int) -> tuple[list[dict[str, Any]], dict]:
    """Return the scenarios of a healthy truck's trips, together of so many shifts, and its settings."""
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
        paths.append(str(folder / f"{number}.log"))
        _write(Path(paths[-1]), loaded, number * TRIP_S * 1_000_000_000)
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

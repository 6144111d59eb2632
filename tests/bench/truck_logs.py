"""Truck logs with no or one cause through `opc4 diagnose LOG`: detection and false alarms."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from plant.parameters import load
from sil.logs import LogFrame, open_writer
from sil.simulation import scenario
from sil.simulation.in_memory import run_in_memory

NEUTRAL_S = (0.55, 0.75)
"""Time between two requests."""


def drawn_truck(generator: np.random.Generator, shifts: int) -> tuple[dict[str, Any], list[str]]:
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
    return raw, [f"{name}={float(value)!r}" for name, value in settings.items()]


def truck_log(
    path: Path,
    seed: int,
    shifts: int,
    cause: dict[str, float] | None = None,
    nominal: bool = False,
) -> dict[str, Any]:
    """Write the log of a drawn truck with further settings (`cause`); return its scenario.

    nominal: with the parameters of the model, whatever was drawn.
    """
    raw, settings = drawn_truck(np.random.default_rng(seed), shifts)
    if nominal:
        settings = []
        raw["plant"] |= {"mesh_force_n": 600.0, "pull_force_n": 300.0, "supply_pressure_pa": 9e5}
        raw["driveline"] = {"residual_rad_s": 8.0}
        raw["sensor"] |= {"noise_sd_s": 0.0}
    settings += [f"{name}={value!r}" for name, value in (cause or {}).items()]
    loaded = scenario.from_table(raw, "drawn", settings=settings, seed=seed)
    run = run_in_memory(loaded)
    with open_writer(str(path)) as writer:
        for entry in run.record.frames:
            writer.write(LogFrame(entry.arrival_ns, entry.frame.can_id, entry.frame.data))
    return raw

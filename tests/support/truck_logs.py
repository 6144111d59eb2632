"""Truck logs with no or one cause through `opc4 diagnose LOG`: detection and false alarms."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter
from typing import Any

import numpy as np

from plant.effects import CATALOGUE
from plant.parameters import load
from sil.cli import main
from sil.inference.candidate import scaled_of
from sil.logs import LogFrame, open_writer
from sil.simulation import load_scenario
from sil.simulation.in_memory import run_in_memory
from tests.hidden_effects import effects
from tests.reference.truck import StalledError, write_log
from tests.reference.truck import drawn_truck as drawn_reference
from tests.support.hidden_study import interval

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


DAY_S = 86_400
FIRST_DAY_S = 1_700_000_000


def trips(
    folder: Path, seed: int, count: int, shifts: int, at: int, cause: dict[str, float]
) -> None:
    """Write one log a day of the same truck, with further settings (`cause`) from log `at` on."""
    folder.mkdir(parents=True, exist_ok=True)
    same, settings = drawn_truck(np.random.default_rng(seed), shifts)
    for trip in range(count):
        raw, _others = drawn_truck(np.random.default_rng([seed, trip]), shifts)
        driveline = same["driveline"] | {"residual_rad_s": raw["driveline"]["residual_rad_s"]}
        raw |= {"plant": same["plant"], "clock": same["clock"], "driveline": driveline}
        later = cause if trip >= at else {}
        given = {"settings": settings | later, "seed": 1000 * seed + trip}
        loaded = load_scenario.from_table(raw, "drawn", **given)
        begin_ns = (FIRST_DAY_S + trip * DAY_S) * 1_000_000_000
        _write(folder / f"{trip:03d}.log", loaded, begin_ns)


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


def by_plant(
    path: Path, seed: int, shifts: int, severity: float | None
) -> tuple[str, dict[str, float]]:
    """Write a log by the project's own plant; return the cause hidden in it and its settings."""
    generator = np.random.default_rng([seed, 7])
    name, cause = ("", {}) if severity is None else drawn_cause(severity, generator)
    truck_log(path, seed, shifts, cause)
    return name, cause


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


def one(
    seed: int, shifts: int, severity: float | None, folder: Path, layout: str = ""
) -> dict[str, Any]:
    """Return what was hidden and found in a log by tests/reference, without a layout by the plant."""
    path = folder / f"{seed}.log"
    began = perf_counter()
    if layout:
        name, cause, severity = by_reference(path, seed, shifts, severity, layout)
    else:
        name, cause = by_plant(path, seed, shifts, severity)
    ran = perf_counter()
    out = folder / f"{seed}"
    code = main(["diagnose", str(path), "--out", str(out), "--quiet", "--workers", "1"])
    found = json.loads((out / "diagnosis.json").read_text())
    path.unlink()
    causes = {item["id"]: item for item in found["causes"]}
    own = next(iter(causes[name]["parameters"].values())) if name in causes else None
    chi2 = found["chi2_per_number"] or {"healthy": 0.0, "best": 0.0}
    return {
        "seed": seed,
        "layout": layout,
        "shifts": shifts,
        "severity": severity,
        "hidden": name,
        "size": list(cause.values())[:1],
        "exit": code,
        "verdict": found["verdict"],
        "reported": {key: round(item["probability"], 3) for key, item in causes.items()},
        "best": next(iter(causes), ""),
        "healthy": found["probabilities"].get("healthy", 1.0),
        "interval": own and [own["low"], own["value"], own["high"]],
        "noticed_from": [i["size"] for i in found["detectable"] if i["id"] == name],
        "groups": [group["causes"] for group in found["groups"]],
        "chi2": [round(chi2["healthy"], 2), round(chi2["best"], 2)],
        "seconds": [round(ran - began, 1), round(perf_counter() - ran, 1)],
        "findings": found["findings"][:1],
    }


def share(hits: int, count: int) -> str:
    """Return a share with its 95 % interval (Wilson)."""
    if count == 0:
        return "-"
    low, high = interval(hits, count)
    return f"{hits}/{count} ({100 * low:.0f}-{100 * high:.0f} %)"


ALARMS = ("named", "ambiguous", "unnamed")
OTHER_UNITS = ("friction_asymmetry", "hose_droop", "seal_pressure_friction", "added_mass")
"""Causes whose size in tests/reference is not that of the plant's parameter."""

SIZES_BY_NOTICED = (
    ("that theory says are noticed at no size", 0.0, 1e-9),
    ("below half the size that it says is noticed in 9 of 10", 1e-9, 0.5),
    ("from half to one and a half of that", 0.5, 1.5),
    ("above", 1.5, np.inf),
)


def by_noticed(row: dict[str, Any]) -> float | None:
    """Return a cause's size by the least one stated as noticed; 0 if none is, None if units differ."""
    if not row["hidden"] or row["hidden"] in OTHER_UNITS:
        return None
    parameter = CATALOGUE[row["hidden"]].parameters[0]
    sizes = [scaled_of(parameter, value) for value in row["noticed_from"] if value is not None]
    if not row["size"] or not sizes:
        return 0.0
    return abs(scaled_of(parameter, row["size"][0])) / min(map(abs, sizes))


def table(rows: list[dict[str, Any]]) -> Iterator[str]:
    """Yield the lines of the table of all results, of the plant's own logs and of the others."""
    for title, is_own in (("own plant", True), ("tests/reference", False)):
        drawn = [row for row in rows if is_own == (not row.get("layout"))]
        if drawn:
            yield f"## logs drawn by {title}"
            yield from _found(drawn)


def _found(rows: list[dict[str, Any]]) -> Iterator[str]:
    """Yield the lines of one implementation."""
    clean = [row for row in rows if not row["hidden"]]
    faulty = [row for row in rows if row["hidden"]]
    for layout in sorted({row["layout"] for row in clean}):
        own = [row for row in clean if row["layout"] == layout]
        alarms = sum(row["verdict"] in ALARMS for row in own)
        yield f"healthy trucks with an alarm, {layout or 'own'}: {share(alarms, len(own))}"
    alarms = sum(row["verdict"] in ALARMS for row in clean)
    yield f"healthy trucks with an alarm: {share(alarms, len(clean))}"
    wrong = [r for r in rows if r["verdict"] == "named" and r["best"] != r["hidden"]]
    yield f"a wrong cause above 0.8: {share(len(wrong), len(rows))}"
    sure = [r for r in rows if r["interval"] and not r["layout"]]
    if sure:  # sizes of the other implementation are in other units
        held = sum(r["interval"][0] <= r["size"][0] <= r["interval"][2] for r in sure)
        yield f"sizes of reported hidden causes in their 95 % interval: {share(held, len(sure))}"
    found = [row for row in faulty if row["verdict"] in ALARMS]
    first = sum(row["best"] == row["hidden"] for row in found)
    yield f"the hidden cause first, of alarms: {share(first, len(found))}"
    for title, low, high in SIZES_BY_NOTICED:
        own = [row for row in faulty if low <= (by_noticed(row) or 0.0) < high]
        own = [row for row in own if by_noticed(row) is not None]
        alarms = sum(row["verdict"] in ALARMS for row in own)
        yield f"hidden causes {title}: alarms {share(alarms, len(own))}"
    yield "| severity | shifts | alarm | hidden cause in what is reported | first | named alone |"
    yield "|---|---|---|---|---|---|"
    for low in (0.0, 1 / 3, 2 / 3):
        for least, most in ((0, 20), (20, 80), (80, 600)):
            alike = [row for row in faulty if low <= row["severity"] < low + 1 / 3]
            own = [row for row in alike if least <= row["shifts"] < most]
            alarm = sum(row["verdict"] in ALARMS for row in own)
            held = sum(row["hidden"] in row["reported"] for row in own)
            first = sum(row["best"] == row["hidden"] for row in own)
            named = sum(row["verdict"] == "named" and row["best"] == row["hidden"] for row in own)
            yield (
                f"| {low:.2f} to {low + 1 / 3:.2f} | {least} to {most} | {share(alarm, len(own))} "
                f"| {share(held, len(own))} | {share(first, len(own))} | {share(named, len(own))} |"
            )


def measure(
    logs: int = 200,
    first: int = 1000,
    store: Path = Path("truck_logs.jsonl"),
    most: int = 500,
    layouts: tuple[str, ...] = ("steady", "varying", "silent", "both", "air"),
) -> Iterator[str]:
    """Judge drawn logs of 10 to `most` shifts, a quarter of them healthy; add results to `store`."""
    for seed in range(first, first + logs):
        generator = np.random.default_rng([seed, 3])
        severity = None if seed % 4 == 0 else float(generator.uniform())
        count = int(10.0 * (most / 10.0) ** float(generator.uniform()))
        layout = layouts[(seed // 4 + seed % 4) % len(layouts)]
        with TemporaryDirectory() as folder:
            found = one(seed, count, severity, Path(folder), layout)
        with store.open("a") as file:
            file.write(json.dumps(found) + "\n")
    yield from table([json.loads(line) for line in store.read_text().splitlines()])


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

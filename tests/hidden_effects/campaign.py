"""A campaign as a real one, measured on the judge with something hidden in it; all drawn from one seed."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from tests.hidden_effects import effects
from tests.reference import parts
from tests.reference.actuator import Case
from tests.reference.changed import changed, lagging
from tests.reference.instruments import control_unit, gauge, potentiometer

Change = dict[str, float]
RATE_HZ = 10000.0
DURATION_S = 0.3
INTERNAL = ("warmer_k", "gain", "later_s", "clock_offset_s", "clock_drift")

# kind, load, still charged, supplies: what a campaign is composed of
PLANS: tuple[tuple[str, str, bool, tuple[float, ...]], ...] = (
    ("fixed", "none", False, (6e5, 7.5e5, 9e5)),
    ("N-B", "none", False, (6e5, 9e5)),
    ("B-N", "none", False, (6e5, 9e5)),
    ("fixed", "damper", False, (6e5, 9e5)),
    ("N-F", "none", False, (9e5,)),
    ("F-N", "none", False, (9e5,)),
    ("N-B", "none", True, (9e5,)),
    ("B-N", "none", True, (9e5,)),
    ("fixed", "none", False, (6e5, 7.5e5, 9e5)),
    ("N-F", "damper", False, (9e5,)),
    ("fixed", "spring", False, (9e5,)),
    ("N-B", "none", False, (6e5, 9e5)),
    ("B-N", "none", False, (6e5, 9e5)),
    ("fixed", "none", False, (6e5, 9e5)),
    ("fixed", "damper", False, (9e5,)),
)
DRIVING = {"fixed": "1", "N-B": "B", "N-F": "F", "B-N": "N", "F-N": "N"}
LATE = ("1", "N", "B")
CASES = {"none": 0.25, "one": 0.40, "two": 0.12, "foreign": 0.15, "small": 0.08}
SPRING_N_M, SPRING_START_M = 25000.0, 0.004258279


@dataclass(frozen=True)
class Hidden:
    """What was hidden: names, classes, level, and the changes made."""

    names: tuple[str, ...]
    classes: tuple[str, ...]
    level: str
    change: Change

    @property
    def foreign(self) -> bool:
        """Whether the vocabulary lacks it."""
        return any(name in effects.FOREIGN for name in self.names)


def hide(names: tuple[str, ...], level: str, seed: int) -> Hidden:
    """Draw the sizes of named effects."""
    rng = np.random.default_rng([seed, 1])
    change: Change = {}
    for name in names:
        change.update(effects.draw(name, level, rng))
    rows = {**effects.SIZES, **effects.FOREIGN}
    return Hidden(names, tuple(rows[name][0] for name in names), level, change)


def drawn(number: int) -> tuple[str, Hidden]:
    """Kind of case and what is hidden in the campaign of that number."""
    first_seed = 2007
    rng = np.random.default_rng([first_seed, number])
    case = str(rng.choice(list(CASES), p=list(CASES.values())))
    level = "small" if case == "small" else str(rng.choice(("easy", "medium")))
    named = list(effects.SIZES)
    if case == "none":
        names: tuple[str, ...] = ()
    elif case == "foreign":
        names = (str(rng.choice(list(effects.FOREIGN))),)
    elif case == "two":
        first = str(rng.choice(named))
        others = [n for n in named if effects.SIZES[n][0] != effects.SIZES[first][0]]
        names = (first, str(rng.choice(others)))
    else:
        names = (str(rng.choice(named)),)
    return case, hide(names, level, number + first_seed)


def write_campaign(folder: Path, hidden: Hidden, seed: int, count: int = 15) -> Path:
    """Write a campaign of `count` strokes with what is hidden; the answer is not in the folder."""
    rng = np.random.default_rng([seed, 2])
    unit = Unit.drawn(rng)
    order = rng.permutation(count)
    plan = (_planned(PLANS[row % len(PLANS)], rng) for row in order)
    return _measured(folder, hidden, unit, plan, count, rng)


def measure_next(folder: Path, hidden: Hidden, seed: int, day: int = 5) -> Path:
    """Measure a campaign.toml's strokes on the unit of that seed, another day: new zeros, and no answer in the folder."""
    stated = tomllib.loads((folder / "campaign.toml").read_text(encoding="utf-8"))
    plan = [
        (
            Case(
                stroke["kind"],
                stroke["supply_pressure_pa"],
                tuple((when, valve, duty) for when, valve, duty in stroke["commands"]),
                tuple(stroke["charged_before"]),
                "compressible" if stroke["load"] == "damper" else None,
                stroke["spring_n_per_m"],
                stroke["start_offset_m"],
            ),
            stroke["rest_s"],
        )
        for stroke in stated["stroke"]
    ]
    unit = Unit.drawn(np.random.default_rng([seed, 2]))
    rng = np.random.default_rng([seed, day])
    zeros = Unit.drawn(rng)
    unit = replace(unit, offsets_pa=zeros.offsets_pa, offset_m=zeros.offset_m)
    return _measured(folder, hidden, unit, plan, len(plan), rng)


@dataclass(frozen=True)
class Unit:
    """A unit's tolerances, as changes of the nominal one, and the zeros of its instruments."""

    tolerances: Change
    offsets_pa: dict[str, float]
    offset_m: float

    @classmethod
    def drawn(cls, rng: np.random.Generator) -> Unit:
        """Draw a unit."""
        rep = _repeatability()
        tolerances = {
            "friction": rng.normal(0.0, rep["unit_friction_sd"]),
            "rise_s": rng.normal(0.0, rep["unit_valve_delay_sd"]),
            "fall_s": 3.0 * rng.normal(0.0, rep["unit_valve_delay_sd"]),
            "inlet": rng.normal(0.0, rep["unit_flow_sd"]),
            "outlet": rng.normal(0.0, rep["unit_flow_sd"]),
            "outer_volume": rng.normal(0.0, rep["unit_volume_sd"]),
            "inner_volume": rng.normal(0.0, rep["unit_volume_sd"]),
        }
        offsets = {name: rng.normal(0.0, rep["unit_gauge_offset_sd"]) for name in "12BNF"}
        offsets["oil2"] = 5.0 * rng.normal(0.0, rep["unit_gauge_offset_sd"])
        return cls(tolerances, offsets, rng.normal(0.0, rep["unit_pot_offset_sd"]))


def _repeatability() -> dict[str, float]:
    found = parts.nominal().items()
    return {key.split(".")[1]: value for key, value in found if key.startswith("repeat")}


def _planned(
    row: tuple[str, str, bool, tuple[float, ...]], rng: np.random.Generator
) -> tuple[Case, float]:
    """Return a stroke's conditions and the rest before it, by a row of PLANS."""
    kind, load, charged, supplies = row
    supply = float(rng.choice(supplies))
    rest_s = float(rng.choice((2.0, 30.0, 600.0)))
    drive = DRIVING[kind]
    commands = [(0.01, drive, 0.98)]
    held = {"N-B": "N", "B-N": "B"}[kind] if charged else ""
    if held:
        commands.append((0.01, held, 0.0))
    commands.append((0.2, drive, 0.0))
    spring = load == "spring"
    case = Case(
        kind,
        supply,
        tuple(commands),
        (held,) if held else (),
        "compressible" if load == "damper" else None,
        SPRING_N_M if spring else 0.0,
        SPRING_START_M if spring else 0.0,
    )
    return case, rest_s


def _measured(
    folder: Path,
    hidden: Hidden,
    unit: Unit,
    plan: Iterable[tuple[Case, float]],
    count: int,
    rng: np.random.Generator,
) -> Path:
    """Write a campaign of `count` strokes, one by one as the plan yields them."""
    v, rep, own = parts.nominal(), _repeatability(), unit.tolerances
    folder.mkdir(parents=True, exist_ok=True)
    lines = [
        f'name = "{folder.name}"',
        'rig = "both"',
        "atmosphere_pa = 101325.0",
        "temperature_k = 293.15",
        f"sample_rate_hz = {RATE_HZ}",
    ]
    for number, (case, rest_s) in enumerate(plan, start=1):
        drive = DRIVING[case.kind]
        delay = rng.normal(0.0, rep["valve_delay_sd"], 2)
        change = dict(hidden.change)
        change["friction"] = (1.0 + own["friction"]) * (1.0 + rng.normal(0.0, rep["friction_sd"]))
        change["open_later_s"] = change.get("open_later_s", 0.0) + own["rise_s"] + delay[0]
        change["close_later_s"] = change.get("close_later_s", 0.0) + own["fall_s"] + delay[1]
        scatter = rng.normal(0.0, rep["supply_sd"])
        change["supply"] = (1.0 + change.get("supply", 0.0)) * (1.0 + scatter) - 1.0
        progress = (number - 1) / max(count - 1, 1)
        change["friction"] *= 1.0 + change.get("warming", 0.0) * progress
        change["supply"] -= change.get("emptying", 0.0) * progress
        change["open_later_s"] += change.get("sticky_s", 0.0) * np.log10(rest_s)
        if drive == LATE[int(change.get("late_valve", 0.0))]:
            change["open_later_s"] += change.get("late_s", 0.0)
        for name in ("inlet", "outlet"):
            change[name] = change.get(name, 1.0) * (1.0 + own[name])
        for name in ("outer_volume", "inner_volume"):
            change[name] = own[name]
        file = f"stroke_{number:03d}.csv"
        columns = record(case, change, rest_s, v, unit.offsets_pa, unit.offset_m, rng)
        write_csv(folder / file, columns)
        table = {
            "file": file,
            "label": case.kind,
            "kind": case.kind,
            "supply_pressure_pa": case.supply_pa,
            "load": "damper" if case.damper else "spring" if case.spring_n_per_m else "none",
            "spring_n_per_m": case.spring_n_per_m,
            "start_offset_m": case.start_m,
            "rest_s": rest_s,
            "commands": case.commands,
            "charged_before": case.charged,
        }
        lines += ["", "[[stroke]]", *(f"{k} = {json.dumps(v)}" for k, v in table.items())]
    (folder / "campaign.toml").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return folder


def record(
    case: Case,
    change: Change,
    rest_s: float,
    v: parts.Values,
    offsets: dict[str, float],
    offset_m: float,
    rng: np.random.Generator,
) -> dict[str, np.ndarray]:
    """One stroke as the instruments saw it."""
    end_s = max(DURATION_S, max(when for when, _valve, _duty in case.commands) + 0.1)
    time_s = np.arange(round(end_s * RATE_HZ) + 1) / RATE_HZ
    actuator = changed(case, change, rest_s)
    try:
        states = actuator.solve(time_s, rtol=1e-7, max_step=2e-3).states
    except (ValueError, AssertionError):  # an event lost in rounding: once more with other steps
        actuator = changed(case, change, rest_s)
        states = actuator.solve(time_s, rtol=1e-9, max_step=5e-4).states
    lag = change.get("gauge_lag_s", 0.0)
    columns = {"time_s": time_s, "position_m": potentiometer(states[:, 0], offset_m, v, rng)}
    for k, name in enumerate(actuator.chambers):
        true = states[:, actuator.first_pressure + k]
        if lag:
            true = lagging(time_s, true, lag)
        true = true * (1.0 + change.get("gauge_share", 0.0))
        columns[f"pressure_{name}_pa"] = gauge(true, offsets[name], False, v, rng)
    if case.damper:
        true = states[:, actuator.oil] + v["gas.P_atm"]
        columns["pressure_oil2_pa"] = gauge(true, offsets["oil2"], True, v, rng)
    for name in actuator.chambers:
        duty = np.full(len(time_s), 0.98 if name in case.charged else 0.0)
        for when, valve, value in case.commands:
            if valve == name:
                duty[time_s >= when - 1e-9] = value
        columns[f"cmd_{name}"] = duty
    own = {name: change[name] for name in INTERNAL if name in change}
    phase_s = rng.uniform(0.0, v["position_sensor.period"])
    reported_m = control_unit(time_s, states[:, 0], phase_s, v, **own)
    if "bent_m" in change:
        reported_m = reported_m + change["bent_m"] * np.sin(
            2.0 * np.pi * reported_m / change["bent_over_m"]
        )
    columns["position_internal_m"] = reported_m
    return columns


def write_csv(path: Path, columns: dict[str, np.ndarray]) -> None:
    """As recorders write: few digits."""
    styles = {"time_s": "%.4f", "position_m": "%.5f", "position_internal_m": "%.6f"}
    formats = [
        styles.get(name, "%.0f" if name.startswith("pressure") else "%.2f") for name in columns
    ]
    table = np.column_stack(list(columns.values()))
    np.savetxt(path, table, formats, ",", header=",".join(columns), comments="")

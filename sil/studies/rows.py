"""One row of a study: run it, in memory, and say what came out."""

from __future__ import annotations

import importlib
import math
from typing import Any, Protocol

import numpy as np

from can_dbc.errors import InputError, RunError
from plant.parameters import ParameterSet
from sil.studies.study import LoadedStudy, Row, StrokeBase

LOOP_COLUMNS = (
    "shift_time_s",
    "impact_speed_m_s",
    "impact_energy_j",
    "overshoot_m",
    "oscillations",
    "position_lag_10_s",
    "position_lag_90_s",
    "air_used_kg",
    "valve_switchings",
    "failed",
)
STROKE_COLUMNS = (
    "arrival_s",
    "impact_speed_m_s",
    "impact_energy_j",
    "first_motion_s",
    "first_standstill_m",
    "standstills",
    "charging_drop_pa",
    "passive_peak_pa",
    "failed",
)
STEP_S = 1e-4


def columns(study: LoadedStudy) -> tuple[str, ...]:
    """Metric columns of a study's table."""
    if study.study.kind != "runs":
        return _kind(study).columns(study)
    if study.study.stroke is not None:
        return STROKE_COLUMNS
    if study.study.safety:
        from sil.simulation import safety

        return (*LOOP_COLUMNS, *safety.COLUMNS)
    return LOOP_COLUMNS


def run_row(study: LoadedStudy, row: Row) -> dict[str, float]:
    """Metrics of one row; nan where there is none (never arrived), failed 1 where it did not end well.

    Raises InputError naming the row for settings that cannot be.
    """
    try:
        if study.study.kind != "runs":
            return _kind(study).run(study, row)
        if study.study.stroke is not None:
            return run_stroke(study, row)
        return run_loop(study, row)
    except InputError as error:
        raise InputError(f"{study.source}: row {row.number}: {error}") from None


class RowKind(Protocol):
    """A module that makes the rows of one kind of study."""

    def columns(self, study: LoadedStudy) -> tuple[str, ...]:
        """Metric columns."""

    def run(self, study: LoadedStudy, row: Row) -> dict[str, float]:
        """Metrics of a row."""


def _kind(study: LoadedStudy) -> RowKind:
    name = {"bounds": "bound_rows", "budget": "budget_rows", "tuning": "tuning_rows"}
    found: RowKind = importlib.import_module(f"sil.studies.{name[study.study.kind]}")
    return found


def run_loop(study: LoadedStudy, row: Row) -> dict[str, float]:
    """Metrics of a closed-loop row, as `opc4 run` with the row's settings gives them."""
    from sil.simulation.in_memory import run_in_memory

    loaded = study.loaded(row.texts)
    try:
        run = run_in_memory(loaded)
    except RunError:
        return dict.fromkeys(columns(study), math.nan) | {"failed": 1.0}
    found = {
        name: math.nan if run.figures.get(name) is None else float(run.figures[name])
        for name in LOOP_COLUMNS
        if name in run.figures
    }
    last = run.shifts[-1] if run.shifts else None
    overshoot, oscillations = after_arrival(run.record.truth, last.arrived_s if last else None)
    found["overshoot_m"] = overshoot
    found["oscillations"] = oscillations
    wanted = loaded.scenario.expect.final_gear
    ended = run.shifts[-1].to_gear if run.shifts else None
    arrived = last is not None and last.arrived_s is not None and last.confirmed_s is not None
    found["failed"] = 0.0 if arrived and (wanted is None or wanted == ended) else 1.0
    if study.study.safety:
        from sil.simulation import safety

        found |= safety.figures(run.record, loaded.scenario)
    return {name: found[name] for name in columns(study)}


def after_arrival(truth: Any, arrived_s: float | None) -> tuple[float, float]:
    """How far the stay leaves its stop again, and how often it turns, after arrival."""
    if arrived_s is None:
        return math.nan, math.nan
    later = truth["time_s"] >= arrived_s
    x, v = truth["position_m"][later], truth["velocity_m_s"][later]
    if len(x) < 3:
        return 0.0, 0.0
    moving = v[np.abs(v) > 1e-3]
    turns = int(np.count_nonzero(np.diff(np.sign(moving)) != 0))
    return float(np.max(np.abs(x - x[-1]))), float(turns)


def stroke_of(base: StrokeBase, study: LoadedStudy, row: Row):  # type: ignore[no-untyped-def]
    """Simulate a stroke row; settings stroke.* change its conditions, all others the model."""
    from plant.effects.stroke_conditions import StrokeConditions
    from plant.parameters import load
    from plant.systems.stroke import simulate

    own = {k[7:]: v for k, v in row.settings.items() if k.startswith("stroke.")}
    model = {k: v for k, v in row.settings.items() if not k.startswith(("stroke.", "effect."))}
    parameters = with_effects(load(study.study.model).override(model), row)  # type: ignore[arg-type]
    values: dict[str, Any] = {
        "kind": base.kind,
        "supply_pressure_pa": base.supply_pressure_pa,
        "commands": tuple(base.commands),
        "load": base.load,
        "damper_model": base.damper_model,
        "charged_before": tuple(base.charged_before),
        "mounted": base.mounted,
        "mesh_force_n": base.mesh_force_n,
        "sync_impulse_n_s": base.sync_impulse_n_s,
    }
    for key, value in own.items():
        if key not in values or key in ("kind", "commands"):
            raise InputError(f"stroke.{key}: no such value to set; expected {', '.join(values)}")
        values[key] = tuple(str(value)) if key == "charged_before" else value
    time_s = (np.arange(round(base.until_s / STEP_S) + 1) * STEP_S).astype(np.float64)
    return simulate(parameters, StrokeConditions(**values), time_s, internal=False)


def with_effects(parameters: ParameterSet, row: Row) -> ParameterSet:
    """The set with the row's settings effect.<id>.<parameter> added as an extended model has them."""
    from dataclasses import replace

    from plant.effects import effect
    from plant.parameters import Parameter

    effects = {name: dict(table) for name, table in parameters.effects.items()}
    for path, value in row.settings.items():
        if not path.startswith("effect."):
            continue
        parts = path.split(".")
        if len(parts) != 3 or isinstance(value, str | list):
            raise InputError(f"{path}: expected effect.<id>.<parameter> = number")
        units = {item.name: item.unit for item in effect(parts[1]).parameters}
        unit = units.get(parts[2], "")
        effects.setdefault(parts[1], {})[parts[2]] = Parameter(float(value), unit, "study")
    return replace(parameters, effects=effects) if effects else parameters


def run_stroke(study: LoadedStudy, row: Row) -> dict[str, float]:
    """Metrics of a plant-only row."""
    from plant.integrator.hybrid import IntegrationError

    base = study.study.stroke
    assert base is not None
    try:
        stroke = stroke_of(base, study, row)
    except IntegrationError:
        return dict.fromkeys(STROKE_COLUMNS, math.nan) | {"failed": 1.0}
    impact = stroke.impact
    chambers = {"fixed": ("1", "2"), "N-B": ("B", "N"), "B-N": ("N", "B"), "N-F": ("F", "N")}
    driving, passive = chambers.get(base.kind, ("N", "F"))
    charging = stroke.pressure_pa(driving)
    end = impact.time_s if impact else stroke.time_s[-1]
    before = stroke.time_s < end
    pressure = charging[before]
    drop = float(np.max(np.maximum.accumulate(pressure) - pressure)) if len(pressure) else 0.0
    moved = np.flatnonzero(np.abs(stroke.position_m - stroke.position_m[0]) > 5e-5)
    turns = [e.position_m for e in stroke.events if e.name == "turn"]
    return {
        "arrival_s": impact.time_s if impact else math.nan,
        "impact_speed_m_s": impact.speed_m_s if impact else math.nan,
        "impact_energy_j": impact.energy_j if impact else math.nan,
        "first_motion_s": float(stroke.time_s[moved[0]]) if len(moved) else math.nan,
        "first_standstill_m": turns[0] if turns else math.nan,
        "standstills": float(len(turns)),
        "charging_drop_pa": drop,
        "passive_peak_pa": float(np.max(stroke.pressure_pa(passive))),
        "failed": 0.0 if impact else 1.0,
    }

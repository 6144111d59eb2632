"""Rows that are strokes of the plant alone: commands at given times, no controller."""

from __future__ import annotations

import contextlib
import itertools
import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from can_dbc.errors import InputError, RunError
from plant.effects import overridden
from plant.effects.stroke_conditions import StrokeConditions
from plant.errors import IntegrationError
from plant.parameters import load
from plant.systems.stroke import Stroke, simulate
from sil.report.figure import BAR, MM, MS, Figure, Panel, Series, Stack
from sil.simulation.impacts import PICK_UP, counted, worst_speed_m_s
from sil.studies.figures import COLOURS, pareto_figure, row_labels, swept_figures, title_of
from sil.studies.rows import FAILED, PASSED, RowResult, run_row
from sil.studies.study import LoadedStudy, Row, StrokeBase
from sil.studies.table import Table, row_groups

COLUMNS = (
    "arrival_s",
    "impact_speed_m_s",
    "impact_energy_j",
    "impact_worst_m_s",
    "air_used_kg",
    "first_motion_s",
    "first_standstill_m",
    "standstills",
    "charging_drop_pa",
    "passive_peak_pa",
    "failed",
)
FINAL_VOLUME = "final_volume_m3"
STEP_S = 1e-4
MOST_CURVES = 12
"""Most rows that are drawn over time."""
CHAMBERS = {"fixed": ("1", "2"), "N-B": ("B", "N"), "B-N": ("N", "B"), "N-F": ("F", "N"),
            "F-N": ("N", "F")}  # fmt: skip
"""Driving and opposing chamber of each kind of stroke."""


def columns(study: LoadedStudy) -> tuple[str, ...]:
    """Return the figures of a stroke."""
    return COLUMNS


def run(study: LoadedStudy, row: Row) -> RowResult:
    """Simulate a stroke and return its figures.

    Raises InputError for wrong settings, RunError if the equations cannot be solved.
    """
    base = study.study.stroke
    assert base is not None
    stroke = _stroke_of(base, study, row)
    impact = stroke.impact
    driving, opposing = CHAMBERS[base.kind]
    charging_pa = stroke.pressure_pa(driving)
    charging_pa = charging_pa[stroke.time_s < (impact.time_s if impact else stroke.time_s[-1])]
    drop_pa = np.max(np.maximum.accumulate(charging_pa) - charging_pa, initial=0.0)
    moved = np.flatnonzero(np.abs(stroke.position_m - stroke.position_m[0]) > 5e-5)
    turns_m = [e.position_m for e in stroke.events if e.name == "turn"]
    found = {
        "arrival_s": impact.time_s if impact else math.nan,
        "impact_speed_m_s": impact.speed_m_s if impact else math.nan,
        "impact_energy_j": impact.energy_j if impact else math.nan,
        "impact_worst_m_s": _worst_m_s(stroke) if impact else math.nan,
        "air_used_kg": stroke.balance.air_in_kg,
        "first_motion_s": float(stroke.time_s[moved[0]]) if len(moved) else math.nan,
        "first_standstill_m": turns_m[0] if turns_m else math.nan,
        "standstills": float(len(turns_m)),
        "charging_drop_pa": float(drop_pa),
        "passive_peak_pa": float(np.max(stroke.pressure_pa(opposing))),
        "failed": 0.0 if impact else 1.0,
    }
    if impact:
        return RowResult(found, PASSED)
    return RowResult(found, FAILED, f"the stay met no stop within {base.until_s:g} s")


def _worst_m_s(stroke: Stroke) -> float:
    """Return the hardest impact of a stroke as a speed of the stay, see `sil.simulation.impacts`."""
    gears = {"N": "neutral", "B": "backward", "F": "forward"}
    kind = stroke.conditions.kind
    way = (gears[kind[0]], gears[kind[-1]]) if kind != "fixed" else ("", "")
    events = stroke.events
    energy_j = np.array([e.energy_j for e in events])
    counts = counted(
        np.array([e.name.replace(" ", "_") for e in events]),
        np.array([e.time_s for e in events]),
        energy_j,
        np.array([e.name == "block" for e in events], dtype=np.bool_),
        PICK_UP.get(way, ()),
    )
    speed = max(e.speed_m_s for e in events if e.name == "stop")
    mass_kg = float(stroke.packed.m_s + stroke.packed.m_p)
    return float(worst_speed_m_s(energy_j[counts].max(initial=0.0), np.array(speed), mass_kg))


def _stroke_of(base: StrokeBase, study: LoadedStudy, row: Row) -> Stroke:
    """Simulate the stroke of a row.

    Settings stroke.* change its conditions, effect.* add effects, all others change the model;
    stroke.final_volume_m3 is what chamber N of the length stroke keeps in gear.
    Raises InputError for wrong settings, RunError if the equations cannot be solved.
    """
    fields = [
        name for name in base.__struct_fields__ if name not in ("kind", "commands", "until_s")
    ]
    own, model = row.split({"stroke": [*fields, FINAL_VOLUME]})
    final_m3 = own.pop(FINAL_VOLUME, None)
    parameters = overridden(load(study.study.model), model)
    if isinstance(final_m3, float):
        swept_m = parameters.value("length.x_free_total") + parameters.value("length.stroke")
        held_m3 = final_m3 + parameters.value("length.A_p") * swept_m
        parameters = parameters.override({"length.V_N0": held_m3})
    if "charged_before" in own:
        own["charged_before"] = str(own["charged_before"])
    values: dict[str, Any] = {name: getattr(base, name) for name in ("kind", *fields)} | own
    values |= {"charged_before": tuple(values["charged_before"]), "commands": tuple(base.commands)}
    time_s = (np.arange(round(base.until_s / STEP_S) + 1) * STEP_S).astype(np.float64)
    try:
        return simulate(parameters, StrokeConditions(**values), time_s, internal=False)
    except IntegrationError as error:
        raise RunError(str(error)) from None


def figures(study: LoadedStudy, table: Table) -> dict[str, Figure]:
    """Return metrics over sweeps and choices, of a small study also the strokes over time.

    A front has the actuator of the base next to it, with and without the oil damper.
    """
    found = swept_figures(study, table)
    if "pareto" in found:
        found["pareto"] = pareto_figure(study, table, _references(study, table))
    return found | ({"curves": _curves_figure(study, table)} if study.size <= MOST_CURVES else {})


def _references(study: LoadedStudy, table: Table) -> dict[str, dict[str, Mapping[str, float]]]:
    """Return the figures of each group with nothing swept, without load and with the oil damper.

    A swept effect is absent as a whole; what is no stroke without the swept values is left out.
    """
    groups: dict[str, dict[str, Mapping[str, float]]] = {}
    swept = {_whole(sweep.path) for sweep in study.study.sweep}
    first = {int(rows[0]): label for label, rows in row_groups(study, table).items()}
    for row in itertools.islice(study.rows(), max(first) + 1):
        if row.number not in first:
            continue
        held = {path: value for path, value in row.settings.items() if _whole(path) not in swept}
        found = groups.setdefault(first[row.number], {})
        for name, hung in (("nothing changed", "none"), ("oil damper", "damper")):
            with contextlib.suppress(InputError):
                result = run_row(study, replace(row, settings=held | {"stroke.load": hung}))
                if result.outcome == PASSED:
                    found[name] = result.figures
    return groups


def _whole(path: str) -> str:
    """Return the effect of a path effect.ID.PARAMETER, any other path as it is."""
    return path.rpartition(".")[0] if path.startswith("effect.") else path


def _curves_figure(study: LoadedStudy, table: Table) -> Figure:
    """Return position and pressures of every row over time."""
    base = study.study.stroke
    assert base is not None
    driving, opposing = CHAMBERS[base.kind]
    curves: list[list[Series]] = [[], [], []]
    end_s = 0.0
    for row, label in zip(study.rows(), row_labels(study, table), strict=True):
        role, dashed = f"series{row.number % COLOURS}", row.number >= COLOURS
        stroke = _stroke_of(base, study, row)
        pressures = (BAR * stroke.pressure_pa(chamber) for chamber in (driving, opposing))
        for lines, y in zip(curves, (MM * stroke.position_m, *pressures), strict=True):
            lines.append(Series(label, MS * stroke.time_s, y, role, dashed=dashed))
        end_s = max(end_s, stroke.impact.time_s if stroke.impact else 0.0)
    last_s = min(base.until_s, 1.6 * end_s + 0.02) if end_s else base.until_s
    panels = [
        Panel("Position of the stay", "mm", curves[0], height=220),
        Panel(f"Pressure {driving}, absolute", "bar", curves[1]),
        Panel(f"Pressure {opposing}, absolute", "bar", curves[2]),
    ]
    stack = Stack("time, ms", panels, "Over time", limits=(0.0, MS * last_s), width=8.6)
    return Figure([stack], title_of(study))

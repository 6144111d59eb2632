"""Rows that are shifts in closed loop: a scenario with the settings of the row."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

from can_dbc.messages import ControllerStatus, Fault
from sil.report.figure import Figure
from sil.simulation import safety
from sil.simulation.in_memory import Run, run_in_memory
from sil.simulation.load_scenario import Loaded
from sil.studies.fault_table import fault_table, outcomes_figure
from sil.studies.figures import swept_figures
from sil.studies.rows import FAILED, PASSED, RowResult
from sil.studies.study import LoadedStudy, Row
from sil.studies.table import Table

COLUMNS = (
    "shift_time_s",
    "impact_speed_m_s",
    "impact_energy_j",
    "impact_worst_m_s",
    "impact_worst_energy_j",
    "impact_worst_force_n",
    "confirmed_early_s",
    "overshoot_m",
    "oscillations",
    "position_lag_10_s",
    "position_lag_90_s",
    "air_used_kg",
    "valve_switchings",
    "failed",
)


def columns(study: LoadedStudy) -> tuple[str, ...]:
    """Return the figures of the last shift, of a safety study also those of `sil.simulation.safety`."""
    return (*COLUMNS, *safety.COLUMNS) if study.study.safety else COLUMNS


def run(study: LoadedStudy, row: Row) -> RowResult:
    """Run a row as `opc4 run` with the row's settings does.

    Raises InputError for settings that the scenario does not accept, RunError if a participant dies.
    """
    loaded = study.loaded(row.texts)
    done = run_in_memory(loaded)
    last = done.shifts[-1] if done.shifts else None
    overshoot, oscillations = _after_arrival(done.record.truth, last.arrived_s if last else None)
    reason = _why_not_done(done, loaded)
    found = {name: math.nan if done.metrics[name] is None else float(done.metrics[name])
             for name in COLUMNS if name in done.metrics}  # fmt: skip
    found |= {"overshoot_m": overshoot, "oscillations": oscillations, "failed": float(bool(reason))}
    outcome = FAILED if reason else PASSED
    if study.study.safety:
        found |= safety.figures(done.record, loaded.scenario)
        unsafe = _violations(found, study)
        outcome = FAILED if unsafe else PASSED
        reason = "; ".join([*unsafe, *([f"shift not done: {reason}"] if reason else [])])
    return RowResult({name: found[name] for name in columns(study)}, outcome, reason)


def _why_not_done(done: Run, loaded: Loaded) -> str:
    """Return why the last shift of a run was not done, empty if it was."""
    if not done.shifts:
        return "the driver requested no shift"
    last = done.shifts[-1]
    expected = loaded.scenario.expect.final_gear
    if last.arrived_s is None:
        reason = f"the shift to {last.to_gear} did not arrive"
    elif last.confirmed_s is None:
        reason = f"the controller did not confirm {last.to_gear}"
    elif expected not in (None, last.to_gear):
        reason = f"the last shift went to {last.to_gear}; the scenario expects {expected}"
    else:
        return ""
    reported = Fault.NONE
    for _, status in done.record.of(ControllerStatus):
        reported |= status.faults
    names = ", ".join(fault.name or "" for fault in Fault if fault and fault in reported)
    return f"{reason}; the controller reported {names}" if names else reason


def _violations(figures: Mapping[str, float], study: LoadedStudy) -> list[str]:
    """Return which of the two safe states of `sil.simulation.safety` a run did not keep."""
    violated = {
        "a valve stayed energised without a living controller": figures["orphan_energised_s"] > 0.0,
        "a gear was reported that the stay was not in, longer than a motion takes to be observed": (
            figures["false_gear_s"] > study.longest_sight_s
        ),
    }
    return [text for text, is_violated in violated.items() if is_violated]


def _after_arrival(
    truth: Mapping[str, NDArray[np.float64]], arrived_s: float | None
) -> tuple[float, float]:
    """Return how far the stay leaves its stop again [m], and how often it turns, after arrival."""
    if arrived_s is None:
        return math.nan, math.nan
    later = truth["time_s"] >= arrived_s
    x, v = truth["position_m"][later], truth["velocity_m_s"][later]
    if len(x) < 3:
        return 0.0, 0.0
    moving = v[np.abs(v) > 1e-3]
    turns = int(np.count_nonzero(np.diff(np.sign(moving)) != 0))
    return float(np.max(np.abs(x - x[-1]))), float(turns)


def files(study: LoadedStudy, table: Table) -> Iterator[tuple[str, str]]:
    """Yield the fault table of a safety study."""
    if study.study.safety:
        yield "fault_table.md", fault_table(study, table)


def figures(study: LoadedStudy, table: Table) -> dict[str, Figure]:
    """Return metrics over sweeps and choices, of a safety study how each fault ended."""
    found = swept_figures(study, table)
    has_faults = study.study.safety and study.groups
    return found | ({"faults": outcomes_figure(study, table)} if has_faults else {})

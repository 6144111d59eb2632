"""Rows that are shifts in closed loop: a scenario with the settings of the row."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import ClassVar

from can_dbc.messages import ControllerStatus, Fault
from sil.report.figure import Figure
from sil.simulation import safety
from sil.simulation.in_memory import Run, run_in_memory
from sil.simulation.metrics import METRICS
from sil.studies.fault_table import fault_table, longest_sight_s, outcomes_figure, safe_states
from sil.studies.figures import swept_figures
from sil.studies.study import RowResult, ScenarioStudy, Study, StudyRow, Table


class RunsStudy(ScenarioStudy, frozen=True, kw_only=True, tag_field="kind", tag="runs"):
    """A row is one run of the scenario. The default kind."""

    rows_together: ClassVar[int] = 16
    safety: bool = False
    """Report what the faults of each row did (detection, end state, damage); write fault_table.md."""

    def columns(self) -> tuple[str, ...]:
        """Return the figures of the last shift, metrics that `reads` names, of a safety study also its own."""
        shift: tuple[str, ...] = (
            *("shift_time_s", "impact_speed_m_s", "impact_energy_j"),
            *("impact_worst_m_s", "impact_worst_energy_j", "impact_worst_force_n"),
            *("confirmed_early_s", "position_lag_10_s", "position_lag_90_s"),
            *("air_used_kg", "valve_switchings"),
        )
        shift += (*(name for name in METRICS if name in {*self.reads} - {*shift}), "failed")
        return (*shift, *safety.COLUMNS) if self.safety else shift

    def run(self, study: Study, row: StudyRow) -> RowResult:
        """Run a row as `opc4 run` with its settings does. Raises InputError and RunError."""
        loaded = study.loaded(row.settings)
        run = run_in_memory(loaded)
        reason = _why_not_done(run, loaded.scenario.expect.final_gear)
        figures = {
            name: math.nan if run.metrics.get(name) is None else float(run.metrics[name])
            for name in self.columns()
        }
        figures["failed"] = float(bool(reason))
        if not self.safety:
            return RowResult(figures, "failed" if reason else "passed", reason)
        figures |= safety.figures(run.record, loaded.scenario)
        violations = _violations(figures, longest_sight_s(study))
        reasons = [*violations, *([f"shift not done: {reason}"] if reason else [])]
        return RowResult(figures, "failed" if violations else "passed", "; ".join(reasons))

    def draw(self, study: Study, table: Table) -> dict[str, Figure]:
        """Return metrics over sweeps and choices, of a safety study how each fault ended."""
        figures = swept_figures(study, table, with_choices=not self.safety)
        if self.safety and self.groups:
            figures["faults"] = outcomes_figure(study, table)
        return figures

    def sentences(self, study: Study, table: Table) -> list[str]:
        """Return how many rows of a safety study kept the safe states."""
        return safe_states(study, table) if self.safety else []

    def texts(self, study: Study, table: Table) -> dict[str, str]:
        """Return the fault table of a safety study."""
        return {"fault_table.md": fault_table(study, table)} if self.safety else {}


def _why_not_done(run: Run, expected_gear: str | None) -> str:
    """Return why the last shift of a run was not done, empty if it was."""
    if not run.shifts:
        return "the driver requested no shift"
    last = run.shifts[-1]
    if last.arrived_s is None:
        reason = f"the shift to {last.to_gear} did not arrive"
    elif last.confirmed_s is None:
        reason = f"the controller did not confirm {last.to_gear}"
    elif expected_gear not in (None, last.to_gear):
        reason = f"the last shift went to {last.to_gear}; the scenario expects {expected_gear}"
    else:
        return ""
    reported = Fault.NONE
    for _, status in run.record.of(ControllerStatus):
        reported |= status.faults
    names = ", ".join(fault.name or "" for fault in Fault if fault and fault in reported)
    return f"{reason}; the controller reported {names}" if names else reason


def _violations(figures: Mapping[str, float], sight_s: float) -> list[str]:
    """Return which of the two safe states of `sil.simulation.safety` a run did not keep."""
    violated = {
        "a valve stayed energised without a living controller": figures["orphan_energised_s"] > 0.0,
        "a gear was reported that the stay was not in, longer than a motion takes to be observed": (
            figures["false_gear_s"] > sight_s
        ),
    }
    return [text for text, is_violated in violated.items() if is_violated]

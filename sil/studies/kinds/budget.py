"""Rows that are latency budgets: the delays between first motion and first counter-force of a shift.

Each delay is read from a run. The slack is the time from first motion to the stop, less all delays. Thesis
4.2.1 counts 30 ms for the sensor, 10 ms for the velocity and 8 ms for the valve against about 40 ms.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from can_dbc.errors import RunError
from can_dbc.instants import NS_PER_S
from can_dbc.messages import PositionPulse, ValveCommand
from plant.effects.stroke_conditions import FULL_DUTY, StrokeConditions
from plant.parameters import ParameterSet
from plant.systems.stroke import simulate
from sil.coupling.bus import BusFrame
from sil.files.overrides import Settings
from sil.report.figure import MS, Figure, Note, Panel, Span, Stack
from sil.simulation.in_memory import Run, run_in_memory
from sil.simulation.load_scenario import Loaded
from sil.studies.figures import numbered, row_labels
from sil.studies.study import RowResult, ScenarioStudy, Study, StudyRow, Table

BARS = {
    "waiting for a pulse": "#1f77b4",
    "pulse and its report": "#ff7f0e",
    "bus to the controller": "#2ca02c",
    "waiting for the step": "#9467bd",
    "filter": "#d62728",
    "second sample for the speed": "#8c564b",
    "computation": "#e377c2",
    "bus to the valves": "#7f7f7f",
    "valve opening": "#bcbd22",
    "pressure build-up": "#17becf",
}
"""The delays in their order, and their colours."""


class NoBudgetError(RunError):
    """A shift that never arrives, or whose commands or samples are missing, has no budget."""


class BudgetStudy(ScenarioStudy, frozen=True, kw_only=True, tag_field="kind", tag="budget"):
    """A row is the latency budget of a run's last shift."""

    def columns(self) -> tuple[str, ...]:
        """Return window, sum, slack, and each delay."""
        totals = ("window_s", "last_part_s", "spent_s", "slack_s", "last_slack_s")
        return (*totals, *map(column_of, BARS), "failed")

    def run(self, study: Study, row: StudyRow) -> RowResult:
        """Return the budget of a row; one that never arrives has failed. Raises InputError and RunError."""
        try:
            return RowResult(budget_of(study.loaded, row.settings) | {"failed": 0.0})
        except NoBudgetError as error:
            return study.without_figures("failed", str(error))

    def draw(self, study: Study, table: Table) -> dict[str, Figure]:
        """Return the thesis's sum, and each row's delays as one stack against the time that there is."""
        return {"budget": _budget_figure(study, table)}


def column_of(bar: str) -> str:
    """Return the column of a delay."""
    return f"{bar.replace(' ', '_').replace('-', '_')}_s"


def filling_s(parameters: ParameterSet, supply_pa: float, rise_pa: float) -> float:
    """Return the time to raise neutral's pressure, the stay at rest in neutral."""
    opening_s = parameters.value("valve.D_rise")
    conditions = StrokeConditions("N-B", supply_pa, ((0.0, "N", FULL_DUTY),))
    times = np.arange(2001, dtype=np.float64) * 2e-5
    stroke = simulate(parameters, conditions, opening_s + times, internal=False)
    pressure_pa = stroke.pressure_pa("N")
    return float(np.interp(parameters.value("gas.P_atm") + rise_pa, pressure_pa, times))


def _report_age_s(run: Run, parameters: ParameterSet) -> float:
    """Return the time from measurement to release of the report whose position moved most, read from the run."""
    reports, truth = run.record.of(PositionPulse), run.record.truth
    t_mid_s, slope_s_m, warmth_1_k, reference_k = (
        parameters.value(f"position_sensor.{name}")
        for name in ("t_mid", "slope", "temp_coeff", "T_ref")
    )
    pulse_s, coil_k = np.array([(m.pulse_s, m.coil_temperature_k) for _, m in reports]).T
    positions_m = (pulse_s / (1.0 + warmth_1_k * (coil_k - reference_k)) - t_mid_s) / slope_s_m
    steps_m = np.abs(np.diff(positions_m, prepend=positions_m[0]))
    steps_m[np.abs(positions_m) > 0.95 * run.record.stroke_m] = 0.0
    k = int(np.argmax(steps_m))
    travelled_m = np.maximum.accumulate(np.abs(truth["position_m"]))
    measured_s = float(np.interp(abs(positions_m[k]), travelled_m, truth["time_s"]))
    return reports[k][0].released_ns / NS_PER_S - measured_s


def _next(entries: Sequence[tuple[BusFrame, object]], at_ns: int) -> BusFrame:
    for entry, _ in entries:
        if entry.released_ns >= at_ns:
            return entry
    raise NoBudgetError("no frame after the first sample of the motion")


def budget_of(load: Callable[[Settings], Loaded], settings: Settings) -> dict[str, float]:
    """Return the delays of a scenario's last shift from its first motion on, by column, in s.

    window_s: from first motion to the stop; last_part_s: from the end of the synchronizer's block, the only
    part whose load is known (4.2.1); slack: what the delays leave. The filter's delay: how much later the
    estimate passes 90 % of the travel than without it. Pressure build-up: to 1 bar in the neutral chamber,
    about 250 N on the piston. `load` returns the scenario with settings.
    Raises NoBudgetError if the shift does not arrive, RunError if a participant dies.
    """
    loaded = load(settings)
    run = run_in_memory(loaded)
    shift = run.shifts[-1]
    motion_s = shift.first_motion_s
    if motion_s is None or shift.arrived_s is None:
        raise NoBudgetError(f"the shift to {shift.to_gear} never arrives, so it has no budget")
    if shift.commanded_s is None or shift.valve_open_s is None:
        raise NoBudgetError("no valve was opened")
    config, parameters = loaded.scenario.controller, loaded.parameters
    pulses = run.record.of(PositionPulse)
    age_s = _report_age_s(run, parameters)
    report = _next(pulses, math.ceil((motion_s + age_s) * NS_PER_S))
    second = _next(pulses, report.released_ns + 1)
    released_s, arrived_s = report.released_ns / NS_PER_S, report.arrival_ns / NS_PER_S
    step_ns = -(-report.arrival_ns // config.period_ns) * config.period_ns
    command = _next(run.record.of(ValveCommand), step_ns)
    filtered_s = 0.0
    if config.filter.enabled:
        unfiltered = run_in_memory(load({**settings, "controller.filter.enabled": False}))
        lags = (shift.position_lag_90_s, unfiltered.shifts[-1].position_lag_90_s)
        if lags[0] is None or lags[1] is None:
            raise NoBudgetError("the estimated position never passes 90 % of the travel")
        filtered_s = lags[0] - lags[1]
    delays_s = {
        "waiting for a pulse": released_s - age_s - motion_s,
        "pulse and its report": age_s,
        "bus to the controller": arrived_s - released_s,
        "waiting for the step": step_ns / NS_PER_S - arrived_s,
        "filter": filtered_s,
        "second sample for the speed": (second.released_ns - report.released_ns) / NS_PER_S,
        "computation": (command.released_ns - step_ns) / NS_PER_S,
        "bus to the valves": (command.arrival_ns - command.released_ns) / NS_PER_S,
        "valve opening": shift.valve_open_s - shift.commanded_s,
        "pressure build-up": filling_s(parameters, run.record.supply_pressure_pa, 1e5),
    }
    unblocked_s = [e.time_s for e in run.record.events if e.name == "sync_unblock"]
    last_s = max([motion_s, *(t for t in unblocked_s if motion_s < t < shift.arrived_s)])
    window_s, last_part_s = shift.arrived_s - motion_s, shift.arrived_s - last_s
    spent_s = sum(delays_s.values())
    return {
        "window_s": window_s,
        "last_part_s": last_part_s,
        "spent_s": spent_s,
        "slack_s": window_s - spent_s,
        "last_slack_s": last_part_s - spent_s,
        **{column_of(bar): delay_s for bar, delay_s in delays_s.items()},
    }


def _budget_figure(study: Study, table: Table) -> Figure:
    rows = np.flatnonzero(table.numbers["failed"] == 0.0)
    labels = row_labels(study, table)
    spans, notes = _thesis_bar()
    for at, k in enumerate(rows, start=1):
        value_ms = {name: MS * float(table.numbers[name][k]) for name in study.file.columns()}
        left = 0.0
        for bar, colour in BARS.items():
            begin, left = left, left + value_ms[column_of(bar)]
            spans.append(Span(begin, left, colour, "", at - 0.28, at + 0.28))
        part, window = value_ms["last_part_s"], value_ms["window_s"]
        spans.append(Span(part - 0.15, part + 0.15, "alarm", "", at - 0.42, at + 0.42))
        if window > part + 0.5:
            spans.append(Span(window - 0.05, window + 0.05, "alarm", "", at - 0.3, at + 0.3))
        notes.append(Note(left + 1.0, at, f"slack {part - left:.0f}", align="left"))
    panel = Panel(
        "Delays",
        spans=spans,
        notes=notes,
        ticks=numbered(["thesis 4.2.1", *(labels[k] for k in rows)]),
        limits=(len(rows) + 0.6, -0.6),
        keys=[*BARS.items(), ("stop; thin: from the first motion", "alarm")],
        height=36 * (len(rows) + 1) + 40,
    )
    axis = "ms after the motion that is to be answered"
    title = "From motion to counter-force: every delay, and the time there is"
    return Figure([Stack(axis, [panel], limits=(0.0, 115.0), width=9.0)], title)


def _thesis_bar() -> tuple[list[Span], list[Note]]:
    """Return the thesis's own delays (4.2.1) as the first bar, and its slack."""
    spans, left = [], 0.0
    # delays of information and of a valve as the thesis counts them (4.2.1)
    for name, delay_s in (("sensor", 0.030), ("velocity", 0.010), ("valve", 0.008)):
        label = f"{name} {MS * delay_s:.0f}"
        spans.append(Span(left, left + MS * delay_s, "measured", label, -0.3, 0.3))
        left += MS * delay_s
    stop = MS * 0.040
    spans.append(Span(stop - 0.15, stop + 0.15, "alarm", "", -0.45, 0.45))
    return spans, [Note(left + 1.0, 0.0, f"slack {stop - left:.0f}", align="left")]

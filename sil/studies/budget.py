"""The latency budget of a shift: what stands between the first motion and the first counter-force.

Each delay is read from a simulated run (frames, truth, plant) and computed in closed form from the
settings alone; the slack is what is left of
the time from first motion to the stop. Thesis 4.2.1 counts 30 ms sensor, 10 ms for the velocity
and 8 ms valve against about 40 ms. Checked by tests/unit/sil/studies/test_budget.py
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from can_dbc.errors import RunError
from can_dbc.messages import PositionPulse, ValveCommand
from plant.effects.stroke_conditions import FULL_DUTY, StrokeConditions
from plant.parameters import ParameterSet
from plant.systems.stroke import simulate
from sil.coupling.frame_bits import frame_bits
from sil.recording.run_record import NS, BusFrame
from sil.simulation.in_memory import MemoryRun, run_in_memory
from sil.simulation.scenario import Loaded, load

THESIS_S = (("sensor", 0.030), ("velocity", 0.010), ("valve", 0.008))
THESIS_WINDOW_S = 0.040
BRAKE_PA = 100000.0
"""Rise of the neutral chamber's pressure that counts as a brake: about 250 N on the piston."""


@dataclass(frozen=True)
class Bar:
    """One delay, s: as simulated and in closed form."""

    name: str
    simulated_s: float
    closed_s: float


@dataclass(frozen=True)
class Budget:
    """A shift's delays in order, and the time from first motion to the stop, s.

    last_part_s: from the end of the synchronizer's block to the stop; the window without a block.
    """

    scenario: str
    window_s: float
    last_part_s: float
    bars: tuple[Bar, ...]

    @property
    def spent_s(self) -> float:
        """Sum of the simulated delays."""
        return sum(bar.simulated_s for bar in self.bars)

    @property
    def closed_s(self) -> float:
        """Sum of the delays in closed form."""
        return sum(bar.closed_s for bar in self.bars)

    @property
    def slack_s(self) -> float:
        """What is left of the window; negative: the stay is at its stop first."""
        return self.window_s - self.spent_s

    @property
    def last_slack_s(self) -> float:
        """What is left of the part after the block, the only one whose load is known (4.2.1)."""
        return self.last_part_s - self.spent_s


def thesis_slack_s() -> float:
    """Slack by the thesis's own figures (4.2.1), s."""
    return THESIS_WINDOW_S - sum(delay_s for _, delay_s in THESIS_S)


def group_delay_s(order: int, fc_hz: float) -> float:
    """Delay of slow signals in a Butterworth low-pass: 1 / (2 pi fc sin(pi / 2n)).

    Checked by test_group_delay_is_the_slope_of_the_phase.
    """
    return 1.0 / (2.0 * math.pi * fc_hz * math.sin(math.pi / (2.0 * order)))


def filling_closed_s(parameters: ParameterSet, supply_pa: float, rise_pa: float) -> float:
    """Time to raise neutral's pressure: V rise / (alpha_m R f_in), f_in at half the rise."""
    from plant.kernel.packing import flow_coefficients
    from plant.parts.flow import charge

    atmosphere_pa = parameters.value("gas.P_atm")
    inflow = float(charge(atmosphere_pa + 0.5 * rise_pa, supply_pa, flow_coefficients(parameters)))
    stiffness = parameters.value("alpha.alpha_m1") * parameters.value("gas.R_air") * inflow
    return parameters.value("length.V_N0") * rise_pa / stiffness


def filling_simulated_s(parameters: ParameterSet, supply_pa: float, rise_pa: float) -> float:
    """The same from a simulated filling of neutral, the stay at rest in neutral."""
    opening_s = parameters.value("valve.D_rise")
    conditions = StrokeConditions("N-B", supply_pa, ((0.0, "N", FULL_DUTY),))
    times = np.arange(2001, dtype=np.float64) * 2e-5
    stroke = simulate(parameters, conditions, opening_s + times, internal=False)
    pressure_pa = stroke.pressure_pa("N")
    return float(np.interp(parameters.value("gas.P_atm") + rise_pa, pressure_pa, times))


def _bits_s(entry: BusFrame, bitrate: int) -> float:
    return frame_bits(entry.frame.can_id, entry.frame.data) / bitrate


def _report_age_s(run: MemoryRun, loaded: Loaded) -> float:
    """From the instant a pulse measured until its report is released, as the run itself shows it.

    The position of the report that moved most is looked up in the truth.
    """
    parameters, record = loaded.parameters, run.record
    offset_s = parameters.value("position_sensor.t_mid")
    slope_s_m = parameters.value("position_sensor.slope")
    warmth_1_k = parameters.value("position_sensor.temp_coeff")
    reference_k = parameters.value("position_sensor.T_ref")
    reports = record.of(PositionPulse)
    positions_m = np.array(
        [
            (m.pulse_s / (1.0 + warmth_1_k * (m.coil_temperature_k - reference_k)) - offset_s)
            / slope_s_m
            for _, m in reports
        ]
    )
    steps_m = np.abs(np.diff(positions_m, prepend=positions_m[0]))
    steps_m[np.abs(positions_m) > 0.95 * record.stroke_m] = 0.0
    k = int(np.argmax(steps_m))
    time_s, position_m = record.truth["time_s"], record.truth["position_m"]
    travelled_m = np.maximum.accumulate(np.abs(position_m))
    released_s = reports[k][0].released_ns / NS
    return released_s - float(np.interp(abs(positions_m[k]), travelled_m, time_s))


def _next(entries: Sequence[tuple[BusFrame, object]], at_ns: int) -> BusFrame:
    for entry, _ in entries:
        if entry.released_ns >= at_ns:
            return entry
    raise RunError("no command after the first motion's sample")


def latency_budget(scenario: str, settings: Sequence[str] = ()) -> Budget:
    """The budget of a scenario with settings; see `budget_of`."""
    return budget_of(scenario, lambda texts: load(scenario, settings=list(texts)), settings)


def budget_of(
    scenario: str, make: Callable[[Sequence[str]], Loaded], settings: Sequence[str] = ()
) -> Budget:
    """The delays of a scenario's last shift, one after the other, from its first motion on.

    The filter's bar is how much later the believed position passes 90 % of the travel than in the
    same run without the filter. `make` builds the scenario `scenario` with settings PATH=VALUE.
    """
    loaded = make(settings)
    run = run_in_memory(loaded)
    shift = run.shifts[-1]
    if shift.first_motion_s is None or shift.arrived_s is None:
        raise RunError(f"{scenario}: the shift never arrives, so that it has no budget")
    config = loaded.scenario.controller
    bitrate = loaded.scenario.bus.bitrate
    motion_s = shift.first_motion_s

    sensor, period_s = loaded.scenario.sensor, loaded.scenario.sensor.period_s
    half_s = 0.5 * loaded.parameters.value("position_sensor.t_mid")
    age_s = _report_age_s(run, loaded)
    report = _next(run.record.of(PositionPulse), math.ceil((motion_s + age_s) * NS))
    released_s, arrived_s = report.released_ns / NS, report.arrival_ns / NS
    waited_s = (sensor.phase_ns / NS + half_s - motion_s) % period_s
    reported_s = sensor.capture_s + sensor.delay_s - half_s
    there_s = motion_s + waited_s + reported_s + _bits_s(report, bitrate)
    step_ns = -(-report.arrival_ns // config.period_ns) * config.period_ns
    command = _next(run.record.of(ValveCommand), step_ns)
    filtered_s = closed_filter_s = 0.0
    if config.filter.enabled:
        plain = make([*settings, "controller.filter=false"])
        lags = (shift.position_lag_90_s, run_in_memory(plain).shifts[-1].position_lag_90_s)
        if lags[0] is None or lags[1] is None:
            raise RunError(f"{scenario}: the position is never seen to pass 90 % of the travel")
        filtered_s = lags[0] - lags[1]
        closed_filter_s = group_delay_s(config.filter.order, config.filter.fc_hz)
    opened_s = _opening_s(run)
    supply_pa = run.record.supply_pressure_pa
    bars = (
        Bar("waiting for a pulse", released_s - age_s - motion_s, waited_s),
        Bar("pulse and its report", age_s, reported_s),
        Bar("bus to the controller", arrived_s - released_s, _bits_s(report, bitrate)),
        Bar("waiting for the step", step_ns / NS - arrived_s, -there_s % config.period_s),
        Bar("filter", filtered_s, closed_filter_s),
        Bar("second sample for the speed", _second_sample_s(run, report), period_s),
        Bar("computation", (command.released_ns - step_ns) / NS, config.computation_s),
        Bar(
            "bus to the valves",
            (command.arrival_ns - command.released_ns) / NS,
            _bits_s(command, bitrate),
        ),
        Bar("valve opening", opened_s, loaded.parameters.value("valve.D_rise")),
        Bar(
            "pressure build-up",
            filling_simulated_s(loaded.parameters, supply_pa, BRAKE_PA),
            filling_closed_s(loaded.parameters, supply_pa, BRAKE_PA),
        ),
    )
    released = [e.time_s for e in run.record.events if e.name == "sync_unblock"]
    last_s = max([motion_s, *(t for t in released if motion_s < t < shift.arrived_s)])
    return Budget(scenario, shift.arrived_s - motion_s, shift.arrived_s - last_s, bars)


def _second_sample_s(run: MemoryRun, first: BusFrame) -> float:
    return (
        _next(run.record.of(PositionPulse), first.released_ns + 1).released_ns - first.released_ns
    ) / NS


def _opening_s(run: MemoryRun) -> float:
    """From the arrival of the command that opens the driving valve until the valve is open."""
    shift = run.shifts[-1]
    if shift.commanded_s is None or shift.valve_open_s is None:
        raise RunError("no valve was opened")
    return shift.valve_open_s - shift.commanded_s


def draw(budget: Budget, path: Path) -> None:
    """The timeline as a picture: bars one after the other, the window, the slack."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 4.5), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    begin_ms = closed_ms = 0.0
    names = [bar.name for bar in budget.bars]
    for row, bar in enumerate(budget.bars):
        axes.barh(row, bar.simulated_s * 1e3, left=begin_ms, height=0.6, color="#0072B2")
        axes.plot(
            [closed_ms, closed_ms + bar.closed_s * 1e3], [row + 0.4] * 2, color="#E69F00", lw=3
        )
        begin_ms += bar.simulated_s * 1e3
        closed_ms += bar.closed_s * 1e3
        axes.text(begin_ms + 0.5, row, f"{bar.simulated_s * 1e3:.1f} ms", va="center")
    axes.axvline(budget.window_s * 1e3, color="#D55E00")
    axes.text(
        budget.window_s * 1e3 + 0.5,
        len(names) - 0.45,
        f"stop after {budget.window_s * 1e3:.1f} ms",
        color="#D55E00",
        va="center",
    )
    axes.set_yticks(range(len(names)), names)
    axes.set_ylim(len(names), -0.7)
    axes.set_xlim(0.0, 1.15 * max(begin_ms, budget.window_s * 1e3))
    axes.set_xlabel("time after the first motion, ms (thin line: closed form)")
    axes.set_title(
        f"{budget.scenario}: the first counter-force after {budget.spent_s * 1e3:.0f} ms, "
        f"slack {budget.slack_s * 1e3:.0f} ms"
    )
    figure.savefig(path, dpi=120)

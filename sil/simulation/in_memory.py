"""A scenario run in memory: the CAN path and equations of `opc4 run`, without files or pictures."""

from __future__ import annotations

import dataclasses
import hashlib
import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from msgspec.structs import replace

from can_dbc.errors import RunError
from can_dbc.messages import ControllerStatus, ShiftState
from plant.trace import trace_columns
from sil.coupling.bus import BusFrame
from sil.coupling.clock import NS_PER_S
from sil.files.quantity import counted, html_table, quantity
from sil.firmware.cost import Cost, cost_metrics
from sil.recording.recorder import hashed_frame, run_sha256, trace_header
from sil.recording.run_reader import PIECE_S
from sil.recording.run_record import Floats, RunRecord
from sil.simulation import build, metrics
from sil.simulation.circumstances import circumstances
from sil.simulation.expectations import UNFINISHED, Observed, evaluate
from sil.simulation.load_scenario import Loaded
from sil.simulation.loop import Loop
from sil.simulation.results import Check
from sil.simulation.scenario import Scenario, contradictions

if TYPE_CHECKING:
    import pandas


@dataclass(frozen=True)
class Run:
    """A finished run of `scenario`."""

    loaded: Loaded
    record: RunRecord  # the plant's true states, its events and every frame
    shifts: list[metrics.Shift]
    metrics: dict[str, Any]  # the metrics of result.json
    balances: dict[str, Any]
    rows: np.ndarray
    firmware: Cost | None = None  # what the steps of a firmware in C cost

    @cached_property
    def checks(self) -> list[Check]:
        """The expectations of the scenario with their values and limits; balances and bus deadlines in `opc4 run` only."""
        observed = Observed(circumstances(self.scenario), self.record)
        return checks_of(self.loaded, observed, self.shifts, self.metrics)

    @property
    def scenario(self) -> Scenario:
        """The scenario with every value."""
        return self.loaded.scenario

    @property
    def passed(self) -> bool:
        """Whether all expectations of the scenario were met."""
        return all(check.passed for check in self.checks)

    @property
    def signals(self) -> Mapping[str, Floats]:
        """The plant's true states and valves by name, [n] over signals["time_s"], SI units."""
        return self.record.truth

    @property
    def estimate(self) -> tuple[Floats, Floats]:
        """Times [m] in s, and the positions [m] in m that the controller reported."""
        return self.record.estimate

    @property
    def frames(self) -> Collection[BusFrame]:
        """All frames in order of arrival."""
        return self.record.frames

    @property
    def warnings(self) -> list[str]:
        """What is likely to be a mistake in the scenario."""
        return contradictions(self.scenario)

    @cached_property
    def trace_sha256(self) -> str:
        """The hash of all frames and of the plant's trace, as `opc4 run` gives it."""
        digest = hashlib.sha256()
        for entry in self.record.frames:
            digest.update(hashed_frame(entry.arrival_ns, entry.frame))
        pieces = [trace_header(list(self.record.truth)), self.rows.tobytes()]
        return run_sha256(digest.digest(), pieces)

    def __repr__(self) -> str:
        met = sum(check.passed for check in self.checks)
        time = quantity(self.metrics["shift_time_s"], "s")
        return (
            f"Run({'passed' if self.passed else 'failed'}, {met} of {counted(len(self.checks), 'check')} met, "
            f"{counted(len(self.shifts), 'shift')} in {time}, {counted(len(self.frames), 'frame')}, "
            f"trace {self.trace_sha256[:12]})"
        )

    def _repr_html_(self) -> str:
        rows = (
            ("met" if check.passed else "not met", check.name, quantity(check.value, check.unit))
            for check in self.checks
        )
        return html_table(repr(self), ("", "expectation", "found"), rows)

    def to_pandas(self) -> pandas.DataFrame:
        """Return the signals as a table over time_s. Needs pandas."""
        import pandas

        return pandas.DataFrame(self.signals).set_index("time_s")


def run_in_memory(loaded: Loaded) -> Run:
    """Run a scenario as `opc4 run` does. Raises InputError, or RunError if a participant fails."""
    loop = Loop(loaded)
    loop.finish()
    return finished(loop)


def finished(loop: Loop) -> Run:
    """Return the run of a loop that has come to its end."""
    loaded, scenario = loop.loaded, loop.loaded.scenario
    rows = np.concatenate(loop.trace)
    columns = trace_columns(scenario.plant.drive)
    record = RunRecord(
        truth={name: np.ascontiguousarray(rows[:, i]) for i, name in enumerate(columns)},
        events=loop.events,
        frames=loop.frames,
        **build.constants(loaded),
    )
    shifts = metrics.shifts(record, build.gear_of(scenario.initial_gear))
    balances = next((dict(e.values) for e in loop.events if e.name == "balance"), {})
    switchings = metrics.valve_switchings(record)
    figures = metrics.summary(shifts, balances.get("air_in_kg"), switchings, len(loop.frames))
    node = build.firmware_in_c(loop.participants)
    cost = None if node is None else node.cost()
    return Run(loaded, record, shifts, figures | cost_metrics(cost), balances, rows, cost)


def checks_of(
    loaded: Loaded,
    observed: Observed,
    shifts: list[metrics.Shift],
    figures: dict[str, Any],
    lockstep: bool = True,
) -> list[Check]:
    """Return the checks of a run; an unfinished request with the time by which the run is too short."""
    request, expect = loaded.scenario.request, loaded.scenario.expect
    if not lockstep:
        timing = [each for each in expect.timing if not each.lockstep]
        expect = replace(expect, lockstep={}, timing=timing)
    last = request[-1].gear if request else None
    checks = evaluate(expect, observed, shifts, figures, last)
    for k, check in enumerate(checks):
        if check.value == UNFINISHED and not check.passed:
            checks[k] = replace(check, value=f"{UNFINISHED}{_too_short(loaded)}")
    return checks


def _too_short(loaded: Loaded) -> str:
    """Return by how much a run is too short for its last request, empty if no longer run can tell."""
    scenario, longer_s = loaded.scenario, 3.0
    last, end_s = scenario.request[-1], scenario.duration_s
    if scenario.bus.guest or end_s > PIECE_S:
        return ""
    longer = replace(scenario, duration_s=end_s + longer_s)
    try:
        run = run_in_memory(dataclasses.replace(loaded, scenario=longer))
    except RunError:
        return ""
    for entry, message in run.record.of(ControllerStatus):
        late_s = entry.arrival_ns / NS_PER_S - end_s
        ends = message.confirmed == build.gear_of(last.gear) or message.state is ShiftState.FAULT
        if late_s > 0.0 and ends:
            return f"; the run is too short by {math.ceil(1e3 * late_s)} ms"
    return f"; not even {longer_s:g} s later"

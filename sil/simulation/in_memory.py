"""A scenario run in memory: the CAN path and equations of `opc4 run`, without files or pictures."""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import starmap
from typing import TYPE_CHECKING, Any

import numpy as np

from sil.coupling.bus import BusFrame
from sil.files.quantity import counted, html_table, quantity
from sil.firmware.cost import Cost, cost_metrics
from sil.recording.recorder import hashed_frame, run_sha256, trace_header
from sil.recording.run_record import Floats, RunRecord, piece_spans
from sil.simulation import build, metrics
from sil.simulation.bus_figures import bus_figures, overload
from sil.simulation.circumstances import circumstances
from sil.simulation.judgement import Observed, judge
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
    bus: dict[str, Any]  # load, counts and messages, as in result.json
    firmware: Cost | None = None  # what the steps of a firmware in C cost

    @cached_property
    def checks(self) -> list[Check]:
        """All checks of the run with their values and limits, as in result.json: see `judge`."""
        end_s, period_s = float(self.signals["time_s"][-1]), self.scenario.trace_period_s
        pieces = starmap(self.record.between, piece_spans(end_s, period_s))
        observed = Observed(circumstances(self.scenario), *pieces)
        return judge(self.loaded, observed, self.shifts, self.metrics, self.balances, self.bus)

    @property
    def scenario(self) -> Scenario:
        """The scenario with every value."""
        return self.loaded.scenario

    @property
    def passed(self) -> bool:
        """Whether all checks were met."""
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
        return [*contradictions(self.scenario), *overload(self.bus)]

    @cached_property
    def trace_sha256(self) -> str:
        """The hash of all frames and of the plant's trace, as `opc4 run` gives it."""
        digest = hashlib.sha256()
        for entry in self.record.frames:
            digest.update(hashed_frame(entry.arrival_ns, entry.frame))
        truth = self.record.truth
        rows = np.column_stack(list(truth.values())).tobytes()
        return run_sha256(digest.digest(), [trace_header(list(truth)), rows])

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
    loaded, record = loop.loaded, loop.record()
    node = build.firmware_in_c(loop.participants)
    cost = None if node is None else node.cost()
    shifts = metrics.shifts(record, build.gear_of(loaded.scenario.initial_gear))
    balances = next((dict(e.values) for e in loop.events if e.name == "balance"), {})
    switchings = metrics.valve_switchings(record)
    figures = metrics.summary(shifts, balances.get("air_in_kg"), switchings, len(loop.frames))
    bus = bus_figures(loaded.scenario, loop.bus, loop.plan)
    return Run(loaded, record, shifts, figures | cost_metrics(cost), balances, bus, cost)

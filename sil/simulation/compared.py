"""Metrics of runs beside each other, and a changed shipped scenario against itself as shipped."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any

import msgspec
from msgspec.structs import asdict, replace

from sil.files.quantity import quantity, unit_of
from sil.simulation.circumstances import circumstances
from sil.simulation.expectations import Expectations
from sil.simulation.in_memory import run_in_memory
from sil.simulation.judgement import RULES_BROKEN, Observed, evaluate
from sil.simulation.load_scenario import Loaded
from sil.simulation.metrics import METRICS
from sil.simulation.results import Check
from sil.simulation.runner import Finished


class MetricRow(msgspec.Struct, frozen=True, kw_only=True):
    """One metric of several runs, in the unit of its name; None for a run that has none."""

    name: str
    title: str
    values: list[float | None]
    differences: list[float | None]  # of each run to the first one

    @property
    def is_changed(self) -> bool:
        """Whether a run differs from the first one, by more than rounding of its last digits."""
        return not all(self._is_first(value) for value in self.values)

    def _is_first(self, value: float | None) -> bool:
        first = self.values[0]
        if value is None or first is None:
            return value is first
        return math.isclose(value, first, rel_tol=1e-6)

    def cells(self) -> list[str]:
        """Return title, the values, and the differences of all but the first run, with units; "=": none."""
        unit = unit_of(self.name)
        return [
            self.title,
            *("none" if value is None else quantity(value, unit) for value in self.values),
            *(
                "=" if self._is_first(value) else signed(difference, unit)
                for value, difference in zip(self.values[1:], self.differences[1:], strict=True)
            ),
        ]


def signed(difference: float | None, unit: str) -> str:
    """Return a difference with its sign and unit, empty for None."""
    sign = "+" if difference is not None and difference > 0.0 else ""
    return "" if difference is None else sign + quantity(difference, unit, 3)


def metric_rows(runs: Sequence[Mapping[str, Any]]) -> list[MetricRow]:
    """Return the metrics that any of the runs has; a run is the `metrics` of its result."""
    rows = []
    for name, title in METRICS.items():
        values = [run.get(name) for run in runs]
        if any(value is not None for value in values):
            differences = [
                None if value is None or values[0] is None else value - values[0]
                for value in values
            ]
            rows.append(MetricRow(name=name, title=title, values=values, differences=differences))
    return rows


class Changes(msgspec.Struct, frozen=True, kw_only=True):
    """What the changed values of a shipped scenario change: metrics, and expectations not met now."""

    metrics: list[MetricRow]
    expectations: list[Check]


def without_expectations(changed: Loaded, shipped: Loaded, stated: Expectations) -> Loaded:
    """Return a changed shipped scenario with only those expectations that hold for any values.

    stated: expectations among the changed values. A request may remain unfinished if it was expected to.
    """
    expect, request = shipped.scenario.expect, changed.scenario.request
    requested = request[-1].gear if request else None
    always = Expectations(
        valves_off_at_end=expect.valves_off_at_end,
        violated=expect.violated,
        unfinished=expect.confirmed_gear not in (None, requested),
    )
    others = {
        name: value
        for name, value in asdict(stated).items()
        if value != getattr(Expectations(), name)
    }
    scenario = replace(changed.scenario, expect=replace(always, **others))
    return dataclasses.replace(changed, scenario=scenario)


def against_shipped(finished: Finished, shipped: Loaded) -> Finished:
    """Return a finished run of a changed shipped scenario with its changes against `shipped`.

    A gear confirmed before the stay has arrived fails the run if the scenario excludes it.
    Raises RunError if a participant of the shipped scenario fails.
    """
    assert finished.record is not None
    result = finished.result
    rows = metric_rows([run_in_memory(shipped).metrics, result.metrics])
    observed = Observed(circumstances(shipped.scenario), finished.record)
    checks = evaluate(shipped.scenario.expect, observed, finished.shifts, result.metrics)
    failed = [check for check in checks if not check.passed and check.name != RULES_BROKEN]
    early = [check for check in failed if check.name == "confirmed before arrival" and check.value]
    result = replace(
        result,
        passed=result.passed and not early,
        status="failed" if early else result.status,
        expectations=[*result.expectations, *early],
        changes=Changes(
            metrics=[row for row in rows if row.is_changed],
            expectations=[check for check in failed if check not in early],
        ),
    )
    return dataclasses.replace(finished, result=result)

"""Rows that are tunings: the best parameters of a strategy on one hardware, over all loads together.

Every strategy gets the same number of candidates, the same loads and the same cost. Half of them are the
shipped defaults and points of a scrambled Sobol sequence over the ranges of the free parameters, half
points around the best so far, in boxes that shrink from a quarter to a twentieth of each range. Each is
run in closed loop under every load.

The cost of a load is the speed of its hardest impact (`sil.simulation.impacts`) plus `late_m_s2` times the
time lost against the open loop beyond `free_s`, about the price of the oil damper. A shift that failed or
was confirmed too early costs 10 m/s. A candidate costs half the worst of the loads and half their mean:
the worst alone cannot rank candidates that leave it unchanged.

Strategies with a model know the valve delays and the age of a sample of their hardware, not the load.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated

import msgspec
import numpy as np

from can_dbc.errors import InputError, RunError
from controller import strategies
from sil.files.overrides import Settings
from sil.report.figure import Figure, Panel, Span, Stack
from sil.simulation.in_memory import run_in_memory
from sil.simulation.load_scenario import Loaded
from sil.studies.design import Design, drawn_shares
from sil.studies.figures import numbered, row_labels, title_of
from sil.studies.study import Choice, RowResult, ScenarioStudy, Study, StudyRow, Table

BUS_S = 0.0004  # approximate time that a report spends on the bus

Load = Callable[[Settings], Loaded]  # returns the base scenario with settings

SPACES: Mapping[str, Mapping[str, tuple[float, float]]] = {
    "air_cushion": {"trigger_m": (0.0005, 0.012), "lead_s": (0.0, 0.03), "burst_s": (0.005, 0.04)},
    "sliding_mode": {
        "slope_per_s": (10.0, 150.0),
        "band_m_s": (0.0, 0.5),
        "beyond_m": (0.0, 0.006),
    },
    "synchro_brake": {
        "brake_lead_s": (0.01, 0.06),
        "burst_s": (0.005, 0.05),
        "rest_lead_s": (0.0, 0.08),
        "rest_s": (0.0, 0.08),
        "least_lead_s": (0.0, 0.05),
    },
    "bang_bang": {"impact_m_s": (0.05, 0.6), "brake_s": (0.005, 0.04)},
    "predictive": {"time_weight_m_s2": (0.0, 30.0), "way_weight_per_s": (50.0, 1000.0)},
    "blow_cut": {"neutral_s": (0.0, 0.15)},
    "open_loop": {},
}
"""Free parameters of each strategy and the ranges in which they are searched."""


@dataclass(frozen=True)
class LoadShift:
    """Hardest impact and shift time under one load; infinite, with the reason, for a failed shift."""

    speed_m_s: float = math.inf
    time_s: float = math.inf
    reason: str = ""
    died: bool = False


@dataclass(frozen=True)
class Trial:
    """Parameters, the arrival under each load, and the cost."""

    parameters: Mapping[str, float]
    arrivals: tuple[LoadShift, ...]
    cost_m_s: float


def strategy_of(settings: Mapping[str, object]) -> str:
    """Return the strategy that settings name. Raises InputError for one without ranges."""
    name = str(settings.get("controller.strategy", "open_loop"))
    if name not in SPACES:
        raise InputError(f"controller.strategy: {name!r}; expected one of {', '.join(SPACES)}")
    return name


class TuningTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Size and cost of the search of a tuning, the same for every strategy."""

    candidates: Annotated[int, msgspec.Meta(ge=1, le=10_000)] = 16
    """Candidates for each strategy."""
    free_s: Annotated[float, msgspec.Meta(ge=0.0, le=1.0)] = 0.03
    """Extra shift time that costs nothing."""
    late_m_s2: Annotated[float, msgspec.Meta(ge=0.0, le=1000.0)] = 10.0
    """Cost of further shift time: impact speed per time."""
    seed: Annotated[int, msgspec.Meta(ge=0)] = 0
    """Seed of the search."""


class TuningStudy(ScenarioStudy, frozen=True, kw_only=True, tag_field="kind", tag="tuning"):
    """A row is a tuning: the best parameters of a strategy over all loads together."""

    tuning: TuningTable = TuningTable()
    """Size and cost of the search."""

    @property
    def groups(self) -> dict[str, list[Choice]]:
        """The choices that multiply the rows: not the loads, which a tuning takes together."""
        return {name: choices for name, choices in super().groups.items() if name != "load"}

    def check(self, source: str) -> None:
        """Refuse a tuning without loads or strategies, or of unknown ones. Raises InputError."""
        if not (self.load and self.strategy):
            raise InputError(f"{source}: a tuning needs [[load]] and [[strategy]]; expected both")
        for choice in self.strategy:
            try:
                strategy_of(choice.set)
            except InputError as error:
                raise InputError(f"{source}: strategy {choice.name!r}: {error}") from None

    def parameters(self) -> list[str]:
        """Return the names of all free parameters of the study's strategies."""
        spaces = (SPACES[strategy_of(choice.set)] for choice in self.strategy)
        return list(dict.fromkeys(name for space in spaces for name in space))

    def columns(self) -> tuple[str, ...]:
        """Return cost, worst load, the parameters, and each load."""
        return (
            *("cost_m_s", "default_cost_m_s", "worst_impact_m_s", "worst_lost_s", "failed"),
            *(f"best.{name}" for name in self.parameters()),
            *(f"{what} {load.name}" for what in ("impact_m_s", "lost_s") for load in self.load),
        )

    def run(self, study: Study, row: StudyRow) -> RowResult:
        """Tune the strategy of a row; parameters left at their default are NaN. Raises InputError."""
        strategy = strategy_of(row.settings)
        hardware = {k: v for k, v in row.settings.items() if k != "controller.strategy"}
        cases = [{**hardware, **load.set} for load in self.load]
        reference = [run_case(study.loaded, "open_loop", {}, case) for case in cases]
        candidates = tune(study.loaded, strategy, cases, reference, self.tuning)
        best = candidates[0]
        default = next(each for each in candidates if not each.parameters)
        lost_s = [a.time_s - b.time_s for a, b in zip(best.arrivals, reference, strict=True)]
        speeds_m_s = [arrival.speed_m_s for arrival in best.arrivals]
        named = zip(self.load, best.arrivals, strict=True)
        reasons = [f"{load.name}: {arrival.reason}" for load, arrival in named if arrival.reason]
        values = (
            *(best.cost_m_s, default.cost_m_s, max(speeds_m_s), max(lost_s), float(bool(reasons))),
            *(best.parameters.get(name, math.nan) for name in self.parameters()),
            *(*speeds_m_s, *lost_s),
        )
        figures = {
            name: value if math.isfinite(value) else math.nan
            for name, value in zip(self.columns(), values, strict=True)
        }
        if any(arrival.died for arrival in best.arrivals):
            return RowResult(figures, "not run", "; ".join(reasons))
        return RowResult(figures, "failed" if reasons else "passed", "; ".join(reasons))

    def draw(self, study: Study, table: Table) -> dict[str, Figure]:
        """Return the worst impact of up to 64 rows over each family of loads (name before a comma)."""
        if table.size > 64:
            return {}
        families = list(dict.fromkeys(load.name.split(",")[0] for load in self.load))
        spans = []
        for n, family in enumerate(families):
            low, width = 0.4 * (2 * n / len(families) - 1.0), 0.8 / len(families)
            names = [load.name for load in self.load if load.name.split(",")[0] == family]
            impacts_m_s = [table.numbers[f"impact_m_s {name}"] for name in names]
            for k, worst in enumerate(np.max(impacts_m_s, axis=0)):
                if np.isfinite(worst):
                    spans.append(Span(0.0, worst, f"series{n}", "", k + low, k + low + 0.9 * width))
        panel = Panel(
            "Worst impact",
            spans=spans,
            ticks=numbered(row_labels(study, table)),
            limits=(table.size - 0.5, -0.5),
            keys=[(family, f"series{n}") for n, family in enumerate(families)],
            height=60 + 20 * table.size,
        )
        stack = Stack("worst impact speed over the loads, m/s", [panel], width=7.0)
        return {"tuning": Figure([stack], title_of(study))}


def cost_m_s(arrival: LoadShift, reference: LoadShift, free_s: float, late_m_s2: float) -> float:
    """Return the cost of one load."""
    if not math.isfinite(arrival.time_s):
        return 10.0
    lost_s = max(0.0, arrival.time_s - reference.time_s - free_s)
    return min(10.0, arrival.speed_m_s + late_m_s2 * lost_s)


def spread_values(strategy: str, count: int, seed: int) -> list[dict[str, float]]:
    """Return the shipped defaults, then the points of a scrambled Sobol sequence."""
    space = SPACES[strategy]
    if not space or count < 2:
        return [{}]
    low, high = np.array(list(space.values())).T
    drawn = low + (high - low) * drawn_shares(Design("sobol", count - 1, seed), len(space))
    return [{}, *(dict(zip(space, row.tolist(), strict=True)) for row in drawn)]


def _nearby(
    strategy: str, best: Mapping[str, float], share: float, rng: np.random.Generator
) -> dict[str, float]:
    """Return a random point in a box around `best`, `share` of each range to either side."""
    space, defaults = SPACES[strategy], strategies.parameters(strategy, {})
    low, high = np.array(list(space.values())).T
    middle = np.array([best.get(name, getattr(defaults, name)) for name in space])
    moved = middle + share * (high - low) * rng.uniform(-1.0, 1.0, len(middle))
    return dict(zip(space, np.clip(moved, low, high).tolist(), strict=True))


def sample_age_s(hardware: Loaded) -> float:
    """Return the age of a sample at the first controller step that uses it."""
    scenario = hardware.scenario
    sensor, period_s = scenario.sensor, scenario.controller.period_s
    half_s = 0.5 * hardware.parameters.value("position_sensor.t_mid")
    there_s = sensor.capture_s + sensor.delay_s - half_s + BUS_S
    waits_s = -(sensor.phase_ns * 1e-9 + half_s + there_s) % period_s
    return there_s + waits_s


def hardware_settings(strategy: str, hardware: Loaded) -> dict[str, float]:
    """Return the settings by which a strategy with a model knows its hardware."""
    if strategy not in ("bang_bang", "predictive"):
        return {}
    value = hardware.parameters.value
    return {
        "controller.strategy_parameters.model.valve_open_s": value("valve.D_rise"),
        "controller.strategy_parameters.model.valve_close_s": value("valve.D_fall"),
        "controller.strategy_parameters.observer.sensor_age_s": min(0.05, sample_age_s(hardware)),
    }


def run_case(load: Load, strategy: str, values: Mapping[str, float], case: Settings) -> LoadShift:
    """Run one closed-loop shift of a strategy with parameter values; case: settings of the load."""
    settings = {**case, "controller.strategy": strategy}
    settings |= hardware_settings(strategy, load(settings))
    settings |= {f"controller.strategy_parameters.{name}": x for name, x in values.items()}
    try:
        shift = run_in_memory(load(settings)).shifts[-1]
    except RunError as error:
        return LoadShift(reason=" ".join(str(error).split()), died=True)
    if shift.shift_time_s is None:
        return LoadShift(reason="the shift did not arrive")
    if shift.confirmed_s is None:
        return LoadShift(reason="the controller did not confirm the gear")
    if shift.confirmed_early_s:
        return LoadShift(reason="the controller confirmed the gear before the stay arrived")
    return LoadShift(shift.impact_worst_m_s or 0.0, shift.shift_time_s)


def tune(
    load: Load,
    strategy: str,
    cases: Sequence[Settings],
    reference: Sequence[LoadShift],
    table: TuningTable,
) -> list[Trial]:
    """Return all candidates, the best first; cases: settings of each load; reference: open-loop arrivals."""

    def candidate(values: Mapping[str, float]) -> Trial:
        arrivals = tuple(run_case(load, strategy, values, case) for case in cases)
        costs = [
            cost_m_s(arrival, plain, table.free_s, table.late_m_s2)
            for arrival, plain in zip(arrivals, reference, strict=True)
        ]
        return Trial(values, arrivals, 0.5 * (max(costs) + sum(costs) / len(costs)))

    first = spread_values(strategy, table.candidates - table.candidates // 2, table.seed)
    candidates = [candidate(each) for each in first]
    left = table.candidates - len(candidates) if SPACES[strategy] else 0
    rng = np.random.default_rng(table.seed)
    for k in range(left):
        best = min(candidates, key=lambda each: each.cost_m_s)
        share = 0.25 * 0.2 ** (k / max(left - 1, 1))
        candidates.append(candidate(_nearby(strategy, best.parameters, share, rng)))
    return sorted(candidates, key=lambda each: each.cost_m_s)

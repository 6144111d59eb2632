"""Fair tuning: every strategy gets the same budget, loads and figure of merit for each hardware.

Procedure: half of the budget goes to the shipped defaults and to points of a scrambled Sobol
sequence over the ranges of the strategy's free parameters, the other half to points round the best
so far, in boxes that shrink from a quarter to a twentieth of each range. Each candidate is run in
closed loop, over the CAN path, under every load, and the one with the lowest cost wins. Cost of a load is its
impact speed plus `late_m_s2` times the time lost against the open loop beyond `free_s`, about the
price of the oil damper; a failed shift costs `FAILED_M_S`. The cost of a candidate is half the
worst of the loads and half their mean: the worst is what the hardware has to stand, but alone it
would not tell candidates apart that leave it as it is. Strategies with a model know the hardware
that they run on: valve delays and the age of a sample; the load they do not know.
Checked by tests/unit/sil/studies/test_tuning.py
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from can_dbc.errors import RunError
from sil.simulation.in_memory import run_in_memory
from sil.simulation.scenario import Loaded

FAILED_M_S = 10.0
BUS_S = 0.0004
"""About what a report spends on the bus."""
BUDGET = 16
"""Candidates a strategy and hardware get."""

Make = Callable[[Sequence[str]], Loaded]
"""The base scenario with settings PATH=VALUE."""

SPACES: Mapping[str, Mapping[str, tuple[float, float]]] = {
    "air_cushion": {
        "trigger_m": (0.0005, 0.012),
        "lead_s": (0.0, 0.03),
        "burst_s": (0.005, 0.04),
    },
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
"""Free parameters of each strategy and the ranges they are sought in."""


@dataclass(frozen=True)
class Case:
    """A load: a name, and the settings that make it."""

    name: str
    settings: tuple[str, ...] = ()


@dataclass(frozen=True)
class Outcome:
    """A load's impact speed and shift time under one candidate; inf for a failed shift."""

    speed_m_s: float
    time_s: float


@dataclass(frozen=True)
class Candidate:
    """Parameters, what they gave under each load, and their cost."""

    parameters: Mapping[str, float]
    outcomes: tuple[Outcome, ...]
    cost_m_s: float


def cost_m_s(outcome: Outcome, open_loop: Outcome, free_s: float, late_m_s2: float) -> float:
    """Cost of one load."""
    if not math.isfinite(outcome.time_s):
        return FAILED_M_S
    lost_s = max(0.0, outcome.time_s - open_loop.time_s - free_s)
    return min(FAILED_M_S, outcome.speed_m_s + late_m_s2 * lost_s)


def candidates(strategy: str, count: int, seed: int) -> list[dict[str, float]]:
    """The shipped defaults, then the points of a scrambled Sobol sequence."""
    from scipy.stats import qmc

    space = SPACES[strategy]
    if not space or count < 2:
        return [{}]
    sampler = qmc.Sobol(len(space), scramble=True, rng=seed)
    points = sampler.random_base2(math.ceil(math.log2(max(count - 1, 1))))[: count - 1]
    low, high = limits(strategy)
    drawn = low + (high - low) * points
    return [{}, *(dict(zip(space, map(float, row), strict=True)) for row in drawn)]


def limits(strategy: str) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper ends of the ranges of a strategy's free parameters."""
    ends = np.array(list(SPACES[strategy].values()))
    return ends[:, 0], ends[:, 1]


def nearby(
    strategy: str, best: Mapping[str, float], share: float, rng: np.random.Generator
) -> dict[str, float]:
    """A point in a box round another one, `share` of each range to either side."""
    low, high = limits(strategy)
    middle = np.array([best[name] for name in SPACES[strategy]])
    moved = middle + share * (high - low) * rng.uniform(-1.0, 1.0, len(middle))
    return dict(zip(SPACES[strategy], map(float, np.clip(moved, low, high)), strict=True))


def with_defaults(strategy: str, parameters: Mapping[str, float]) -> dict[str, float]:
    """All free parameters, those not given at their defaults."""
    from controller import strategies

    defaults = strategies.parameters(strategy, {})
    return {name: parameters.get(name, getattr(defaults, name)) for name in SPACES[strategy]}


def information_delay_s(hardware: Loaded) -> float:
    """From a position's measurement to the arrival of the command that answers it, at best.

    With the filter its delay of slow signals is counted in, as the thesis does.
    """
    from sil.studies.budget import group_delay_s

    controller = hardware.scenario.controller
    filtering = controller.filter
    filter_s = group_delay_s(filtering.order, filtering.fc_hz) if filtering.enabled else 0.0
    return sample_age_s(hardware) + filter_s + controller.computation_s + BUS_S


def sample_age_s(hardware: Loaded) -> float:
    """Age of a sample at the step that first sees it."""
    scenario = hardware.scenario
    sensor, period_s = scenario.sensor, scenario.controller.period_s
    half_s = 0.5 * hardware.parameters.value("position_sensor.t_mid")
    there_s = sensor.capture_s + sensor.delay_s - half_s + BUS_S
    waits_s = -(sensor.phase_ns * 1e-9 + half_s + there_s) % period_s
    return there_s + waits_s


def informed(strategy: str, hardware: Loaded) -> list[str]:
    """What a strategy with a model knows of its hardware, as settings."""
    if strategy not in ("bang_bang", "predictive"):
        return []
    value = hardware.parameters.value
    age_s = min(0.05, sample_age_s(hardware))
    place = "controller.strategy_parameters"
    return [
        f"{place}.model.valve_open_s={value('valve.D_rise')!r}",
        f"{place}.model.valve_close_s={value('valve.D_fall')!r}",
        f"{place}.observer.sensor_age_s={age_s!r}",
    ]


def run_case(make: Make, strategy: str, parameters: Mapping[str, Any], case: Case) -> Outcome:
    """One closed-loop shift."""
    settings = [*case.settings, f'controller.strategy="{strategy}"']
    settings += informed(strategy, make(settings))
    settings += [
        f"controller.strategy_parameters.{name}={value!r}" for name, value in parameters.items()
    ]
    try:
        run = run_in_memory(make(settings))
    except RunError:
        return Outcome(math.inf, math.inf)
    shift = run.shifts[-1]
    speed_m_s, time_s = shift.impact_speed_m_s, shift.shift_time_s
    if time_s is None or shift.confirmed_s is None:
        return Outcome(math.inf, math.inf)
    return Outcome(0.0 if speed_m_s is None else speed_m_s, time_s)


OIL_DAMPER = 'plant.damper="compressible"'


def references(make: Make, hardware: Sequence[str], cases: Sequence[Case]) -> list[Outcome]:
    """The open loop under each load on some hardware."""
    return [
        run_case(make, "open_loop", {}, Case(case.name, (*hardware, *case.settings)))
        for case in cases
    ]


def tune(
    make: Make,
    strategy: str,
    hardware: Sequence[str],
    cases: Sequence[Case],
    *,
    budget: int = BUDGET,
    seed: int = 0,
    free_s: float = 0.03,
    late_m_s2: float = 10.0,
) -> list[Candidate]:
    """All candidates of a strategy on some hardware, best first."""
    whole = [Case(case.name, (*hardware, *case.settings)) for case in cases]
    reference = references(make, hardware, cases)

    def tried(parameters: Mapping[str, float]) -> Candidate:
        outcomes = tuple(run_case(make, strategy, parameters, case) for case in whole)
        costs = [
            cost_m_s(outcome, open_loop, free_s, late_m_s2)
            for outcome, open_loop in zip(outcomes, reference, strict=True)
        ]
        return Candidate(parameters, outcomes, 0.5 * (max(costs) + sum(costs) / len(costs)))

    found = [tried(each) for each in candidates(strategy, budget - budget // 2, seed)]
    left = budget - len(found) if SPACES[strategy] else 0
    rng = np.random.default_rng(seed)
    for k in range(left):
        best = min(found, key=lambda candidate: candidate.cost_m_s)
        share = 0.25 * 0.2 ** (k / max(left - 1, 1))
        found.append(tried(nearby(strategy, with_defaults(strategy, best.parameters), share, rng)))
    return sorted(found, key=lambda candidate: candidate.cost_m_s)

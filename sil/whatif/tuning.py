"""Fair tuning: every strategy gets the same budget, loads and figure of merit for each hardware.

Procedure: the strategy's free parameters are drawn from a Sobol sequence over their ranges (the
shipped defaults are the first candidate), each candidate is run in closed loop, over the CAN path,
under every load, and the candidate with the lowest cost wins. Cost of a load is its impact speed
plus `late_m_s2` times the time lost against the open loop beyond `free_s`, the price of the oil
damper; a failed shift costs `FAILED_M_S`. The cost of a candidate is that of its worst load.
Checked by tests/unit/sil/test_tuning.py
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sil.memory import run_in_memory
from sil.scenario import load

FAILED_M_S = 10.0
BUDGET = 32
"""Candidates a strategy and hardware get."""

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
    "bang_bang": {"impact_m_s": (0.05, 0.6), "brake_s": (0.005, 0.04)},
    "predictive": {"time_weight_m_s2": (0.0, 30.0), "way_weight_per_s": (50.0, 1000.0)},
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
    if not math.isfinite(outcome.speed_m_s):
        return FAILED_M_S
    lost_s = max(0.0, outcome.time_s - open_loop.time_s - free_s)
    return min(FAILED_M_S, outcome.speed_m_s + late_m_s2 * lost_s)


def candidates(strategy: str, budget: int, seed: int) -> list[dict[str, float]]:
    """The shipped defaults, then the points of a scrambled Sobol sequence."""
    from scipy.stats import qmc

    space = SPACES[strategy]
    sampler = qmc.Sobol(len(space), scramble=True, rng=seed)
    points = sampler.random_base2(math.ceil(math.log2(max(budget - 1, 1))))[: budget - 1]
    low = np.array([bounds[0] for bounds in space.values()])
    high = np.array([bounds[1] for bounds in space.values()])
    drawn = low + (high - low) * points
    return [{}, *(dict(zip(space, map(float, row), strict=True)) for row in drawn)]


def run_case(scenario: str, strategy: str, parameters: Mapping[str, Any], case: Case) -> Outcome:
    """One closed-loop shift."""
    inline = ", ".join(f"{name} = {value!r}" for name, value in parameters.items())
    run = run_in_memory(
        load(
            scenario,
            settings=[
                *case.settings,
                f'controller.strategy="{strategy}"',
                f"controller.strategy_parameters={{{inline}}}",
            ],
        )
    )
    shift = run.shifts[-1]
    speed_m_s, time_s = shift.impact_speed_m_s, shift.shift_time_s
    if speed_m_s is None or time_s is None or shift.confirmed_s is None:
        return Outcome(math.inf, math.inf)
    return Outcome(speed_m_s, time_s)


def tune(
    scenario: str,
    strategy: str,
    hardware: Sequence[str],
    cases: Sequence[Case],
    *,
    budget: int = BUDGET,
    seed: int = 0,
    free_s: float = 0.034,
    late_m_s2: float = 10.0,
) -> list[Candidate]:
    """All candidates of a strategy on some hardware, best first."""
    whole = [Case(case.name, (*hardware, *case.settings)) for case in cases]
    reference = [run_case(scenario, "open_loop", {}, case) for case in whole]
    found = []
    for parameters in candidates(strategy, budget, seed):
        outcomes = tuple(run_case(scenario, strategy, parameters, case) for case in whole)
        worst = max(
            cost_m_s(outcome, open_loop, free_s, late_m_s2)
            for outcome, open_loop in zip(outcomes, reference, strict=True)
        )
        found.append(Candidate(parameters, outcomes, worst))
    return sorted(found, key=lambda candidate: candidate.cost_m_s)

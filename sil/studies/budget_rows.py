"""Rows of a study of latency budgets: the delays of one shift, as simulated and in closed form."""

from __future__ import annotations

import math

from can_dbc.errors import RunError
from sil.studies.study import LoadedStudy, Row

BARS = (
    "waiting for a pulse",
    "pulse and its report",
    "bus to the controller",
    "waiting for the step",
    "filter",
    "second sample for the speed",
    "computation",
    "bus to the valves",
    "valve opening",
    "pressure build-up",
)
"""Delays in their order; `sil.studies.budget` measures each."""

TOTALS = ("window_s", "last_part_s", "spent_s", "closed_spent_s", "slack_s", "last_slack_s")


def simulated(bar: str) -> str:
    """Column of a delay as simulated."""
    return f"{bar.replace(' ', '_').replace('-', '_')}_s"


def closed(bar: str) -> str:
    """Column of a delay in closed form."""
    return f"closed_{simulated(bar)}"


def columns(study: LoadedStudy) -> tuple[str, ...]:
    """Window, sums, slack, and each delay twice."""
    return (*TOTALS, *map(simulated, BARS), *map(closed, BARS), "failed")


def run(study: LoadedStudy, row: Row) -> dict[str, float]:
    """The budget of a row; a shift that never arrives has none and counts as failed."""
    from sil.studies.budget import budget_of

    assert study.study.scenario is not None
    try:
        found = budget_of(study.study.scenario, study.loaded, row.texts)
    except RunError:
        return dict.fromkeys(columns(study), math.nan) | {"failed": 1.0}
    told = {
        "window_s": found.window_s,
        "last_part_s": found.last_part_s,
        "spent_s": found.spent_s,
        "closed_spent_s": found.closed_s,
        "slack_s": found.slack_s,
        "last_slack_s": found.last_slack_s,
        "failed": 0.0,
    }
    for bar in found.bars:
        told[simulated(bar.name)] = bar.simulated_s
        told[closed(bar.name)] = bar.closed_s
    return told

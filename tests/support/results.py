"""A result.json with the fields of a run that passed."""

from __future__ import annotations

from sil.simulation.results import Check, Result


def finished_result(**changes: object) -> Result:
    fields: dict[str, object] = {
        "scenario_name": "example",
        "passed": True,
        "complete": True,
        "why": None,
        "expectations": [Check(name="final gear", passed=True, value="neutral", limit="neutral")],
        "metrics": {"shift_time_s": 0.1},
        "trace_sha256": "0" * 64,
        "seed": 1,
        "transport": "inproc",
        "versions": {},
        "bus": {},
        "balances": {},
        "speed": {"wall_s": 0.5},
        "scenario": {},
        "model": {},
        "status": "passed",
    }
    return Result(**(fields | changes))  # type: ignore[arg-type]

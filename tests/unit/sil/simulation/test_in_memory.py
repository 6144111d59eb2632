"""A run in memory is the run that `opc4 run` makes."""

from __future__ import annotations

from pathlib import Path

import pytest

from sil.simulation.circumstances import circumstances
from sil.simulation.expectations import Observed
from sil.simulation.in_memory import checks_of, run_in_memory
from sil.simulation.load_scenario import from_table, load
from sil.simulation.runner import run


@pytest.mark.parametrize("name", ["lab_n_b", "lost_frames"])
def test_same_hash_and_metrics_as_the_run_on_disk(name: str, tmp_path: Path) -> None:
    loaded = load(name)
    kept = run(loaded, tmp_path)
    in_memory = run_in_memory(loaded)
    assert in_memory.trace_sha256 == kept.result.trace_sha256
    assert in_memory.metrics == kept.result.metrics
    assert in_memory.metrics["frames"] > 100
    assert in_memory.metrics["impact_speed_m_s"] > 0.1


def test_another_valve_is_another_run() -> None:
    plain = run_in_memory(load("lab_n_b"))
    slow = run_in_memory(load("lab_n_b", settings={"valve.D_rise": 0.012}))
    assert plain.trace_sha256 != slow.trace_sha256
    assert slow.shifts[0].arrived_s == pytest.approx(plain.shifts[0].arrived_s + 0.004, abs=1e-6)


def test_a_request_that_the_run_is_too_short_for_fails_it_and_says_by_how_much() -> None:
    table = {"name": "short", "duration_s": 0.45, "request": [{"at_s": 0.4, "gear": "backward"}]}
    failed = [
        check for check in run_in_memory(from_table(table, "short")).checks if not check.passed
    ]
    assert [check.name for check in failed] == ["request for backward"]
    missing_s = 1e-3 * float(str(failed[0].value).split()[-2])
    assert 0.04 < missing_s < 0.1
    longer = table | {"duration_s": 0.45 + missing_s + 0.001}
    assert run_in_memory(from_table(longer, "long enough")).passed
    nothing = table | {"duration_s": 0.41, "request": [{"at_s": 0.405, "gear": "backward"}]}
    checks = run_in_memory(from_table(nothing, "nothing moves")).checks
    assert {"a valve opened", "request for backward"} == {c.name for c in checks if not c.passed}
    stated = nothing | {"expect": {"valves_opened": [], "unfinished": True}}
    assert run_in_memory(from_table(stated, "stated")).passed


def test_limits_of_the_lockstep_do_not_judge_nodes_with_clocks_of_their_own() -> None:
    settings = {"expect.metrics": {}, "expect.lockstep": {"impact_speed_m_s": {"max": 0.1}}}
    run = run_in_memory(load("lab_n_b", settings=settings))
    assert [check.name for check in run.checks if not check.passed] == ["impact_speed_m_s"]
    observed = Observed(circumstances(run.scenario), run.record)
    free = checks_of(run.loaded, observed, run.shifts, run.metrics, lockstep=False)
    left_out = [check.name for check in run.checks if check.name not in {c.name for c in free}]
    assert all(check.passed for check in free)
    assert left_out == ["impact_speed_m_s", "shift 1: commanded to valve_open"]

"""A run in memory is the run that `opc4 run` makes."""

from __future__ import annotations

from pathlib import Path

import pytest

from sil.simulation.in_memory import run_in_memory
from sil.simulation.load_scenario import load
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

"""A run in memory is the run that `opc4 run` makes."""

from __future__ import annotations

from pathlib import Path

import pytest

from sil.cosim import run
from sil.memory import run_in_memory
from sil.scenario import load


@pytest.mark.parametrize("name", ["lab_n_b", "lost_frames"])
def test_same_hash_and_metrics_as_the_run_on_disk(name: str, tmp_path: Path) -> None:
    loaded = load(name)
    kept = run(loaded, tmp_path)
    memory = run_in_memory(loaded)
    assert memory.trace_sha256 == kept.result.trace_sha256
    assert memory.figures == kept.result.metrics
    assert memory.figures["frames"] > 100
    assert memory.figures["impact_speed_m_s"] > 0.1


def test_two_runs_have_the_same_bits() -> None:
    loaded = load("lab_b_n")
    assert run_in_memory(loaded).trace_sha256 == run_in_memory(loaded).trace_sha256


def test_another_valve_is_another_run() -> None:
    plain = run_in_memory(load("lab_n_b"))
    slow = run_in_memory(load("lab_n_b", settings=["valve.D_rise=0.012"]))
    assert plain.trace_sha256 != slow.trace_sha256
    assert slow.shifts[0].arrived_s == pytest.approx(plain.shifts[0].arrived_s + 0.004, abs=1e-6)

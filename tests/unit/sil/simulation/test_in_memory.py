"""A run in memory is the run that `opc4 run` makes."""

from __future__ import annotations

from pathlib import Path

import pytest

from sil.simulation import in_memory
from sil.simulation.in_memory import run_in_memory
from sil.simulation.load_scenario import load, shipped
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
    slow = run_in_memory(load("lab_n_b", settings=["valve.D_rise=0.012"]))
    assert plain.trace_sha256 != slow.trace_sha256
    assert slow.shifts[0].arrived_s == pytest.approx(plain.shifts[0].arrived_s + 0.004, abs=1e-6)


HURRIED = {
    "lab, slow bus": ("lab_n_b", ["bus.bitrate=125000", "bus.extra_load=0.3"]),
    "overloaded": (
        "lab_n_b",
        ["bus.bitrate=125000", "controller.period_s=0.0025", "duration_s=0.4"],
    ),
    "quick sensor": ("strategy_air_cushion", ["sensor.period_s=0.0041", "duration_s=0.4"]),
    "truck": ("truck_into_gear_2200n", ["valve.D_fall=0.0123456789", "duration_s=0.5"]),
}


@pytest.mark.parametrize("name", [*(n for n in shipped() if not load(n).scenario.fault), *HURRIED])
def test_the_quick_loop_is_the_coordinator_bit_for_bit(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Hash over every frame with its instant and every trace row, and every metric."""
    where, settings = HURRIED.get(name, (name, []))
    loaded = load(where, settings=settings)
    quick = run_in_memory(loaded)
    scenario = loaded.scenario
    monkeypatch.setattr(
        in_memory,
        "run_quickly",
        lambda nodes, _, end, boxes: in_memory._coordinated(nodes, scenario, end),
    )
    plain = run_in_memory(loaded)
    assert quick.record.frames == plain.record.frames
    assert quick.trace_sha256 == plain.trace_sha256
    assert quick.metrics == plain.metrics

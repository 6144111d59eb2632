"""Every shipped scenario runs and meets what it expects; the folder it leaves is complete."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from sil.simulation import load_scenario, runner
from sil.simulation.in_memory import run_in_memory
from sil.simulation.safety import fault_spans
from tests.scenarios.conftest import ShippedRun

NAMES = sorted(load_scenario.shipped())


def test_at_least_the_promised_scenarios_are_shipped() -> None:
    assert set(NAMES) >= {
        "lab_n_b",
        "lab_b_n",
        "lab_n_f",
        "lab_f_n",
        "truck_to_neutral_easy",
        "truck_into_gear_easy",
        "truck_into_gear_2200n",
        "full_shift",
        "charged_neutral",
        "lost_frames",
        "dead_controller",
        "stuck_sensor",
        "firmware_2500us",
        "oil_damper",
        "filter_off",
    }


@pytest.mark.parametrize("name", NAMES)
def test_shipped_scenario(name: str, shipped_run: ShippedRun) -> None:
    finished, folder = shipped_run(name)
    failed = [c for c in finished.result.expectations if not c.passed]
    assert finished.result.complete, finished.result.why
    assert not failed
    assert len(finished.result.expectations) >= 10, "too little is expected of this scenario"
    assert finished.result.metrics["valve_switchings"] >= 1
    assert sorted(p.name for p in folder.iterdir()) == [
        "bus.log",
        "events.jsonl",
        "result.json",
        "trace.csv",
    ]
    assert json.loads((folder / "result.json").read_text())["passed"] is True


@pytest.mark.parametrize("name", NAMES)
def test_no_coil_is_released_during_a_handover(name: str, shipped_run: ShippedRun) -> None:
    """A coil that goes off stays off until the controller's next step at least."""
    finished, folder = shipped_run(name)
    period_s = finished.result.scenario["controller"].get("period_s", 0.01)
    off_s: dict[str, float] = {}
    coils = 0
    for line in (folder / "events.jsonl").read_text().splitlines():
        event = json.loads(line)
        kind, _, change = event["name"].rpartition("_")
        if not kind.startswith("coil_"):
            continue
        coils += 1
        if change == "off":
            off_s[kind] = event["time_s"]
        else:
            assert event["time_s"] - off_s.get(kind, -1.0) > 0.9 * period_s
    assert coils > 0


def test_a_result_runs_again_as_it_was(tmp_path: Path) -> None:
    first = runner.run(
        load_scenario.load(
            "lab_n_b", settings={"valve.D_fall": 0.02, "controller.filter": False}, seed=7
        ),
        tmp_path,
    )
    again_folder = tmp_path / "again"
    again_folder.mkdir()
    again = runner.run(load_scenario.load(str(tmp_path / "result.json")), again_folder)
    assert again.result.trace_sha256 == first.result.trace_sha256
    assert again.result.scenario == first.result.scenario
    assert first.result.model["valve.D_fall"] == 0.02


def test_an_expectation_that_does_not_hold_fails_the_run(tmp_path: Path) -> None:
    finished = runner.run(
        load_scenario.load("lab_n_b", settings={"expect.final_gear": "forward"}), tmp_path
    )
    assert finished.result.complete and not finished.result.passed
    assert finished.result.status == "failed"
    assert [c.name for c in finished.result.expectations if not c.passed] == ["final gear"]


FREE = [name for name in NAMES if not fault_spans(load_scenario.load(name).scenario)]
"""Scenarios that can run with free clocks: those without a fault of the lockstep."""


@pytest.mark.slow
@pytest.mark.parametrize("name", FREE)
@pytest.mark.parametrize(("sensor", "driver"), [(0.15, 0.94), (0.5, 0.0), (0.85, 0.5)])
def test_expectations_hold_at_every_phase_of_the_sampling(
    name: str, sensor: float, driver: float
) -> None:
    scenario = load_scenario.load(name).scenario
    phases = {"sensor.phase_s": sensor * scenario.sensor.period_s}
    if scenario.vehicle is None:
        phases["driver.phase_s"] = driver * scenario.controller.period_s
    run = run_in_memory(load_scenario.load(name, settings=phases))
    stated = run.scenario.expect.lockstep
    assert [c for c in run.checks if not c.passed and c.name not in stated] == []

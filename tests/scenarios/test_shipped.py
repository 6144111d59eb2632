"""Every shipped scenario runs and meets what it expects; the folder it leaves is complete."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from sil.files.overrides import NO_SETTINGS, Settings
from sil.report.run_figure import run_figure
from sil.simulation import load_scenario, runner
from sil.simulation.in_memory import Run, run_in_memory
from sil.simulation.load_scenario import load
from sil.simulation.runner import run
from sil.simulation.safety import fault_spans
from tests.claims.claim import MET, PARTLY, all_claims, check
from tests.scenarios.conftest import ShippedRun

NAMES = sorted(load_scenario.shipped())


def test_at_least_the_promised_scenarios_are_shipped() -> None:
    promised = """
        lab_n_b lab_b_n lab_n_f lab_f_n truck_to_neutral_easy truck_into_gear_easy
        truck_into_gear_2200n full_shift charged_neutral lost_frames dead_controller stuck_sensor
        firmware_2500us oil_damper filter_off
    """
    assert set(NAMES) >= set(promised.split())


@pytest.mark.parametrize("name", NAMES)
def test_shipped_scenario(name: str, shipped_run: ShippedRun) -> None:
    finished, folder = shipped_run(name)
    failed = [c for c in finished.result.expectations if not c.passed]
    assert finished.result.complete, finished.result.why
    assert not failed
    assert len(finished.result.expectations) >= 10, "too little is expected of this scenario"
    assert finished.result.metrics["valve_switchings"] >= 1
    files = {"bus.log", "events.jsonl", "result.json", "trace.csv"}
    assert {p.name for p in folder.iterdir()} == files
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
    settings = {"valve.D_fall": 0.02, "controller.filter": False}
    first = runner.run(load("lab_n_b", settings=settings, seed=7), tmp_path)
    again_folder = tmp_path / "again"
    again_folder.mkdir()
    again = runner.run(load_scenario.load(str(tmp_path / "result.json")), again_folder)
    assert again.result.trace_sha256 == first.result.trace_sha256
    assert again.result.scenario == first.result.scenario
    assert first.result.model["valve.D_fall"] == 0.02


def test_an_expectation_that_does_not_hold_fails_the_run(tmp_path: Path) -> None:
    finished = runner.run(load("lab_n_b", settings={"expect.final_gear": "forward"}), tmp_path)
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


PHASES_MS = range(10)


@cache
def lags(filtered: bool = True) -> dict[str, np.ndarray]:
    """Shift the sensor, the firmware stays: the stroke begins at ten phases of their raster."""
    rows = []
    for phase in PHASES_MS:
        settings = {"controller.filter": filtered, "valve.D_rise": 0.008 + 1e-3 * phase}
        (shift,) = run_in_memory(load("lab_n_b", settings=settings)).shifts
        rows.append(shift)
    names = ("position_lag_10", "position_lag_90", "bus_lag_10", "bus_lag_90")
    found = {n: np.array([getattr(r, f"{n}_s") for r in rows]) for n in names}
    for share in (10, 90):
        held = [getattr(r, f"position_lag_{share}_held_s") for r in rows]
        found[f"held_{share}"] = np.array(held)
    return found


@pytest.mark.parametrize(
    ("filtered", "at_10", "at_90"),
    [(True, 0.030, 0.040), (False, 0.010, 0.010)],
    ids=["filter", "no filter"],
)
def test_lag(filtered: bool, at_10: float, at_90: float) -> None:
    """The mean of the held lag over all phases is what the thesis tells, within 2.5 ms; the figure
    of a single run is that mean, within what its one phase can know; so is the bus log's."""
    found = lags(filtered)
    assert np.ptp(found["held_10"]) > 0.005  # a single held lag depends on the phase
    for share, expected in ((10, at_10), (90, at_90)):
        mean = float(np.mean(found[f"held_{share}"]))
        assert mean == pytest.approx(expected, abs=2.5e-3)
        for source in ("position", "bus"):
            single = found[f"{source}_lag_{share}"]
            assert float(np.mean(single)) == pytest.approx(mean, abs=1.2e-3)
            assert np.max(np.abs(single - mean)) < 3e-3


def test_the_filter_makes_it_three_times_slower_and_growing() -> None:
    with_filter, without = lags(), lags(False)
    slower = np.mean(with_filter["held_10"]) / np.mean(without["held_10"])
    assert slower == pytest.approx(3, abs=0.5)
    assert np.mean(with_filter["held_90"] - with_filter["held_10"]) > 0.008
    assert abs(np.mean(without["held_90"] - without["held_10"])) < 0.002


def shift(settings: Settings = NO_SETTINGS) -> Run:
    return run_in_memory(load("lab_n_b", settings={"plant.drive": "coil", **settings}))


def instants(found: Run, name: str) -> list[float]:
    return [event.time_s for event in found.record.events if event.name == name]


def closing_s(found: Run) -> float:
    (off,), (closed,) = instants(found, "coil_B_off"), instants(found, "valve_B_close")
    return closed - off


@pytest.mark.parametrize(
    "settings", [{"controller.duty": 0.36}, {"valve_driver.hold_duty": 0.36}, {"duration_s": 0.7}]
)
def test_closes_in_6_ms_from_36_percent_and_in_35_from_98(settings: dict[str, float]) -> None:
    expected = 0.035 if "duration_s" in settings else 0.006
    assert closing_s(shift(settings)) == pytest.approx(expected, abs=0.0005)


def test_no_dropout_from_push_to_blow() -> None:
    """The duty is the commanded one from the start of the push to the end of the blow."""
    for duty in (0.36, 0.98):
        found = shift({"controller.duty": duty})
        (on,), (off,) = instants(found, "coil_B_on"), instants(found, "coil_B_off")
        assert off - on > 0.2  # push and blow
        time, cmd = found.record.truth["time_s"], found.record.truth["cmd_B"]
        during = (time >= on) & (time < off)
        assert set(np.round(cmd[during], 4)) == {duty}
        current = found.record.truth["current_B_a"]
        settled = during & (time > on + 0.15)
        assert current[settled].min() > 0.9 * duty * current[settled].max() > 0.0


def test_coil_and_delays_agree_on_the_shift() -> None:
    coil, delays = shift(), run_in_memory(load("lab_n_b"))
    assert "current_B_a" not in delays.record.truth
    for name in ("valve_B_open", "valve_B_close", "stay_stop"):
        assert instants(coil, name) == pytest.approx(instants(delays, name), abs=0.0005)
    delayed_m_s = delays.shifts[0].impact_speed_m_s
    assert coil.shifts[0].impact_speed_m_s == pytest.approx(delayed_m_s, rel=0.01)


def test_current_is_in_trace_and_picture(tmp_path: Path) -> None:
    loaded = load("lab_n_b", settings={"plant.drive": "coil", "coil.dip": []})
    finished = run(loaded, tmp_path)
    assert finished.result.trace_sha256 == run_in_memory(loaded).trace_sha256
    assert "current_B_a" in (tmp_path / "trace.csv").read_text().split("\n", 1)[0].split(",")
    assert finished.record is not None
    panels = run_figure(finished.record, finished.shifts).stacks[0].panels
    assert "Current of the coils" in [panel.title for panel in panels]


def test_claims_of_the_drive_come_from_the_coil() -> None:
    claims = [check(item) for item in all_claims() if item.id in ("F16", "F17", "F18")]
    assert [item.verdict for item in claims] == [MET, PARTLY, MET]
    assert all("with the coil" in item.achieved for item in claims)

"""A shift whose valves have coils: what the current makes of duties, blow and handover."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sil.files.overrides import NO_SETTINGS, Settings
from sil.report.run_figure import run_figure
from sil.simulation.in_memory import Run, run_in_memory
from sil.simulation.load_scenario import load
from sil.simulation.runner import run
from tests.claims.claim import MET, PARTLY, all_claims, check


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
    assert coil.shifts[0].impact_speed_m_s == pytest.approx(
        delays.shifts[0].impact_speed_m_s, rel=0.01
    )


def test_current_is_in_trace_and_picture(tmp_path: Path) -> None:
    loaded = load("lab_n_b", settings={"plant.drive": "coil", "coil.dip": []})
    finished = run(loaded, tmp_path)
    assert finished.result.trace_sha256 == run_in_memory(loaded).trace_sha256
    assert "current_B_a" in (tmp_path / "trace.csv").read_text().split("\n", 1)[0].split(",")
    assert finished.record is not None
    titles = [
        panel.title for panel in run_figure(finished.record, finished.shifts).stacks[0].panels
    ]
    assert "Current of the coils" in titles


def test_claims_of_the_drive_come_from_the_coil() -> None:
    claims = [check(item) for item in all_claims() if item.id in ("F16", "F17", "F18")]
    assert [item.verdict for item in claims] == [MET, PARTLY, MET]
    assert all("with the coil" in item.achieved for item in claims)

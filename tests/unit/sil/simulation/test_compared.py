"""A shipped scenario with other values: what it changes, and what still fails it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from sil.cli import main
from sil.simulation.compared import metric_rows

FASTER = ["run", "lab_n_b", "--set", "controller.filter=false", "--no-report"]


def test_changed_values_are_answered_by_what_they_change(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*FASTER, "--out", str(tmp_path / "a")]) == 0
    first, *lines = capsys.readouterr().out.splitlines()
    assert first.startswith("lab_n_b with controller.filter=false: neutral to backward: 51 ms")
    lag = next(line for line in lines if "late at 10 %" in line).split()
    assert lag[-6:] == ["30.07", "ms", "10.94", "ms", "-19.1", "ms"]
    assert any("position_lag_10_s: 10.94 ms, as shipped 26 ms to 40 ms" in line for line in lines)
    assert not any("impact speed" in line or "not met" in line for line in lines)
    result = json.loads((tmp_path / "a" / "result.json").read_text())
    assert result["passed"] and result["status"] == "passed"
    lags = {row["name"]: row["differences"] for row in result["changes"]["metrics"]}
    assert lags["position_lag_10_s"][1] == pytest.approx(-0.0191, abs=1e-4)
    again = ["run", str(tmp_path / "a" / "result.json"), "--no-report"]
    assert main([*again, "--out", str(tmp_path / "again")]) == 0


def test_strict_a_file_and_expectations_of_ones_own_decide(tmp_path: Path) -> None:
    assert main([*FASTER, "--strict", "--out", str(tmp_path / "a")]) == 1
    limit = "expect.metrics.shift_time_s={max=0.03}"
    assert main([*FASTER, "--set", limit, "--out", str(tmp_path / "b")]) == 1
    failed = json.loads((tmp_path / "b" / "result.json").read_text())["expectations"]
    assert [check["name"] for check in failed if not check["passed"]] == ["shift_time_s"]


def test_what_always_holds_fails_a_changed_scenario_too(tmp_path: Path) -> None:
    assert main([*FASTER, "--set", "duration_s=150ms", "--out", str(tmp_path / "a")]) == 1
    failed = json.loads((tmp_path / "a" / "result.json").read_text())["expectations"]
    names = {check["name"] for check in failed if not check["passed"]}
    assert names == {"request for backward", "valves off at the end"}


def test_a_metric_row_has_values_differences_and_whether_it_changed() -> None:
    rows = metric_rows([{"shift_time_s": 0.05, "frames": 7}, {"frames": 7}, {"shift_time_s": 0.06}])
    time, frames = rows
    assert time.cells() == ["time from request to stop", "50 ms", "none", "60 ms", "", "+10 ms"]
    assert time.is_changed and frames.is_changed
    (same,) = metric_rows([{"air_used_kg": 1.0}, {"air_used_kg": 1.0 + 1e-12}])
    assert not same.is_changed

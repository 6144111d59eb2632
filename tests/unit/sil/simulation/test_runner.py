"""What a run writes besides its result: events, trace.csv, picture and page."""

from __future__ import annotations

import dataclasses
import json
from html.parser import HTMLParser
from pathlib import Path
from xml.etree import ElementTree

import pytest

from can_dbc.messages import Gear
from sil.cli import main
from sil.files.output_folder import finite
from sil.report.run_page import run_page
from sil.simulation import metrics
from sil.simulation.compared import metric_rows
from sil.simulation.in_memory import run_in_memory
from sil.simulation.load_scenario import from_table, load
from sil.simulation.results import Check, Result, as_json, junit_xml, versions
from tests.support import made_run


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


class _Tags(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.sources: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag not in ("meta", "img", "source", "br"):
            self.open.append(tag)
        self.sources += [v or "" for k, v in attrs if k in ("src", "href", "srcset")]

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def test_page_is_well_formed_and_needs_no_network() -> None:
    shifts = metrics.shifts(made_run.made(), Gear.NEUTRAL)
    figures = metrics.summary(shifts, None, 2, 200)
    result = finished_result(
        metrics=figures,
        scenario={"description": "<script>alert(1)</script>"},
        bus={"bitrate": 500_000, "load": 0.3, "messages": []},
    )
    page = run_page(result, b"\x89PNG")
    tags = _Tags()
    tags.feed(page)
    assert tags.open == []
    assert tags.sources and all(s.startswith("data:image/png;base64,") for s in tags.sources)
    assert "<script>alert" not in page and "&lt;script&gt;" in page
    assert "50 ms" in page and "prefers-color-scheme: dark" in page
    ended = finished_result(complete=False, why="plant died", scenario={"description": ""})
    assert run_page(ended, None)


def test_an_overloaded_bus_is_a_warning_with_its_cause_in_result_and_page(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    values = ("bus.bitrate=250000", "duration_s=0.3", "expect.min_frames=1")
    settings = [word for value in values for word in ("--set", value)]
    assert main(["run", "firmware_2500us", *settings, "--out", str(tmp_path / "out")]) == 1
    shown = capsys.readouterr()
    (warning,) = json.loads((tmp_path / "out" / "result.json").read_text())["warnings"]
    assert "the bus is 100 % loaded at 250 kbit/s" in warning
    assert "ControllerStatus are sent every 2.5 ms" in warning
    assert f"warning: {warning}\n" in shown.err
    assert "  not met: PlantMotion frames on the bus: 0, expected at least 1\n" in shown.out
    assert "the bus is 100 % loaded" in (tmp_path / "out" / "report.html").read_text()


def test_json_has_no_nan_and_the_promised_names() -> None:
    metrics = {"a": float("nan"), "b": [float("inf"), 1.0]}
    output = json.loads(as_json(finished_result(metrics=metrics)))
    assert output["metrics"] == {"a": None, "b": [None, 1.0]}
    promised = "passed expectations metrics trace_sha256 seed versions scenario"
    assert set(promised.split()) <= output.keys()
    assert finite({1: (float("-inf"), "x")}) == {"1": [None, "x"]}


def test_versions_name_the_libraries_a_result_depends_on() -> None:
    assert {"python", "numpy", "numba", "python-can"} <= versions().keys()


def test_junit_counts_failures_and_an_unfinished_run() -> None:
    bad = Check(name='<a> & "b"', passed=False, value=None, limit={"max": 1.0})
    checks = [*finished_result().expectations, bad]
    text = junit_xml(finished_result(expectations=checks, passed=False))
    suite = ElementTree.fromstring(text.split("\n", 1)[1])[0]
    assert (suite.get("tests"), suite.get("failures"), suite.get("errors")) == ("2", "1", "0")
    assert [c.get("name") for c in suite] == ["final gear", '<a> & "b"']
    ended = junit_xml(finished_result(complete=False, why="plant was killed\x00", passed=False))
    suite = ElementTree.fromstring(ended.split("\n", 1)[1])[0]
    assert (suite.get("tests"), suite.get("errors")) == ("2", "1")
    error = suite.find("testcase[@name='run finished']/error")
    assert error is not None and error.get("message") == "plant was killed?"


def test_another_valve_is_another_run() -> None:
    plain = run_in_memory(load("lab_n_b"))
    slow = run_in_memory(load("lab_n_b", settings={"valve.D_rise": 0.012}))
    assert plain.trace_sha256 != slow.trace_sha256
    assert slow.shifts[0].arrived_s == pytest.approx(plain.shifts[0].arrived_s + 0.004, abs=1e-6)


def test_a_request_that_the_run_is_too_short_for_fails_it_and_says_by_how_much() -> None:
    table = {"name": "short", "duration_s": 0.45, "request": [{"at_s": 0.4, "gear": "backward"}]}
    checks = run_in_memory(from_table(table, "short")).checks
    failed = [check for check in checks if not check.passed]
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
    free = dataclasses.replace(run, bus={**run.bus, "mode": "free-running"}).checks
    left_out = [check.name for check in run.checks if check.name not in {c.name for c in free}]
    assert all(check.passed for check in free)
    times = ["shift 1: commanded to valve_open", "frames later than their worst case"]
    assert left_out == ["impact_speed_m_s", *times]


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

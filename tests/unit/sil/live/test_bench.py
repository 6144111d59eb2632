"""What the live bench shows is what the copied command or scenario computes, to the bit."""

from __future__ import annotations

import shlex
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from can_dbc.errors import InputError
from sil.api import run
from sil.cli import main
from sil.files.overrides import parse_setting
from sil.live import bench, runs
from sil.live.bench import SLIDERS, Asked
from sil.simulation.in_memory import Run
from sil.simulation.load_scenario import shipped
from sil.simulation.scenario import Request

KNOWN = {name: name for name in shipped()}
NAME = "truck_into_gear_easy"
OWN = {s["path"]: s for s in bench.values_of(Asked(scenario=NAME), KNOWN)["sliders"]}


def computed(shown: dict[str, Any]) -> Run:
    """The run of the command that is offered, or of the scenario where there is none."""
    if not shown["command"]:
        return run(tomllib.loads(shown["toml"]))
    words = shlex.split(shown["command"])
    assert words[:2] == ["opc4", "run"]
    return run(words[2], dict(parse_setting(word) for word in words[3:] if word != "--set"))


@st.composite
def changes(draw: st.DrawFn) -> dict[str, Any]:
    """Values within the ends of some sliders, and the choices above them."""
    paths = draw(st.lists(st.sampled_from(sorted(SLIDERS)), max_size=3, unique=True))
    changed: dict[str, Any] = {}
    for path in paths:
        slider = OWN[path]
        changed[path] = float(
            f"{draw(st.sampled_from(slider['stops'][1:])) / slider['factor']:.12g}"
        )
    if draw(st.booleans()):
        changed["controller.filter"] = draw(st.booleans())
    if draw(st.booleans()):
        names = ("open_loop", "blow_cut", "air_cushion", "sliding_mode")
        changed["controller.strategy"] = draw(st.sampled_from(names))
    return changed


@given(changes())
@settings(max_examples=12)
def test_the_copied_command_computes_what_the_slider_shows(changed: dict[str, Any]) -> None:
    before, after = Asked(scenario=NAME), Asked(scenario=NAME, settings=changed)
    assume(bench.values_of(after, KNOWN)["reset"] == {})  # a corner above half the sensor's rate
    shown = bench.compare(before, after, KNOWN)
    again = computed(shown)
    assert again.trace_sha256 == shown["trace_sha256"]
    assert again.trace_sha256 == run(tomllib.loads(shown["toml"])).trace_sha256
    for key, name, factor, _ in bench.METRICS:
        value = again.metrics[key]
        now = next(row[3] for row in shown["metrics"] if row[0] == name)
        assert now == (None if value is None else factor * value)
    times = [row[3] for row in shown["metrics"] if row[1] == "ms"][: len(again.shifts) + 1]
    assert times[:-1] == [s.shift_time_s and 1e3 * s.shift_time_s for s in again.shifts]


def test_a_slider_has_round_steps_over_the_models_range() -> None:
    assert set(OWN) == set(SLIDERS)
    for slider in OWN.values():
        stops, step, low = slider["stops"], slider["step"], slider["low"]
        assert stops[0] == low and stops == sorted(stops) and stops[-1] <= slider["high"]
        assert slider["own"] is None or slider["own"] in stops
        for stop in stops:
            steps = stop / step
            assert abs(steps - round(steps)) < 1e-6 or stop in (low, slider["own"])
    assert OWN["sensor.period_s"]["low"] == 1.0 and OWN["sensor.delay_s"]["high"] == 500.0
    assert OWN["valve.D_rise"]["stops"][:3] == [0.0, 0.1, 0.2]


def test_another_scenario_says_which_settings_it_does_not_take() -> None:
    settings = {"valve.D_fall": 0.02, "sensr.delay_s": 1, "sensor.delay_s": -1.0}
    values = bench.values_of(Asked(scenario=NAME, settings=settings), KNOWN)
    assert list(values["reset"]) == ["sensr.delay_s", "sensor.delay_s"]
    assert "expected one of sensor.delay_s" in values["reset"]["sensr.delay_s"]


def test_requests_and_faults_come_with_the_copied_scenario() -> None:
    asked = Asked(
        scenario="full_shift",
        requests=[Request(at_s=0.1, gear="neutral"), Request(at_s=0.2, gear="backward")],
        faults={
            "fault": [
                {"kind": "loss", "start_s": 0.15, "message": "PositionPulse", "count": 2},
                {"kind": "sent", "start_s": 0.1505, "can_id": 0x18FF1234, "data": "01 02"},
            ],
            "sensor_fault": [{"kind": "stuck", "start_s": 0.3}],
        },
        duration_s=0.5,
    )
    shown = {**bench.compare(asked, asked, KNOWN), **bench.frames(asked, KNOWN)}
    assert shown["command"] == ""
    again = computed(shown)
    assert again.trace_sha256 == shown["trace_sha256"]
    assert len(again.frames) == len(shown["frames"]) > 300
    assert [f[5] for f in shown["frames"] if f[4] == "18FF1234"] == ["01 02"]
    assert {shift.to_gear for shift in again.shifts} == {"neutral", "backward"}
    assert b"NaN" not in msgspec.json.encode(shown, enc_hook=float)


def test_an_added_request_leaves_what_was_before_it() -> None:
    earlier = Asked(scenario="lab_n_b", duration_s=0.7)
    first = bench.compare(earlier, earlier, KNOWN)
    requests = [*(msgspec.convert(r, Request) for r in first["requests"])]
    later = Asked(
        scenario="lab_n_b", requests=[*requests, Request(at_s=0.4, gear="neutral")], duration_s=1.1
    )
    second = bench.compare(later, later, KNOWN)
    until = first["time_ms"].index(400.0)
    assert second["trace"]["stay"][:until] == first["trace"]["stay"][:until]
    assert second["trace"]["stay"][-1] == pytest.approx(0.0, abs=0.05)
    assert first["trace"]["stay"][-1] > 10.0


def refused() -> Iterator[tuple[dict[str, Any], str]]:
    yield {"scenario": "/etc/passwd"}, "scenario: '/etc/passwd'; expected one of"
    yield {"scenario": NAME, "settings": {"firmware": "x.py"}}, "firmware: cannot be set"
    yield {"scenario": NAME, "settings": {"model_set": "/x.toml"}}, "model_set: cannot be set"
    yield {"scenario": NAME, "settings": {"effects": "x.py"}}, "effects: cannot be set"
    yield {"scenario": NAME, "settings": {"bus.guest": True}}, "bus.guest: cannot be set"
    yield {"scenario": NAME, "settings": {"sensr.delay_s": 1}}, "expected one of sensor.delay_s"
    yield {"scenario": NAME, "settings": {"sensor.delay_s": -1.0}}, "sensor.delay_s"
    yield {"scenario": NAME, "duration_s": 3600.0}, "expected at most 20 s"
    yield {"scenario": NAME, "settings": {"trace_period_s": 1e-5}, "duration_s": 19.0}, "steps"
    yield {"scenario": NAME, "faults": {"fault": [{"kind": "none"}]}}, "fault[0]"


@pytest.mark.parametrize(("raw", "line"), list(refused()))
def test_what_a_page_may_not_ask_is_one_line(raw: dict[str, Any], line: str) -> None:
    with pytest.raises(InputError) as caught:
        bench.frames(msgspec.convert(raw, Asked), KNOWN)
    assert line in str(caught.value) and "\n" not in str(caught.value)


def test_every_fault_and_strategy_is_offered() -> None:
    offered = bench.vocabulary(KNOWN)
    kinds = {
        kind
        for schemas in offered["faults"].values()
        for schema in schemas
        for kind in schema["properties"]["kind"]["enum"]
    }
    assert {"loss", "babbling", "sent", "stuck", "garbage", "dead"} <= kinds
    assert offered["scenarios"] == sorted(KNOWN) and "open_loop" in offered["strategies"]


def test_a_file_of_the_user_is_offered_by_its_name(tmp_path: Path) -> None:
    file = tmp_path / "mine.toml"
    file.write_text(
        'name = "mine"\nduration_s = 0.2\n[[request]]\nat_s = 0.05\ngear = "backward"\n',
        encoding="utf-8",
    )
    asked = Asked(scenario="mine")
    assert bench.compare(asked, asked, {"mine": str(file)})["duration_ms"] == 200.0


def test_an_edited_scenario_is_run_anew(tmp_path: Path) -> None:
    file = tmp_path / "my.toml"
    text = shipped()["lab_n_b"].read_text()
    hashes = []
    for content in (text, text.replace("at_s = 0.1", "at_s = 0.2")):
        file.write_text(content)
        asked = Asked(scenario=str(file))
        hashes.append(bench.compare(asked, asked, {str(file): str(file)})["trace_sha256"])
    assert hashes[0] != hashes[1]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    outputs = tmp_path_factory.mktemp("runs")
    for name, extra in (("one", []), ("two", ["--set", "valve.D_rise=0.02", "--strict"])):
        code = main(["run", "lab_n_b", "--out", str(outputs / name), "--no-report", *extra])
        assert code in (0, 1)
    (outputs / "begun").mkdir()
    (outputs / "begun" / "INCOMPLETE").write_text("opc4 whatif is writing\n", encoding="utf-8")
    (outputs / "begun" / "results.csv").write_text("a,b\n1,2\n3,4\n", encoding="utf-8")
    (outputs / "other").mkdir()
    (outputs / "loop").symlink_to(outputs / "one")
    return outputs


def test_all_outputs_are_listed_with_their_state(folder: Path) -> None:
    entries = {entry["name"]: entry for entry in runs.listed(folder)}
    assert set(entries) == {"one", "two", "begun"}
    assert entries["one"]["state"] == "passed" and entries["two"]["state"] == "failed"
    assert entries["one"]["figures"]["impact_speed_m_s"] == pytest.approx(0.94, abs=0.01)
    assert entries["begun"]["kind"] == "study" and entries["begun"]["rows"] == 2
    assert entries["begun"]["state"] == "opc4 whatif is writing"


def test_runs_are_drawn_over_each_other(folder: Path) -> None:
    drawn = runs.compared(folder, ["one", "two"])
    position = drawn["panels"][0]["series"]
    assert [series["label"] for series in position] == ["one", "two"]
    reached = [next(x for x, y in zip(drawn["x"], s["y"], strict=True) if y > 5) for s in position]
    assert reached[1] - reached[0] == pytest.approx(12.0, abs=0.6)


@pytest.mark.parametrize("names", [[], ["one"] * 7, ["../one"], ["loop"], ["one", "begun"]])
def test_other_names_are_refused(folder: Path, names: list[str]) -> None:
    with pytest.raises(InputError, match="runs: "):
        runs.compared(folder, names)


def test_a_study_is_drawn_as_far_as_it_is(folder: Path) -> None:
    rows = [
        "row,load,impact_speed_m_s,same,outcome",
        "0,a,0.5,1,passed",
        "1,b,0.75,1,passed",
        "2,c,0.",
    ]
    (folder / "begun" / "results.csv").write_text("\n".join(rows), encoding="utf-8")
    drawn = runs.compared(folder, ["begun"])
    assert [panel["title"] for panel in drawn["panels"]] == ["impact_speed_m_s"]
    assert drawn["panels"][0]["series"][0]["y"] == [0.5, 0.75]
    (folder / "begun" / "results.csv").write_text(rows[0] + "\n", encoding="utf-8")
    assert runs.compared(folder, ["begun"])["panels"][0]["title"] == "No numbers yet"


def test_no_folder_is_an_empty_list(tmp_path: Path) -> None:
    assert runs.listed(tmp_path / "none") == []

"""Whole replays of golden logs that something was done to; diff.txt, diff.json, page and figures."""

from __future__ import annotations

import json
import re
from base64 import b64decode
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from can_dbc.errors import InputError, RunError
from can_dbc.messages import ControllerStatus, SafetyBlow, ShiftRequest, ValveCommand
from sil.log_replay.figures import scene_figure
from sil.log_replay.recorded_frames import ID_OF
from sil.log_replay.replay import ReplayRequest, ReplayResult, replay
from sil.log_replay.report import as_dict, replay_page, text
from sil.log_replay.signals import Options
from sil.logs import LogFrame
from sil.simulation import load_scenario, scenario
from sil.simulation.in_memory import run_in_memory
from tests.support.golden_logs import frames, golden, write

PERIOD = 10_000_000


@cache
def long_log(seconds: int) -> list[LogFrame]:
    """Several shifts on one clock."""
    requests = [
        {"at_s": 0.1 + 0.8 * k, "gear": ("backward", "neutral")[k % 2]} for k in range(2 * seconds)
    ]
    table = {"name": "long", "duration_s": 1.6 * seconds, "request": requests}
    run = run_in_memory(load_scenario.from_table(table, "test"))
    return [LogFrame(f.arrival_ns, *f.frame, channel="can0") for f in run.record.frames]


def replayed(tmp_path: Path, log: list[LogFrame], **request: object) -> ReplayResult:
    path = write(tmp_path / "made.log", log)
    found = replay(ReplayRequest(str(path), **request))  # type: ignore[arg-type]
    assert found.account.total() == found.frames == len(log)
    return found


@pytest.mark.parametrize("ppm", [-80, 40, 700])
def test_a_recorders_clock_that_drifts_away_is_followed(tmp_path: Path, ppm: int) -> None:
    log = long_log(8)
    begin = 1_700_000_000_000_000_000
    drifting = [f._replace(time_ns=begin + round(f.time_ns * (1 + ppm * 1e-6))) for f in log]
    found = replayed(tmp_path, drifting)
    assert not found.differs and found.comparison.ticks == 8 * 160
    assert any(f"clock runs {ppm:+}.0 ppm" in note for note in found.notes), found.notes


def test_a_log_cut_off_in_the_middle_of_a_shift_agrees_once_that_is_over(tmp_path: Path) -> None:
    found = replayed(tmp_path, [f for f in frames("full_shift") if f.time_ns > 300_000_000])
    assert not found.differs
    assert found.comparison.warm_up_ticks > 10 and found.comparison.ticks > 100
    assert any("left out at the beginning" in note for note in found.notes)


def test_a_unit_that_stood_still_is_replayed_as_one_that_did(tmp_path: Path) -> None:
    """Frames of the pause reach the control unit at its next tick; nothing else is lost or invented."""
    log = frames("lab_n_b")
    idle = [f for f in log if f.time_ns > 350_050_000]
    ours = {ID_OF[kind] for kind in (ValveCommand, SafetyBlow, ControllerStatus)}
    paused = [f for f in log if f not in idle]
    paused += [f._replace(time_ns=f.time_ns + 5 * PERIOD) for f in idle]
    found = replayed(tmp_path, paused)
    assert [tuple(span) for span in found.ticks.idle] == [(35, 40)]
    assert found.steps == 70 and len([f for f in paused if f.can_id in ours]) == 210


def test_a_hole_of_an_age_is_stepped_over(tmp_path: Path) -> None:
    log = frames("full_shift")
    age_ns = 10**9 * 10**9 + 3 * PERIOD
    late = [f._replace(time_ns=f.time_ns + age_ns) if f.time_ns > 560_050_000 else f for f in log]
    found = replayed(tmp_path, late)
    assert not found.differs and found.steps == 160
    assert found.comparison.ticks > 130 and found.comparison.warm_up_ticks > 0
    with pytest.raises(InputError, match="the recording has gaps"):
        replay(ReplayRequest(found.request.log, plant=True))


def test_a_hampered_unit_and_bus_are_replayed_as_they_were(tmp_path: Path) -> None:
    """Pauses of the control unit, frames lost, corrupted and late all at once; the settings unknown."""
    faults = [
        {"kind": "stalled", "node": "controller", "start_s": 0.305, "end_s": 0.333},
        {"kind": "stalled", "node": "controller", "start_s": 0.6, "end_s": 0.66},
        {"kind": "loss", "message": "ControllerStatus", "probability": 0.1},
        {"kind": "corruption", "message": "SafetyBlow", "probability": 0.05},
        {"kind": "delay", "message": "PositionPulse", "delay_s": 0.004, "jitter_s": 0.012},
    ]
    requests = [{"at_s": 0.1, "gear": "backward"}, {"at_s": 0.7, "gear": "neutral"}]
    table = {"name": "hampered", "duration_s": 1.2, "request": requests, "fault": faults}
    run = run_in_memory(load_scenario.from_table(table, "test"))
    log = [LogFrame(f.arrival_ns, *f.frame, channel="can0") for f in run.record.frames]
    found = replayed(tmp_path, log)
    assert not found.differs, found.comparison.first
    assert [tuple(span) for span in found.ticks.idle] == [(31, 34), (60, 66)]
    assert found.account["SafetyBlow with a wrong checksum or length"] > 0
    assert found.unanswered["ControllerStatus"] > 5


def test_one_changed_input_is_found_with_its_time(tmp_path: Path) -> None:
    log = frames("lab_n_b")
    request = ID_OF[ShiftRequest]
    without = [f for f in log if not (f.can_id == request and 95_000_000 < f.time_ns < 125_000_000)]
    found = replayed(tmp_path, without)
    assert found.differs
    valve = found.comparison.matched_edges()[0]
    assert valve.lines(PERIOD)[0].startswith("valve B opens")
    assert all(shift > 0 for shift in valve.shift_ns)


def test_ignoring_all_that_differs_leaves_no_difference() -> None:
    names = ["ControllerStatus.*", "Etc?.*", "ValveCommand.*", "SafetyBlow.*"]
    request = ReplayRequest(str(golden("lab_n_b")), settings={"controller.filter": False})
    assert replay(request).differs
    ignoring = ReplayRequest(request.log, settings=request.settings, options=Options(ignore=names))
    assert not replay(ignoring).differs
    tolerant = ReplayRequest(
        request.log,
        settings=request.settings,
        options=Options(
            time_s=0.035,
            tolerance={"ControllerStatus.estimate_m": 0.02},
            ignore=["SafetyBlow.remaining_s"],
        ),
    )
    assert not replay(tolerant).differs


def test_an_odd_period_of_a_known_run_is_that_of_the_run(tmp_path: Path) -> None:
    table = {
        "name": "odd",
        "duration_s": 0.6,
        "request": [{"at_s": 0.1, "gear": "backward"}],
        "controller": {"period_s": 0.010003},
    }
    loaded = load_scenario.from_table(table, "test")
    run = run_in_memory(loaded)
    (tmp_path / "result.json").write_text(
        json.dumps({"scenario": scenario.expanded(loaded.scenario)})
    )
    log = [LogFrame(f.arrival_ns, *f.frame, channel="can0") for f in run.record.frames]
    found = replayed(tmp_path, log)
    assert not found.differs and found.grid.period_ns == 10_003_000 and found.grid.exact


def test_another_period_is_compared_in_time(tmp_path: Path) -> None:
    request = ReplayRequest(str(golden("lab_n_b")), settings={"controller.period_s": 0.005})
    found = replay(request)
    assert found.steps == 2 * 69 + 1
    edges = found.comparison.matched_edges()[0]
    assert len(edges.matching.pairs) == 2
    assert all(shift % 5_000_000 == 0 for shift in edges.shift_ns)


LATE = """
import dataclasses

from controller.firmware import Firmware


class Late(Firmware):
    ticks = 0

    def step(self, now_ns, inputs):
        out = super().step(now_ns, inputs)
        self.ticks = self.ticks + 1 if out.valves.duty_b > 0.4 else 0
        if 0 < self.ticks < 3:
            out = out._replace(valves=dataclasses.replace(out.valves, duty_b=0.0))
        return out


class Broken(Firmware):
    def step(self, now_ns, inputs):
        return super().step(now_ns, inputs) if now_ns < 100_000_000 else 1 // 0
"""


def test_a_firmware_of_ones_own_is_replayed_on_what_ours_heard(tmp_path: Path) -> None:
    (tmp_path / "own.py").write_text(LATE)
    found = replay(ReplayRequest(str(golden("lab_n_b")), firmware=f"{tmp_path / 'own.py'}:Late"))
    valve = found.comparison.matched_edges()[0]
    assert valve.lines(PERIOD) == ["valve B opens 2 samples (20 ms) later, once out of 1"]
    with pytest.raises(RunError, match=r"own\.py:20: ZeroDivisionError: "):
        replay(ReplayRequest(str(golden("lab_n_b")), firmware=f"{tmp_path / 'own.py'}:Broken"))
    with pytest.raises(InputError, match="no class 'None'"):
        replay(ReplayRequest(str(golden("lab_n_b")), firmware=f"{tmp_path / 'own.py'}:None"))


def test_damaged_answers_are_counted_not_compared(tmp_path: Path) -> None:
    log = frames("lab_n_b")
    place = next(i for i, f in enumerate(log) if f.can_id == ID_OF[ValveCommand] and i > 200)
    log[place] = log[place]._replace(data=log[place].data[:3] + b"\x55" + log[place].data[4:])
    found = replayed(tmp_path, log)
    assert not found.differs
    assert found.account["ValveCommand with a wrong checksum or length"] == 1


def test_a_log_of_two_recordings_in_one_counts_every_frame_once(tmp_path: Path) -> None:
    log = frames("lab_n_b")
    found = replayed(tmp_path, [f for frame in log for f in (frame, frame)])
    assert not found.differs and found.steps == 70
    assert found.account["frames that are there twice"] == len(log)


def test_foreign_frames_pass_through_untouched(tmp_path: Path) -> None:
    log = frames("lab_n_b")
    strange = [
        LogFrame(k * 1_000_000, 0x18FEF100 + k % 3, bytes(8), channel="opc4") for k in range(1, 600)
    ]
    found = replayed(tmp_path, sorted([*log, *strange], key=lambda f: f.time_ns))
    assert not found.differs and found.account["foreign"] == 599


@pytest.mark.parametrize(
    ("keep", "complaint"),
    [
        (lambda f: f.can_id != ID_OF[ValveCommand], "no ValveCommand in it"),
        (lambda f: f.can_id != ID_OF[ShiftRequest], "no ShiftRequest in it"),
        (lambda f: f.time_ns < 95_000_000, "no valve was ever energised"),
    ],
)
def test_a_log_in_which_nothing_was_engaged_is_refused(
    tmp_path: Path, keep: object, complaint: str
) -> None:
    path = write(tmp_path / "x.log", [f for f in frames("lab_n_b") if keep(f)])  # type: ignore[operator]
    with pytest.raises(InputError) as refused:
        replay(ReplayRequest(str(path)))
    assert complaint in str(refused.value) and str(path) in str(refused.value)


CHANGED = replay(ReplayRequest(str(golden("full_shift")), settings={"controller.filter": False}))
SAME = replay(ReplayRequest(str(golden("full_shift"))))


def test_the_page_needs_no_network_and_shows_pictures_of_both_shifts(tmp_path: Path) -> None:
    page = replay_page(CHANGED, as_dict(CHANGED), "opc4 replay <log>", tmp_path)
    assert not re.search(r"(?:src|href)=\"http", page)
    pictures = re.findall(r"base64,([^\"]+)", page)
    assert len(pictures) == 2
    assert all(b64decode(p).startswith(b"\x89PNG") for p in pictures)
    assert "valve N closes 3 samples (30 ms) earlier, once out of 1" in page
    assert "opc4 replay &lt;log&gt;" in page and ">differs<" in page


def test_the_text_has_edges_first_difference_and_waveforms() -> None:
    reported = text(CHANGED)
    assert "  safety blow begins 3 samples (30 ms) earlier, twice out of 2\n" in reported
    assert "first difference at 0.180000 s\n  ControllerStatus.estimate_m: recorded" in reported
    assert (
        "first command that differs at 0.210000 s\n  SafetyBlow.chamber: recorded NONE, replayed N\n"
        in reported
    )
    recorded, replayed = (
        re.search(rf"{side} (_+#+_+)\n", reported) for side in ("recorded", "replayed")
    )
    assert recorded and replayed
    assert recorded[1].count("#") - replayed[1].count("#") == 3
    assert "none of 12 moved" in text(SAME)


def test_the_values_are_plain_json() -> None:
    reported = json.loads(json.dumps(as_dict(CHANGED)))
    assert reported["differs"] is True
    lane = next(lane for lane in reported["edges"] if lane["name"] == "valve F")
    assert lane["matched"][1]["shift_ms"] == -30.0
    assert reported["frames"]["accounted"] == reported["frames"]["total"] == 1200
    assert reported["first_command"]["time_s"] == 0.21
    assert reported["signals"]["ValveCommand.duty_n"]["differing"] == 3


@pytest.mark.parametrize("with_run", [True, False])
def test_faults_and_their_detection_are_marked_on_both_sides(
    tmp_path: Path, with_run: bool
) -> None:
    log = golden("stuck_sensor")
    outcome = replay(ReplayRequest(str(log), run="stuck_sensor" if with_run else None, plant=True))
    page = replay_page(outcome, as_dict(outcome), "opc4 replay", tmp_path)
    assert ("fault: sensor stuck" in page) == with_run
    assert "SENSOR_STUCK reported" in page


def test_a_scene_shows_both_sides() -> None:
    scene = CHANGED.comparison.excerpts.excerpts[0]
    (stack,) = scene_figure(scene, CHANGED.labels, CHANGED.grid.origin_ns).stacks
    position, coils, states = stack.panels
    recorded, replayed = position.series
    for line in (recorded, replayed):
        assert np.all(np.diff(line.x) > 0.0) and len(line.x) == len(line.y) == len(scene.rows) + 1
    assert not np.array_equal(recorded.y, replayed.y, equal_nan=True)
    assert np.nanmax(recorded.y) > 12.0
    assert len(coils.ticks) == 6 and {span.role for span in coils.spans} == {"N"}
    assert {"push", "blow", "hold"} <= {span.label for span in states.spans}

"""diff.txt, diff.json and the page of a replay."""

from __future__ import annotations

import json
import re
from base64 import b64decode
from pathlib import Path

import pytest

from sil.log_replay.replay import ReplayRequest, replay
from sil.log_replay.report import as_dict, replay_page, summary_lines, text
from tests.support.golden_logs import golden

FOUND = replay(ReplayRequest(str(golden("full_shift")), settings={"controller.filter": False}))
SAME = replay(ReplayRequest(str(golden("full_shift"))))


def test_the_page_needs_no_network_and_shows_pictures_of_both_shifts(tmp_path: Path) -> None:
    page = replay_page(FOUND, as_dict(FOUND), "opc4 replay <log>", tmp_path)
    assert not re.search(r"(?:src|href)=\"http", page)
    pictures = re.findall(r"base64,([^\"]+)", page)
    assert len(pictures) == 2
    assert all(b64decode(p).startswith(b"\x89PNG") for p in pictures)
    assert "valve N closes 3 samples (30 ms) earlier, once out of 1" in page
    assert "opc4 replay &lt;log&gt;" in page and ">differs<" in page


def test_the_page_of_no_difference_shows_what_was_compared(tmp_path: Path) -> None:
    page = replay_page(SAME, as_dict(SAME), "opc4 replay", tmp_path)
    assert ">no difference<" in page and "No edge moved." in page
    assert len(re.findall(r"base64,", page)) == 2
    assert "First difference" not in page


def test_the_text_has_edges_first_difference_and_waveforms() -> None:
    reported = text(FOUND)
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
    reported = json.loads(json.dumps(as_dict(FOUND)))
    assert reported["differs"] is True
    lane = next(lane for lane in reported["edges"] if lane["name"] == "valve F")
    assert lane["matched"][1]["shift_ms"] == -30.0
    assert reported["frames"]["accounted"] == reported["frames"]["total"] == 1200
    assert reported["first_command"]["time_s"] == 0.21
    assert reported["signals"]["ValveCommand.duty_n"]["differing"] == 3


def test_what_is_printed_is_short() -> None:
    assert summary_lines(SAME)[0].endswith("no difference in 160 ticks")
    assert len(summary_lines(FOUND)) < 15


@pytest.mark.parametrize("with_run", [True, False])
def test_faults_and_their_detection_are_marked_on_both_sides(
    tmp_path: Path, with_run: bool
) -> None:
    log = golden("stuck_sensor")
    outcome = replay(ReplayRequest(str(log), run="stuck_sensor" if with_run else None, plant=True))
    page = replay_page(outcome, as_dict(outcome), "opc4 replay", tmp_path)
    assert ("fault: sensor stuck" in page) == with_run
    assert "SENSOR_STUCK reported" in page

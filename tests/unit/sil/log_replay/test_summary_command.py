"""`opc4 replay LOG --summary`: text, JSON, page and pictures of a truck's shifts."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from sil import cli
from sil.logs import LogFrame, open_writer
from tests.support.j1939_logs import with_engine


def written(path: Path, frames: list[LogFrame]) -> Path:
    with open_writer(path) as writer:
        for frame in frames:
            writer.write(frame)
    return path


def test_a_folder_with_page_pictures_and_figures(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    frames = with_engine()
    half = len(frames) // 2
    one, two = (
        written(tmp_path / "1.log", frames[:half]),
        written(tmp_path / "2.log", frames[half:]),
    )
    out = tmp_path / "out"
    assert cli.main(["replay", str(two), str(one), "--summary", "--out", str(out)]) == 0
    text = capsys.readouterr().out
    assert "3 shifts in" in text and "engine torque 60 %" in text and "after a gap of" in text
    names = {path.name for path in out.iterdir()}
    assert {"report.html", "summary.json", "shifts.png", "shift_1.png", "shift_3.svg"} <= names
    values = json.loads((out / "summary.json").read_text())
    assert values["shifts"][1]["engine"]["torque_least_percent"] == -5
    assert len(values["log_report"]["files"]) == 2
    assert "1 to 2" in (out / "report.html").read_text(encoding="utf-8")


def test_a_selection_leaves_shifts_out(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = written(tmp_path / "1.log", with_engine())
    assert cli.main(["replay", str(log), "--summary", "--json", "--until", "7"]) == 0
    assert len(json.loads(capsys.readouterr().out)["shifts"]) == 2


def test_a_log_without_times_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lines = [f"can0  {f.can_id:08X}   [8]  {f.data.hex(' ').upper()}\n" for f in with_engine()]
    (tmp_path / "screen.log").write_text("".join(lines))
    assert cli.main(["replay", str(tmp_path / "screen.log"), "--summary"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "has no times, so that no shift time is known" in line


def test_notes_of_the_log_are_printed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = written(tmp_path / "1.blf", with_engine())
    assert cli.main(["replay", str(log), "--summary"]) == 0
    assert "log: the start in the header names no time zone" in capsys.readouterr().out


@pytest.mark.parametrize(
    "words", [["--set", "a=3"], ["--closed-loop"], ["--strategy", "x"], ["--map", "m.toml"]]
)
def test_options_of_a_replay_are_refused(
    words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = written(tmp_path / "1.log", with_engine())
    assert cli.main(["replay", str(log), "--summary", *words]) == 2
    assert capsys.readouterr().err == (
        f"opc4 replay: {words[0]}: not together with --summary, which replays nothing; expected one "
        "of them\n"
    )

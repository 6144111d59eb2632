"""The smaller commands."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from sil import cli

LOG = "(0000000000.001000) opc4 0CFF2091#0011223344556677\n"


def test_convert_writes_once_and_refuses_the_rest(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source, target = tmp_path / "bus.log", tmp_path / "bus.asc"
    source.write_text(LOG)
    assert cli.main(["convert", str(source), str(target), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["written"] == 1
    assert cli.main(["convert", str(source), str(target)]) == 2
    assert "exists; expected a new name" in capsys.readouterr().err
    assert cli.main(["convert", str(source), str(target), "--force"]) == 0
    assert cli.main(["convert", str(tmp_path / "no.log"), str(tmp_path / "x.asc")]) == 2
    assert cli.main(["convert", str(source), str(tmp_path / "x.wav")]) == 2
    assert "Traceback" not in capsys.readouterr().err


@pytest.mark.parametrize("command", ["run", "simulate", "diagnose", "whatif", "replay", "convert"])
@pytest.mark.parametrize("name", ["x" * 5000, "loop/campaign"])
def test_a_path_that_cannot_exist_is_bad_input(
    command: str,
    name: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("loop").symlink_to("loop")
    words = [command, name, "out.log"] if command == "convert" else [command, name]
    assert cli.main(words) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"opc4 {command}: ") and "expected" in line
    assert {path.name for path in tmp_path.iterdir()} == {"loop"}


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["run", "x", "--seed", "1.5"], "--seed: '1.5'; expected a whole number"),
        (["run", "x", "--speed", "fast"], "--speed: 'fast'; expected a number"),
        (["diagnose", "x", "--workers", "0"], "--workers 0: expected 1 or more"),
        (["whatif"], "no STUDY; expected a file or a shipped name"),
    ],
)
def test_a_wrong_option_is_one_line(
    words: list[str], line: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(words) == 2
    (said,) = capsys.readouterr().err.splitlines()
    assert line in said


def test_a_path_without_permission_is_bad_input(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out, report = tmp_path / "out", tmp_path / "a.xml"
    monkeypatch.setattr("os.access", lambda *_: False)
    assert cli.main(["run", "lab_n_b", "--junit", str(report), "--out", str(out)]) == 2
    line = f"opc4 run: {report}: --junit: no permission; expected a folder to write in\n"
    assert capsys.readouterr().err == line and not out.exists()


def test_a_folder_that_holds_a_run_is_refused_before_logs_are_judged(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source, out = tmp_path / "bus.log", tmp_path / "out"
    source.write_text(LOG)
    assert cli.main(["diagnose", str(source), "--out", str(out)]) == 2
    assert "--out" not in capsys.readouterr().err  # the log is what is wrong
    assert not out.exists()
    out.mkdir()
    (out / "diagnosis.json").write_text("{}")
    assert cli.main(["diagnose", str(source), "--out", str(out)]) == 2
    assert "holds another run (diagnosis.json)" in capsys.readouterr().err
    assert (out / "diagnosis.json").read_text() == "{}"

"""Drafts of a user's own files run as they are; what cannot be written is refused in one line."""

from __future__ import annotations

from pathlib import Path

import pytest

from sil.cli import main


@pytest.mark.parametrize(
    ("command", "name", "then"),
    [
        ("run", "my shift.toml", ["run", "my shift.toml", "--no-report"]),
        ("whatif", "study.toml", ["whatif", "study.toml"]),
        ("firmware", "own.py", ["run", "lab_n_b", "--firmware", "own.py", "--no-report"]),
    ],
)
def test_a_draft_runs_as_it_is(
    command: str,
    name: str,
    then: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main([command, "--new", name]) == 0
    assert f"{name}: a draft that runs as it is: opc4 " in capsys.readouterr().out
    assert main([*then, "--out", "out"]) == 0
    text = Path(name).read_text(encoding="utf-8")
    assert text.count("#") > 5 or '"""' in text
    Path(name).write_text("mine")
    assert main([command, "--new", name]) == 2
    assert Path(name).read_text() == "mine"
    assert main([command, "--new", name, "--force"]) == 0
    assert Path(name).read_text(encoding="utf-8") == text


def test_the_draft_of_a_firmware_changes_what_it_says(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["firmware", "--new", "own.py"]) == 0
    own = Path("own.py")
    own.write_text(own.read_text().replace("MAX_DUTY = 1.0", "MAX_DUTY = 0.3"))
    assert main(["run", "lab_n_b", "--firmware", "own.py", "--no-report", "--out", "out"]) == 1
    assert "lab_n_b with firmware=own.py: neutral to backward: never" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["run", "--new", "my.json"], "no draft of such a file; expected FILE.toml"),
        (["firmware", "--new", "own.cpp"], "expected FILE.c or FILE.py"),
        (["run", "--new", "nowhere/my.toml"], "no such folder; expected a file in one that exists"),
    ],
)
def test_what_is_no_draft_is_one_line(
    words: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(words) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert said in line

"""`opc4 replay`: the files it lists, and files that it must not read without an end."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from sil.cli import main
from tests.support.golden_logs import golden


def test_the_files_listed_are_those_in_the_folder(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert main(["replay", str(golden("full_shift")), "--out", str(out)]) == 0
    last = capsys.readouterr().out.splitlines()[-1]
    files = sorted(path.name for path in out.iterdir())
    assert last == f"  {out}: {' '.join(files)}"
    assert "diff.json" in files and "INCOMPLETE" not in files


@pytest.mark.parametrize("option", ["--options", "--firmware", "--dbc"])
@pytest.mark.parametrize("name", ["pipe", "pipe.json", "pipe.toml", "/dev/zero"])
def test_a_device_or_pipe_is_refused_at_once(
    option: str, name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / name
    if name != "/dev/zero":
        os.mkfifo(path)
    assert main(["replay", str(golden("full_shift")), option, str(path)]) == 2
    complaint = capsys.readouterr().err
    assert "is a device or pipe; expected" in complaint and complaint.count("\n") == 1


def test_a_pipe_beside_the_log_is_not_waited_for(tmp_path: Path) -> None:
    log = tmp_path / "bus.log"
    log.write_bytes(golden("full_shift").read_bytes())
    os.mkfifo(tmp_path / "result.json")
    assert main(["replay", str(log), "--out", str(tmp_path / "out")]) == 0

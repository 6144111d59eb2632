"""What is no file of the kind that a command reads: one line that names it, exit 2, nothing written."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from pathlib import Path

import pytest

from sil import cli

READERS = {
    ".toml": ["run", "{}"],
    ".json": ["compare", "{}", "{}"],
    ".dbc": ["bus", "--dbc", "{}"],
    ".py": ["run", "lab_n_b", "--rules", "{}"],
    ".mat": ["diagnose", "--new", "out", "--rig", "actuator", "{}"],
    ".parquet": ["diagnose", "--new", "out", "--rig", "force", "{}"],
    ".h5": ["diagnose", "--new", "out", "--rig", "force", "{}"],
    ".tdms": ["diagnose", "--new", "out", "--rig", "force", "{}"],
    ".csv": ["diagnose", "--new", "out", "--rig", "fixed", "{}"],
    ".asc": ["convert", "{}", "out.log"],
    ".blf": ["convert", "{}", "out.log"],
    ".mf4": ["replay", "{}"],
    ".opc4": ["run", "--from", "{}"],
}
SPOILS: dict[str, Callable[[Path], object]] = {
    "empty": lambda path: path.write_bytes(b""),
    "null bytes": lambda path: path.write_bytes(b"\0" * 4096),
    "Latin-1": lambda path: path.write_bytes('name = "Gr\xf6\xdfe"\n'.encode("latin-1")),
    "nested": lambda path: path.write_bytes(b"[" * 100_000 + b"]" * 100_000),
    "folder": Path.mkdir,
    "circle": lambda path: path.symlink_to(path.name),
    "nowhere": lambda path: path.symlink_to("nowhere"),
    "/dev/zero": lambda path: path.symlink_to("/dev/zero"),
    "/proc/self/mem": lambda path: path.symlink_to("/proc/self/mem"),
    "pipe": os.mkfifo,
}
MAY_WAIT = (".asc", ".blf", ".mf4")
"""Logs may come from a pipe, whose writer is waited for."""


@pytest.mark.parametrize("spoil", SPOILS)
@pytest.mark.parametrize("suffix", READERS)
def test_a_bad_file_is_refused_in_one_line(
    suffix: str,
    spoil: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    if suffix in MAY_WAIT and spoil == "pipe":
        return
    if suffix == ".py" and spoil == "empty":
        return  # is Python, without rules: test_user_file
    monkeypatch.chdir(tmp_path)
    path = Path(f"x{suffix}")
    SPOILS[spoil](path)
    assert cli.main([word.format(path) for word in READERS[suffix]]) == 2
    captured = capfd.readouterr()
    (line,) = captured.err.splitlines()
    assert captured.out == "" and str(path) in line
    assert [each.name for each in tmp_path.iterdir()] == [path.name]


def test_a_full_disk_is_told_with_the_file_that_it_has_no_room_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    rows = "".join(f"{k / 1000},{k * 1e-4},{k}\n" for k in range(100))
    Path("x.csv").write_text(f"time_s,position_m,force_n\n{rows}")
    replace, reason = os.replace, (errno.ENOSPC, os.strerror(errno.ENOSPC))

    def full(source: str, target: Path) -> None:
        if target.name == "x.csv":
            raise OSError(*reason, str(source))
        replace(source, target)

    monkeypatch.setattr(os, "replace", full)
    assert cli.main(["diagnose", "--new", "out", "--rig", "force", "x.csv"]) == 3
    (line,) = capsys.readouterr().err.splitlines()
    assert line == f"opc4 diagnose: out/x.csv: {reason[1]}"
    assert not list(Path("out").glob("*x.csv*"))

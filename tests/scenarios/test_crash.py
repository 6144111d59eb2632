"""Whatever ends a run early: a clear line, exit 3 soon, and everything recorded so far readable."""

from __future__ import annotations

import contextlib
import csv
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import can
import pytest

from tests.conftest import ROOT

Run = Callable[..., subprocess.CompletedProcess[str]]
SLOWED = ("--transport", "local", "--speed", "0.4", "--json")


@contextlib.contextmanager
def running(folder: Path) -> Iterator[subprocess.Popen[str]]:
    """Start a slowed-down run over the local bus; yield it in mid-shift."""
    process = subprocess.Popen(
        [sys.executable, "-m", "sil.cli", "run", "full_shift", *SLOWED, "--out", str(folder)],
        cwd=folder.parent,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        deadline = time.monotonic() + 180.0
        while not _under_way(folder / "bus.log"):
            assert process.poll() is None, process.communicate()
            assert time.monotonic() < deadline
            time.sleep(0.02)
        yield process
    finally:
        process.kill()
        process.communicate()


def _under_way(log: Path) -> bool:
    return log.exists() and log.read_bytes().count(b"\n") > 150


def child(process: subprocess.Popen[str], participant: str) -> int:
    """Return the process number of one participant of a run."""
    for entry in Path("/proc").iterdir():
        with contextlib.suppress(OSError, ValueError):
            words = (entry / "cmdline").read_bytes().decode().split("\0")
            parent = int((entry / "stat").read_text().rsplit(")", 1)[1].split()[1])
            if parent == process.pid and "node" in words and participant in words:
                return int(entry.name)
    raise AssertionError(f"no process of {participant}")


def gone(pid: int) -> bool:
    try:
        state = (Path("/proc") / str(pid) / "stat").read_text().rsplit(")", 1)[1].split()[0]
    except OSError:
        return True
    return state == "Z"


def check_readable(folder: Path, why: str) -> None:
    """The folder says that it is incomplete, and log, trace and events read to the last entry."""
    result = json.loads((folder / "result.json").read_text())
    assert result["complete"] is False and result["passed"] is False
    assert result["status"] == "incomplete" and why in result["why"]
    assert result["scenario"]["name"] == "full_shift"
    lines = (folder / "bus.log").read_bytes()
    assert lines.endswith(b"\n")
    with can.LogReader(str(folder / "bus.log")) as log:
        assert len(list(log)) == lines.count(b"\n") > 150


@pytest.mark.parametrize("victim", ["plant", "controller"])
def test_killed_participant(victim: str, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    with running(folder) as process:
        pids = [child(process, name) for name in ("plant", "controller")]
        os.kill(child(process, victim), signal.SIGKILL)
        out, err = process.communicate(timeout=60.0)
    assert process.returncode == 3
    assert f"{victim} was killed by SIGKILL" in err and "Traceback" not in err
    assert json.loads(out)["complete"] is False
    check_readable(folder, f"{victim} was killed by SIGKILL")
    with (folder / "trace.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) > 100 and float(rows[-1]["time_s"]) > 0.1
    assert all(gone(pid) for pid in pids)


def test_killed_coordinator_leaves_no_process_and_a_folder_that_says_so(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    with running(folder) as process:
        pids = [child(process, name) for name in ("plant", "controller")]
        process.kill()
        process.communicate()
        deadline = time.monotonic() + 60.0
        while not all(gone(pid) for pid in pids):
            assert time.monotonic() < deadline
            time.sleep(0.05)
    check_readable(folder, "cut off")


def test_a_transport_that_is_not_there_leaves_nothing_behind(opc4: Run, tmp_path: Path) -> None:
    done = opc4("run", "lab_n_b", "--transport", "nocan9", "--out", "run")
    assert done.returncode == 2, done.stderr
    assert done.stderr.count("\n") == 1 and "nocan9" in done.stderr
    assert not (tmp_path / "run").exists()

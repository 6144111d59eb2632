"""Sweeps by several processes: killed and resumed, and over a real cluster, the same bytes."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from can_dbc.errors import InputError, RunError
from sil.studies.executor import run_study
from sil.studies.load_study import load_study
from sil.studies.table import RESULTS

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[4]

SWEEP = """
name = "sweep"
scenario = "short.toml"
[[sweep]]
path = "valve.D_fall"
low = 0.002
high = 0.035
steps = 120
"""

SPECIAL = {
    "budget": """
name = "three"
kind = "budget"
scenario = "lab_n_b"
[[sweep]]
path = "sensor.delay_s"
values = [0.0, 0.002, 0.004]
""",
    "tuning": """
name = "tuned"
kind = "tuning"
scenario = "short.toml"
[tuning]
candidates = 3
[[strategy]]
name = "air cushion"
set = { "controller.strategy" = "air_cushion" }
[[strategy]]
name = "sliding mode"
set = { "controller.strategy" = "sliding_mode" }
[[load]]
name = "as it is"
""",
}

SCENARIO = """
name = "short"
duration_s = 0.4
initial_gear = "neutral"
[[request]]
at_s = 0.1
gear = "backward"
"""


@pytest.fixture
def sweep(tmp_path: Path) -> Path:
    (tmp_path / "short.toml").write_text(SCENARIO)
    (tmp_path / "sweep.toml").write_text(SWEEP)
    return tmp_path / "sweep.toml"


@pytest.fixture
def whole(sweep: Path, tmp_path: Path) -> bytes:
    folder = tmp_path / "whole"
    folder.mkdir()
    assert run_study(load_study(str(sweep)), folder) == 120
    return (folder / RESULTS).read_bytes()


def opc4(*arguments: str | Path, folder: Path) -> subprocess.Popen[bytes]:
    """The command in a process of its own."""
    return subprocess.Popen(
        [sys.executable, "-m", "sil.cli", *map(str, arguments)],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )


def lines_of(path: Path) -> int:
    return path.read_bytes().count(b"\n") if path.exists() else 0


def test_killed_and_resumed_no_row_is_lost_or_repeated(
    sweep: Path, whole: bytes, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    first = opc4("whatif", sweep, "--workers", "2", "--out", out, folder=tmp_path)
    deadline = time.monotonic() + 120.0
    while lines_of(out / RESULTS) <= 2 * 16:
        assert first.poll() is None and time.monotonic() < deadline
        time.sleep(0.01)
    workers = children(first.pid)
    first.send_signal(signal.SIGKILL)
    first.wait()
    assert 0 < lines_of(out / RESULTS) - 1 < 120
    assert len(workers) == 2
    deadline = time.monotonic() + 60.0
    while any(Path(f"/proc/{worker}").exists() for worker in workers):
        assert time.monotonic() < deadline, "workers outlive a killed sweep"
        time.sleep(0.1)
    again = opc4("whatif", sweep, "--workers", "2", "--resume", "--out", out, folder=tmp_path)
    assert again.wait() == 0
    assert (out / RESULTS).read_bytes() == whole


def children(pid: int) -> list[int]:
    return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


@contextlib.contextmanager
def cluster(folder: Path, workers: int) -> Iterator[str]:
    """A real scheduler and worker processes of one thread each; yields its address."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        address = f"tcp://127.0.0.1:{probe.getsockname()[1]}"
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    port = address.rsplit(":", 1)[1]
    dask = [sys.executable, "-m", "dask"]
    commands = [[*dask, "scheduler", "--host", "127.0.0.1", "--port", port, "--no-dashboard"]]
    commands += [
        [*dask, "worker", address, "--nworkers", "1", "--nthreads", "1", "--no-dashboard"]
    ] * workers
    running = []
    try:
        for number, command in enumerate(commands):
            with open(folder / f"dask-{number}.log", "wb") as log:
                running.append(
                    subprocess.Popen(command, env=environment, cwd=folder, stdout=log, stderr=log)
                )
        wait_for_workers(address, workers)
        yield address
    finally:
        for process in reversed(running):
            process.terminate()
        for process in running:
            process.wait(30)


def wait_for_workers(address: str, count: int) -> None:
    from distributed import Client

    with Client(address, timeout="60s", set_as_default=False) as client:
        client.wait_for_workers(count, timeout=60)


def test_a_cluster_of_two_worker_processes_gives_the_same_bytes(
    sweep: Path, whole: bytes, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    with cluster(tmp_path, workers=2) as address:
        done = opc4("whatif", sweep, "--cluster", address, "--out", out, folder=tmp_path)
        assert done.wait() == 0
        bad = tmp_path / "bad.toml"
        bad.write_text(SWEEP.replace('"valve.D_fall"', '"valve.D_fell"'))
        with pytest.raises(InputError, match=r"D_fell.*D_fall"):
            run_study(load_study(str(bad)), tmp_path, cluster=address)
        for kind, text in SPECIAL.items():
            path = tmp_path / f"{kind}.toml"
            path.write_text(text)
            here, there = tmp_path / f"{kind}_here", tmp_path / f"{kind}_there"
            for folder, where in ((here, None), (there, address)):
                folder.mkdir()
                assert run_study(load_study(str(path)), folder, cluster=where) >= 2
            assert (there / RESULTS).read_bytes() == (here / RESULTS).read_bytes()
    assert (out / RESULTS).read_bytes() == whole


def test_a_cluster_that_is_not_there_is_reported(sweep: Path, tmp_path: Path) -> None:
    with pytest.raises(RunError, match="cannot be reached"):
        run_study(load_study(str(sweep)), tmp_path, cluster="tcp://127.0.0.1:9")

"""Free-running on the local bus, and what ends a run early; only content and order are judged."""

from __future__ import annotations

import ast
import contextlib
import csv
import json
import os
import signal
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path

import can
import pytest

from can_dbc.contract import DBC_PATH
from can_dbc.e2e import PROTECTED
from can_dbc.messages import SafetyBlow, ValveCommand
from sil import cli
from sil.coupling.transports import address
from sil.log_replay.recorded_frames import OWN_IDS, RecordedFrames, counter_of
from sil.log_replay.replay import ReplayRequest, replay
from sil.logs import open_log
from sil.simulation.build import received
from sil.simulation.free_run import jitter
from tests.conftest import ROOT

FOREIGN = ROOT / "tests" / "foreign_controller" / "free_controller.py"
PATIENCE_S = 400.0
PACED = ("--realtime", "--no-report")
HELD_S = 0.01  # a tick: a step that comes later has read other frames than its recording shows
"""Nodes that stand still for longer than this have missed steps, as a real one would."""


@pytest.fixture
def local_bus(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, str]]:
    """The environment of processes that share a folder of sockets."""
    runtime = str(tmp_path_factory.mktemp("r"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_RUNTIME_DIR", runtime)
        yield {**os.environ, "PYTHONPATH": str(ROOT)}


def run(folder: Path, env: dict[str, str], *words: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "sil.cli", "run", *words, "--out", str(folder)]
    return subprocess.Popen(
        command, env=env, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def counters(log: Path) -> dict[type, list[int]]:
    """End-to-end counters of each protected message, in order."""
    found: dict[type, list[int]] = defaultdict(list)
    for arrival in RecordedFrames(open_log(log)):
        if arrival.kind in PROTECTED:
            found[arrival.kind].append(counter_of(arrival.frame))
    return found


def test_a_free_run_has_each_message_once_and_replays(
    tmp_path: Path, local_bus: dict[str, str]
) -> None:
    for attempt in range(5):
        folder = tmp_path / f"out{attempt}"
        with run(folder, local_bus, "full_shift", "--transport", "local:free", *PACED) as process:
            _, complaints = process.communicate(timeout=PATIENCE_S)
        assert process.returncode in (0, 1), complaints  # 1: a limit in time not met
        assert "each node by its own clock" in complaints and "p99" in complaints
        result = json.loads((folder / "result.json").read_text())
        assert result["complete"] and result["bus"]["mode"] == "free-running"
        if all((m["jitter_max_s"] or 1.0) < HELD_S for m in result["bus"]["messages"]):
            break
    else:
        pytest.skip("this machine is too busy for real time: nodes stood still in each run")
    log = folder / "bus.log"
    assert {f.can_id for f in open_log(log)} <= OWN_IDS.keys()  # nothing of a protocol
    for kind, seen in counters(log).items():
        steps = {(after - before) % 16 for before, after in pairwise(seen)}
        assert 0 not in steps, f"{kind.__name__} twice"
    found = replay(ReplayRequest(str(log)))
    assert found.comparison.engaged and found.comparison.ticks > 20
    for kind in (ValveCommand, SafetyBlow):
        signals = found.comparison.signals
        assert not any(s.differing for n, s in signals.items() if n.startswith(kind.__name__))


def test_other_traffic_runs_freely_too(tmp_path: Path, local_bus: dict[str, str]) -> None:
    words = ["lab_n_b", "--set", "bus.extra_load=0.2", "--transport", "local:free"]
    with run(tmp_path / "out", local_bus, *words, *PACED) as process:
        _, complaints = process.communicate(timeout=PATIENCE_S)
    assert process.returncode in (0, 1), complaints
    assert any(f.can_id not in OWN_IDS for f in open_log(tmp_path / "out" / "bus.log"))


def test_a_controller_of_python_can_and_cantools_shifts(
    tmp_path: Path, local_bus: dict[str, str]
) -> None:
    imported = {
        name.name if isinstance(node, ast.Import) else str(node.module)
        for node in ast.walk(ast.parse(FOREIGN.read_text()))
        if isinstance(node, ast.Import | ast.ImportFrom)
        for name in node.names
    }
    assert imported - sys.stdlib_module_names == {"can", "cantools"}
    assert len(FOREIGN.read_text().splitlines()) <= 100
    folder = tmp_path / "out"
    words = ("lab_n_b", "--transport", "local:free", "--external", "controller")
    with run(folder, local_bus, *words, *PACED) as process:
        while "free" not in address.running_channels():
            assert process.poll() is None, process.communicate()
        foreign = subprocess.Popen(
            [sys.executable, str(FOREIGN), DBC_PATH, "opc4local", "free", str(PATIENCE_S)],
            env=local_bus,
            cwd=tmp_path,
        )
        _, complaints = process.communicate(timeout=PATIENCE_S)
        assert foreign.wait(timeout=60.0) == 0  # it notices the end of the run
    result = json.loads((folder / "result.json").read_text())
    assert result["complete"], complaints
    checks = {check["name"]: check for check in result["expectations"]}
    assert checks["final gear"]["passed"] and checks["confirmed gear"]["passed"]
    assert result["metrics"]["shift_time_s"] > 0.0
    seen = {message["name"]: message["frames"] for message in result["bus"]["messages"]}
    assert seen["ControllerStatus"] > 10 and seen["Etc1"] == 0  # it sends no ETC1: it is not ours


def test_jitter_is_the_distance_from_the_period() -> None:
    ms = 1_000_000
    assert jitter([0], 10 * ms)["jitter_max_s"] is None
    found = jitter([0, 10 * ms, 21 * ms, 30 * ms], 10 * ms)
    assert found["jitter_p50_s"] == found["jitter_max_s"] == 0.001 and found["missing"] == 0
    found = jitter([0, 10 * ms, 40 * ms, 52 * ms], 10 * ms)
    assert found["missing"] == 2 and found["jitter_max_s"] == 0.002


def test_participants_receive_what_the_dbc_says() -> None:
    names = {OWN_IDS[can_id].__name__ for can_id in received()["controller"] if can_id in OWN_IDS}
    assert names == {"ShiftRequest", "PositionPulse", "DrivelineSpeeds"}
    names = {OWN_IDS[can_id].__name__ for can_id in received()["plant"] if can_id in OWN_IDS}
    assert names == {"ValveCommand", "SafetyBlow"}
    assert "traffic" not in received()


@pytest.mark.parametrize(
    ("name", "key"),
    [
        ("bus_off", "fault"),
        ("garbage_sensor", "sensor_fault"),
        ("charged_neutral", "plant.charged"),
    ],
)
def test_what_begins_at_an_instant_of_the_run_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str, key: str
) -> None:
    words = ["run", name, "--transport", "local:free", "--realtime"]
    assert cli.main([*words, "--out", str(tmp_path / "out")]) == 2
    complaints = capsys.readouterr().err
    assert complaints.count("\n") == 1 and f"{key}: of a lockstep run only" in complaints
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_a_free_run_on_an_interface_of_python_can(tmp_path: Path) -> None:
    channel = f"udp_multicast:239.74.163.{2 + os.getpid() % 200}"
    words = ["lab_n_b", "--transport", channel]
    with run(tmp_path / "out", dict(os.environ), *words, *PACED) as process:
        _, complaints = process.communicate(timeout=PATIENCE_S)
    result = json.loads((tmp_path / "out" / "result.json").read_text())
    assert result["complete"] and all(m["frames"] for m in result["bus"]["messages"]), complaints
    assert result["metrics"]["shift_time_s"] is not None


Run = Callable[..., subprocess.CompletedProcess[str]]
SLOWED = ("--transport", "local", "--speed", "0.4", "--json")


@contextlib.contextmanager
def running(folder: Path) -> Iterator[subprocess.Popen[str]]:
    """Start a slowed-down run over the local bus; yield it in mid-shift."""
    process = run(folder, {**os.environ, "PYTHONPATH": str(ROOT)}, "full_shift", *SLOWED)
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

"""The coupling on a real SocketCAN channel, with the usual tools next to it."""

from __future__ import annotations

import contextlib
import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import can
import pytest

from can_dbc.frame import EDP_BIT, SOCKETCAN_EXTENDED
from sil.coupling.transports.socketcan import CanSocket

pytestmark = pytest.mark.vcan

ROOT = Path(__file__).resolve().parents[2]
SCENARIO = "lab_n_b"
PATIENCE_S = 400.0
"""A cold start compiles the plant; the emulated kernel has one slow core."""
ONLY_THE_BUS = "vcan0,00000000:02000000"
"""candump's filter for frames with EDP clear: what the simulated bus delivered."""
FRAME = re.compile(r"\(\d+\.\d{6}\) \S+ ([0-9A-F]{8})#([0-9A-F]*)")

Frames = list[tuple[int, bytes]]
Run = Callable[..., subprocess.CompletedProcess[str]]


def frames_of(log: Path) -> Frames:
    """Identifier and data of each line of a candump log."""
    matches = [FRAME.fullmatch(line) for line in log.read_text().splitlines()]
    assert all(matches), "every line is of the form that candump -l writes"
    return [(int(m[1], 16), bytes.fromhex(m[2])) for m in matches if m]


@contextlib.contextmanager
def candump(log: Path, *options: str) -> Iterator[None]:
    """can-utils' candump, writing the bus of the meantime to `log`."""
    with open(log, "wb") as out, subprocess.Popen(["candump", "-L", *options], stdout=out) as dump:
        time.sleep(0.5)
        assert dump.poll() is None
        yield
        time.sleep(1.0)
        dump.terminate()


def result_of(done: subprocess.CompletedProcess[str]) -> dict[str, object]:
    assert done.returncode == 0, done.stderr
    found: dict[str, object] = json.loads(done.stdout)
    return found


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run over vcan0 in three processes: its folder, candump's view, and python-can's."""
    folder = tmp_path_factory.mktemp("recorded")
    command = [sys.executable, "-m", "sil.cli", "run", SCENARIO, "--transport", "vcan0"]
    with (
        candump(folder / "candump.log", ONLY_THE_BUS),
        can.Bus(
            interface="socketcan",
            channel="vcan0",
            can_filters=[{"can_id": 0, "can_mask": EDP_BIT, "extended": True}],
        ) as listener,
        can.CanutilsLogWriter(folder / "python_can.log") as writer,
    ):
        notifier = can.Notifier(listener, [writer])
        done = subprocess.run(
            [*command, "--json", "--no-report", "--out", "run"],
            cwd=folder,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
            capture_output=True,
            text=True,
            timeout=PATIENCE_S,
            check=False,
        )
        time.sleep(1.0)
        notifier.stop()
    assert result_of(done)["passed"] is True
    return folder


def test_candump_and_python_can_see_what_the_simulated_bus_delivered(recorded: Path) -> None:
    delivered = frames_of(recorded / "run" / "bus.log")
    assert len(delivered) > 500
    assert frames_of(recorded / "candump.log") == delivered
    with can.LogReader(recorded / "python_can.log") as reader:
        assert [(m.arbitration_id, bytes(m.data)) for m in reader] == delivered


def test_the_hash_is_that_of_one_process_and_of_the_local_bus(recorded: Path, opc4: Run) -> None:
    expected = json.loads((recorded / "run" / "result.json").read_text())["trace_sha256"]
    assert len(expected) == 64
    for transport in ("inproc", "local"):
        done = opc4(
            "run", SCENARIO, "--transport", transport, "--json", "--no-report", "--out", transport,
            timeout=PATIENCE_S,
        )  # fmt: skip
        assert result_of(done)["trace_sha256"] == expected


@pytest.mark.parametrize("speed", ["0.5", "2"])
def test_the_hash_is_the_same_at_every_speed(speed: str, recorded: Path, opc4: Run) -> None:
    expected = json.loads((recorded / "run" / "result.json").read_text())
    done = opc4(
        "run", SCENARIO, "--transport", "vcan0", "--speed", speed, "--json", "--no-report",
        "--out", "out", timeout=PATIENCE_S,
    )  # fmt: skip
    result = result_of(done)
    assert result["trace_sha256"] == expected["trace_sha256"]
    reported = result["speed"]
    assert isinstance(reported, dict)
    assert reported["loop_wall_s"] >= 0.95 * 0.7 / float(speed)
    assert reported["late_max_s"] >= reported["late_p99_s"] >= reported["late_p50_s"] >= 0.0


def test_canplayer_plays_our_log(recorded: Path, tmp_path: Path) -> None:
    with candump(tmp_path / "played.log", "vcan0"):
        subprocess.run(
            ["canplayer", "-t", "-I", recorded / "run" / "bus.log", "vcan0=opc4"], check=True
        )
    assert frames_of(tmp_path / "played.log") == frames_of(recorded / "run" / "bus.log")


def children_of(pid: int) -> list[int]:
    tasks = Path(f"/proc/{pid}/task").glob("*/children")
    return [int(child) for task in tasks for child in task.read_text().split()]


@pytest.mark.parametrize("name", ["plant", "controller"])
def test_kill_9_of_a_process_ends_the_run(name: str, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "sil.cli", "run", SCENARIO, "--transport", "vcan0"]
    options = ["--speed", "0.1", "--no-report", "--json", "--out", "out"]
    with subprocess.Popen(
        [*command, *options],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        log = tmp_path / "out" / "bus.log"
        began = time.monotonic()
        while not log.exists() or len(log.read_text().splitlines()) < 100:
            assert process.poll() is None and time.monotonic() - began < PATIENCE_S
            time.sleep(0.02)
        children = children_of(process.pid)
        victim = next(
            pid
            for pid in children
            if f"\0{name}\0".encode() in Path(f"/proc/{pid}/cmdline").read_bytes()
        )
        os.kill(victim, signal.SIGKILL)
        reported, complaints = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 3
    assert f"{name} was killed by SIGKILL (at 0." in complaints
    result = json.loads(reported)
    assert result["complete"] is False and name in result["why"]
    frames = frames_of(log)
    assert len(frames) >= 100
    assert not any(Path(f"/proc/{pid}").exists() for pid in children)


def test_a_burst_is_not_lost_on_the_way(tmp_path: Path) -> None:
    """5,000 frames written at once wait in a receive buffer that a default one is too small for."""
    from can_dbc.frame import Frame
    from sil.coupling.transports import wire

    receiver = CanSocket("vcan0", ((SOCKETCAN_EXTENDED, SOCKETCAN_EXTENDED),))
    sender = CanSocket("vcan0", ())
    try:
        for number in range(5000):
            sender.send(wire.real(Frame(number, number.to_bytes(8, "big"))))
        found = [receiver.receive() for _ in range(5000)]
        assert found == [(n, n.to_bytes(8, "big")) for n in range(5000)]
        assert receiver.receive() is None
    finally:
        sender.close()
        receiver.close()


def test_an_overrun_is_never_silent() -> None:
    import socket

    from can_dbc.errors import RunError
    from can_dbc.frame import Frame
    from sil.coupling.transports import wire

    receiver = CanSocket("vcan0", ((SOCKETCAN_EXTENDED, SOCKETCAN_EXTENDED),))
    sender = CanSocket("vcan0", ())
    try:
        raw = socket.socket(fileno=os.dup(receiver.fileno()))
        raw.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 10_000)
        raw.close()
        for number in range(1000):
            sender.send(wire.real(Frame(number, b"")))
        with pytest.raises(RunError, match="frames were lost, the receive buffer overflowed"):
            while receiver.receive() is not None:
                sender.send(wire.real(Frame(1, b"")))
                receiver.receive()
    finally:
        sender.close()
        receiver.close()

"""A controller in C, plain SocketCAN, takes part in the lockstep in place of ours."""

from __future__ import annotations

import contextlib
import json
import os
import re
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import can
import pytest

from can_dbc.c_header import header
from can_dbc.codec import can_id_of
from can_dbc.e2e import E2eStatus, Receiver
from can_dbc.frame import Frame
from can_dbc.messages import ControllerStatus, SafetyBlow, ValveCommand
from tests.conftest import ROOT

pytestmark = pytest.mark.vcan

HERE = Path(__file__).resolve().parents[1] / "foreign_controller"


PATIENCE_S = 400.0
"""A cold start compiles the plant; the emulated kernel has one slow core."""


@pytest.fixture(scope="module")
def hashes() -> set[str]:
    """The hashes of all shifts of this module."""
    return set()


@pytest.fixture(scope="module")
def controller(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The controller, built with the system's compiler without a warning."""
    folder = tmp_path_factory.mktemp("built")
    (folder / "contract.h").write_text(header())
    flags = ["-O2", "-Wall", "-Wextra", "-Werror", "-I", folder]
    program = folder / "controller"
    subprocess.run(["cc", *flags, "-o", program, HERE / "controller.c"], check=True)
    return program


@contextlib.contextmanager
def shift(folder: Path, out: str) -> Iterator[subprocess.Popen[str]]:
    """A run that waits for a controller from elsewhere."""
    command = [sys.executable, "-m", "sil.cli", "run", str(HERE / "shift.toml"), "--json"]
    options = ["--transport", "vcan0", "--external", "controller", "--no-report", "--out", out]
    with subprocess.Popen(
        [*command, *options],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        yield process
        process.kill()


@contextlib.contextmanager
def joined(controller: Path) -> Iterator[subprocess.Popen[bytes]]:
    """A controller in C on vcan0."""
    with subprocess.Popen([controller, "vcan0"]) as process:
        yield process
        process.kill()


@pytest.mark.parametrize("first", ["run", "controller"])
def test_the_shift_of_a_c_controller_completes(
    first: str, controller: Path, tmp_path: Path, hashes: set[str]
) -> None:
    """Whoever is there first waits for the other, and every run is the same bit by bit."""
    with contextlib.ExitStack() as running:
        if first == "controller":
            foreign = running.enter_context(joined(controller))
        coordinator = running.enter_context(shift(tmp_path, "out"))
        if first == "run":
            foreign = running.enter_context(joined(controller))
        reported, complaints = coordinator.communicate(timeout=PATIENCE_S)
        assert foreign.wait(5.0) == 0
    assert coordinator.returncode == 0, complaints + reported
    result = json.loads(reported)
    assert result["passed"] and result["complete"]
    assert result["metrics"]["shifts"][-1]["to_gear"] == "forward"
    assert result["metrics"]["shifts"][-1]["confirmed_s"] is not None
    hashes.add(result["trace_sha256"])
    assert len(hashes) == 1
    with can.LogReader(tmp_path / "out" / "bus.log") as log:
        frames = [(round(m.timestamp * 1e9), Frame(m.arbitration_id, bytes(m.data))) for m in log]
    for kind in (ValveCommand, SafetyBlow, ControllerStatus):
        receiver = Receiver(kind)
        statuses = [
            receiver.receive(arrival_ns, frame)
            for arrival_ns, frame in frames
            if frame.can_id == can_id_of(kind)
        ]
        assert statuses == [E2eStatus.INITIAL, *[E2eStatus.OK] * (len(statuses) - 1)]
        assert len(statuses) == 120


def test_a_second_one_is_refused_and_without_the_first_the_run_ends(
    controller: Path, tmp_path: Path
) -> None:
    with shift(tmp_path, "out") as coordinator:
        assert coordinator.stderr is not None
        while "waiting for controller" not in coordinator.stderr.readline():
            assert coordinator.poll() is None
        with joined(controller) as first:
            time.sleep(0.5)  # says Hello after 0.1 s
            second = subprocess.run(
                [controller, "vcan0"], capture_output=True, text=True, timeout=60, check=False
            )
            assert (second.returncode, second.stderr) == (2, "refused: reason 3\n")
            first.kill()
        reported, complaints = coordinator.communicate(timeout=PATIENCE_S)
    assert coordinator.returncode == 3
    assert "controller did not answer within 2 s: it stalled" in complaints
    assert json.loads(reported)["complete"] is False


def test_the_tutorial_s_own_program_joins(tmp_path: Path) -> None:
    """The commands of the tutorial's step, as they stand there."""
    tutorial = (ROOT / "docs" / "tutorial.md").read_text(encoding="utf-8")
    (block,) = re.findall(r"```bash\n(.*?)```", tutorial, re.DOTALL)
    (tmp_path / "tests").symlink_to(ROOT / "tests")
    programs = tmp_path / "bin"
    programs.mkdir()
    for name, arguments in (("python", ""), ("opc4", "-m sil.cli ")):
        (programs / name).write_text(f'#!/bin/sh\nexec "{sys.executable}" {arguments}"$@"\n')
        (programs / name).chmod(0o755)
    path = f"{programs}:{os.environ['PATH']}"
    done = subprocess.run(
        ["bash", "-eu", "-c", block],
        cwd=tmp_path,
        env={**os.environ, "PATH": path, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert json.loads((tmp_path / "foreign_shift" / "result.json").read_text())["passed"]

"""Effects and rules that end the process they run in."""

from __future__ import annotations

import json
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

COMMAND = "from sil.cli import command; command()"


def opc4(folder: Path, *words: str) -> subprocess.Popen[str]:
    """Start the command with own.py in the folder."""
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen([sys.executable, "-c", COMMAND, *words], cwd=folder, **pipes)  # type: ignore[call-overload,no-any-return]


@pytest.mark.parametrize(
    ("statement", "ends"),
    [
        ("import ctypes; ctypes.string_at(0)", "own.py:2: its process ended: killed by SIGSEGV"),
        ("import os; os.kill(os.getpid(), 9)", "own.py: its process ended: killed by SIGKILL"),
    ],
)
def test_a_crash_is_named(tmp_path: Path, statement: str, ends: str) -> None:
    (tmp_path / "own.py").write_text(f"\n{statement}\n")
    process = opc4(tmp_path, "run", "lab_n_b", "--effects", "own.py", "--json")
    output, errors = process.communicate(timeout=60)
    assert (process.returncode, errors) == (3, f"opc4 run: {ends}\n")
    assert json.loads(output) == {"error": ends, "exit_code": 3}


@pytest.mark.slow
def test_a_crash_in_a_worker_is_named(tmp_path: Path) -> None:
    (tmp_path / "own.py").write_text(
        "import ctypes\nfrom sil.rules import Rule\n"
        "RULES = [Rule('crash', 'It crashes.', 'us', lambda *_: ctypes.string_at(0))]\n"
    )
    words = ("swarm", "lab_n_b", "--rules", "own.py", "--runs", "2", "--workers", "2")
    process = opc4(tmp_path, *words, "--quiet", "--out", "swarm")
    _, errors = process.communicate(timeout=120)
    assert process.returncode == 3
    assert errors.startswith("opc4 swarm: a worker process died at own.py:3; swarm holds")


def test_an_interrupt_reaches_the_child(tmp_path: Path) -> None:
    (tmp_path / "own.py").write_text("import time\nprint('begun', flush=True)\ntime.sleep(60)\n")
    process = opc4(tmp_path, "swarm", "lab_n_b", "--runs", "2", "--rules", "own.py")
    assert process.stdout is not None and process.stdout.readline() == "begun\n"
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 130
    assert re.fullmatch(r"opc4 swarm: interrupted at own\.py:[23]\n", errors)


def test_a_second_interrupt_ends_code_that_does_not_answer(tmp_path: Path) -> None:
    (tmp_path / "own.py").write_text(
        "import signal\nsignal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])\n"
        "print('begun', flush=True)\nwhile True: pass\n"
    )
    process = opc4(tmp_path, "run", "lab_n_b", "--effects", "own.py")
    assert process.stdout is not None and process.stdout.readline() == "begun\n"
    for _ in range(2):
        process.send_signal(signal.SIGINT)
        time.sleep(0.3)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 130
    # on a busy machine the second one comes before the first has been answered
    assert errors in ("opc4 run: interrupted\n", "opc4: interrupted\n")

"""Child processes: watched, ended, and never left over."""

from __future__ import annotations

import os
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import pytest

from sil.coupling.processes import ChildProcess, sharing_one_core

ROOT = Path(__file__).resolve().parents[4]


def python(code: str) -> list[str]:
    return [sys.executable, "-c", textwrap.dedent(code)]


def is_gone(pid: int, within_s: float) -> bool:
    deadline = time.monotonic() + within_s
    while time.monotonic() < deadline:
        try:
            state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
        except FileNotFoundError:
            return True
        if state == "Z":
            return True
        time.sleep(0.01)
    return False


@pytest.mark.parametrize(
    ("code", "how"),
    [
        ("raise SystemExit(0)", "ended with exit status 0"),
        (
            "print('first'); print('why it ended', flush=True); raise SystemExit(3)",
            "ended with exit status 3: why it ended",
        ),
        ("import os, signal; os.kill(os.getpid(), signal.SIGKILL)", "was killed by SIGKILL"),
        ("import os; os.abort()", "was killed by SIGABRT"),
    ],
)
def test_how_a_child_ended_is_reported(code: str, how: str) -> None:
    child = ChildProcess("plant", python(code))
    assert child.how_it_ended(10.0) == how
    child.end(0.0)
    child.end(0.0)


def test_a_child_that_goes_on_is_killed_after_the_grace() -> None:
    child = ChildProcess("plant", python("import time; print('up', flush=True); time.sleep(600)"))
    while "up" not in child.output():
        assert child.how_it_ended(0.01) is None
    child.end(0.05)
    assert is_gone(child.pid, 60.0)


def test_what_cannot_be_started_is_named() -> None:
    child = ChildProcess("plant", ["/no-such-program"])
    expected = "ended with exit status 1: /no-such-program: No such file or directory"
    assert child.how_it_ended(10.0) == expected
    child.end(0.0)


def test_a_child_has_its_own_session_so_that_control_c_reaches_the_coordinator_alone() -> None:
    child = ChildProcess("plant", python("import os; print(os.getsid(0) == os.getpid())"))
    assert child.how_it_ended(10.0) == "ended with exit status 0: True"
    child.end(0.0)


PARENT = """
import os, sys, time
sys.path.insert(0, {root!r})
from sil.coupling.processes import ChildProcess
sleeper = "import time; print(1, flush=True); time.sleep(600)"
child = ChildProcess("plant", [sys.executable, "-c", sleeper])
while not child.output():
    time.sleep(0.01)
print(child.pid, flush=True)
time.sleep(600)
"""


def test_a_child_ends_when_its_parent_is_killed() -> None:
    code = PARENT.format(root=str(ROOT))
    parent = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    child_pid = int(parent.stdout.readline())
    assert not is_gone(child_pid, 0.1)
    parent.kill()
    parent.wait()
    parent.stdout.close()
    assert is_gone(child_pid, 60.0)


def test_a_child_whose_parent_is_gone_already_does_not_begin() -> None:
    from sil.coupling.processes import _TIED_TO_ITS_PARENT

    begun = subprocess.run(
        [sys.executable, "-c", _TIED_TO_ITS_PARENT, "4194304", "echo", "begun"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert (begun.returncode, begun.stdout) == (1, "")
    assert begun.stderr == "the process that started this one has ended\n"


def test_a_core_is_shared_as_long_as_the_block_lasts() -> None:
    before = os.sched_getaffinity(0)
    child = ChildProcess("plant", python("import time; time.sleep(600)"))
    with sharing_one_core([child.pid]) as core:
        inside = [os.sched_getaffinity(pid) for pid in (0, child.pid)]
    assert os.sched_getaffinity(0) == before
    assert (inside == [{core}] * 2) if len(before) > 1 else (core is None)
    child.end(0.0)
    with sharing_one_core([child.pid]) as core:
        assert core is None, "a process that is gone is nobody to share with"
    assert os.sched_getaffinity(0) == before

"""Participants as processes: joined, watched, ended, and never left over."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import textwrap
import threading
import time
from collections.abc import Sequence
from pathlib import Path

import pytest

from can_dbc.errors import InputError, RunError
from can_dbc.frame import Frame
from sil.coupling.processes import ChildProcess, sharing_one_core
from sil.coupling.transports.hub import Hub
from sil.coupling.transports.link import LocalLink, open_link, take_part

ROOT = Path(__file__).resolve().parents[4]


@pytest.fixture(autouse=True)
def _runtime(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path_factory.mktemp("r")))


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


class Counter:
    """Speaks every millisecond; fails at `fails_at`."""

    name = "controller"

    def __init__(self, fails_at: int = 1 << 60) -> None:
        self.instants: list[int] = []
        self.closed = 0
        self._fails_at = fails_at

    def start(self) -> int:
        return 0

    def advance(
        self, until_ns: int, deliveries: Sequence[tuple[int, Frame]]
    ) -> tuple[list[tuple[int, Frame]], int]:
        self.instants.append(until_ns)
        if until_ns >= self._fails_at:
            raise ZeroDivisionError
        return [], until_ns + 1_000_000

    def close(self) -> None:
        self.closed += 1


class Running:
    """`take_part` in a thread, its outcome kept."""

    def __init__(self, participant: Counter, channel: str) -> None:
        self.error: BaseException | None = None
        self._participant = participant
        self._channel = channel
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        try:
            take_part(self._participant, open_link(self._channel, 5.0), start_timeout_s=5.0)
        except Exception as error:
            self.error = error

    def outcome(self) -> BaseException | None:
        self._thread.join(10.0)
        assert not self._thread.is_alive()
        return self.error


def test_a_participant_takes_part_from_hello_to_stop() -> None:
    counter = Counter()
    running = Running(counter, "local:run")
    hub = Hub("run", ["controller"])
    assert hub.start(10**9) == {"controller": 0}
    for now_ns in range(0, 5_000_000, 1_000_000):
        hub.begin_turn(now_ns, ["controller"])
        assert hub.end_turn()["controller"] == ([], now_ns + 1_000_000)
    hub.close(aborted=False)
    assert running.outcome() is None
    assert counter.instants == list(range(0, 5_000_000, 1_000_000))
    assert counter.closed == 1


def test_a_participant_that_fails_says_so_and_raises_its_own_error() -> None:
    counter = Counter(fails_at=1_000_000)
    running = Running(counter, "local:run")
    hub = Hub("run", ["controller"])
    hub.start(10**9)
    hub.begin_turn(0, ["controller"])
    hub.end_turn()
    hub.begin_turn(1_000_000, ["controller"])
    with pytest.raises(RunError, match="controller failed; its own error output says why"):
        hub.end_turn()
    hub.close(aborted=True)
    assert isinstance(running.outcome(), ZeroDivisionError)
    assert counter.closed == 1


def test_an_early_end_and_a_lost_coordinator_are_errors_of_the_run() -> None:
    for aborted, message in ((True, "ended the run early"), (False, "the coordinator is gone")):
        counter = Counter()
        running = Running(counter, "local:run")
        hub = Hub("run", ["controller"])
        hub.start(10**9)
        if aborted:
            hub.close(aborted=True)
        else:  # as if the coordinator had been killed: no farewell
            for connection in hub._connections.values():
                connection.socket.shutdown(socket.SHUT_RDWR)
        error = running.outcome()
        assert isinstance(error, RunError) and message in str(error)
        assert counter.closed == 1
        hub.close(aborted=True)


def test_channels_are_local_names_or_can_interfaces() -> None:
    for nameless in ("local:", "local"):
        with pytest.raises(InputError, match="expected a name of letters"):
            open_link(nameless)
    with pytest.raises(RunError, match=r"no run on local:nobody within 0.05 s"):
        open_link("local:nobody", 0.05)
    with pytest.raises(InputError, match=r"channel 'nocan7': .*expected .*local:NAME, or the name"):
        open_link("nocan7")


def test_a_link_waits_for_its_hub() -> None:
    hubs: list[Hub] = []
    opener = threading.Timer(0.2, lambda: hubs.append(Hub("late", ["plant"])))
    opener.start()
    link = open_link("local:late", 5.0)
    assert isinstance(link, LocalLink)
    opener.join()
    link.close()
    hubs[0].close(aborted=True)


def test_signals_have_names() -> None:
    child = ChildProcess("plant", python("import time; time.sleep(600)"))
    os.kill(child.pid, signal.SIGTERM)
    assert child.how_it_ended(10.0) == "was killed by SIGTERM"
    child.end(0.0)

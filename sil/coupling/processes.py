"""Participants as child processes, which never outlive the coordinator."""

from __future__ import annotations

import contextlib
import ctypes
import os
import select
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence

from can_dbc.errors import RunError

_TIED_TO_ITS_PARENT = """
import ctypes, os, sys
libc, parent = ctypes.CDLL(None), int(sys.argv[1])
if libc.prctl(1, 9, 0, 0, 0) or os.getppid() != parent:  # PR_SET_PDEATHSIG, SIGKILL
    sys.exit("the process that started this one has ended")
try:
    os.execvp(sys.argv[2], sys.argv[2:])
except OSError as error:
    sys.exit(f"{sys.argv[2]}: {error.strerror}")
"""


class ChildProcess:
    """One participant in a process of its own, which never outlives the thread that started it.

    It is in a session of its own: an interrupt typed at the terminal reaches the coordinator alone,
    which ends its children. The last line that the child prints is the reason when it ends early.
    """

    def __init__(self, name: str, command: Sequence[str]) -> None:
        """Start `command`.  Raises RunError when this machine starts no more processes."""
        self.name = name
        self.printed: list[str] = []
        """After its end: the lines that the participant's own program printed."""
        self._output = tempfile.TemporaryFile()  # noqa: SIM115 - lives as long as the child
        try:
            self._process = subprocess.Popen(
                [sys.executable, "-I", "-S", "-c", _TIED_TO_ITS_PARENT, str(os.getpid()), *command],
                stdin=subprocess.DEVNULL,
                stdout=self._output,
                stderr=self._output,
                start_new_session=True,
            )
        except OSError as error:
            self._output.close()
            raise RunError(f"{name} could not be started: {error}") from None
        self.pid = self._process.pid
        self._pidfd = os.pidfd_open(self.pid)

    def fileno(self) -> int:
        """Return a descriptor that becomes readable when the process has ended."""
        return self._pidfd

    def output(self) -> str:
        """Return what the child has printed so far."""
        length = os.fstat(self._output.fileno()).st_size
        return os.pread(self._output.fileno(), length, 0).decode(errors="replace")

    def how_it_ended(self, wait_s: float = 0.5) -> str | None:
        """Return "was killed by SIGKILL" or the like, or None when it runs on for `wait_s`."""
        if not self._has_ended(wait_s):
            return None
        status = self._process.wait()
        if status < 0:
            return f"was killed by {signal.Signals(-status).name}"
        last = next((line for line in reversed(self.output().splitlines()) if line.strip()), "")
        return f"ended with exit status {status}" + (f": {last.strip()}" if last else "")

    def end(self, grace_s: float) -> None:
        """Wait `grace_s` for the process to end, then kill it; reap it and close everything."""
        if self._output.closed:
            return
        if not self._has_ended(grace_s):
            self._process.kill()
        self._process.wait()
        self.printed = [x for x in self.output().splitlines() if not x.startswith("opc4 node")]
        os.close(self._pidfd)
        self._output.close()

    def _has_ended(self, wait_s: float) -> bool:
        poll = select.poll()
        poll.register(self._pidfd, select.POLLIN)
        return bool(poll.poll(wait_s * 1000.0))


@contextlib.contextmanager
def sharing_one_core(pids: Sequence[int]) -> Iterator[int | None]:
    """Keep the calling thread and these processes on one core; yield its number.

    Processes in lockstep run one at a time, and to wake another core takes several times as long as
    to pass a turn on the same one.  Yields None if there is only one core or affinity may not be set.
    """
    allowed = os.sched_getaffinity(0)
    core: int = ctypes.CDLL(None).sched_getcpu()
    try:
        is_free = len(allowed) > 1 and core in allowed
        try:
            if is_free:
                for pid in (0, *pids):
                    os.sched_setaffinity(pid, {core})
        except (PermissionError, ProcessLookupError):  # one is not ours, or has ended
            is_free = False
        yield core if is_free else None
    finally:
        os.sched_setaffinity(0, allowed)

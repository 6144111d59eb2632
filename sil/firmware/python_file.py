"""A user's own firmware in place of ours: a class in a Python file, run in a process of its own.

The class is made with the scenario's firmware settings and has `step(now_ns, inputs) -> outputs`,
as `controller.firmware.Firmware` has; frames, end-to-end protection and timing are those of the
controller node, which runs in that process too. Whatever the file does (an exception, `sys.exit`,
`os._exit`, an endless loop, a crash) ends the run and not the program that runs it; what it prints
goes to standard error. Wall time ends a run that hangs; it decides nothing else.
"""

from __future__ import annotations

import atexit
import contextlib
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from multiprocessing.connection import Pipe
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from can_dbc.errors import InputError
from can_dbc.frame import Frame
from sil.coupling.transports.channel import ParticipantLost, Received, Turn

if TYPE_CHECKING:
    from controller.config import FirmwareConfig

LOAD_S, STEP_S = 60.0, 5.0
"""Wall time in s that loading the file with `__init__`, and one step, may take."""

_STACK_S = 1.0
_SERVER = Path(__file__).with_name("python_process.py")


class OwnController:
    """The controller with a firmware from FILE.py, FILE.py:CLASS or the folder of a checkout; a participant.

    Raises InputError naming file, line and what is wrong with a file that cannot be loaded, and
    ParticipantLost (also from `advance`) when its code ends the process or hangs.
    """

    def __init__(self, where: str, config: FirmwareConfig, name: str = "controller") -> None:
        self.name = name
        file, _, class_name = where.partition(":")
        if file.encode(errors="ignore").decode() != file:
            raise InputError(f"firmware: {file}: its name is not UTF-8; expected one that is")
        self._path = Path(file)
        if self._path.is_dir():
            if not (self._path / "controller" / "node.py").is_file():
                what = "is a folder; expected FILE.py, FILE.py:CLASS, or a checkout"
                raise InputError(f"firmware: {file}: {what}")
        elif self._path.suffix != ".py" or not self._path.is_file():
            what = "no firmware" if self._path.exists() else "no such file"
            expected = "FILE.py, FILE.py:CLASS, FILE.c or FILE.wasm"
            raise InputError(f"firmware: {file}: {what}; expected {expected}")
        self._server: _Server | None = _take_server()
        settings = msgspec.to_builtins(config)
        try:
            self._ask(["load", file, class_name or "Firmware", settings, sys.path], LOAD_S)
        except ParticipantLost as lost:
            raise lost.at(0.0) from None

    def start(self) -> int:
        """Return the time of the first tick, ns."""
        return 0

    def advance(self, until_ns: int, deliveries: Received) -> Turn:
        """Advance the controller. Raises ParticipantLost with file, line and error when the firmware fails."""
        heard = [(at_ns, frame.can_id, frame.data) for at_ns, frame in deliveries]
        released, next_ns = self._ask(["advance", until_ns, heard], STEP_S)
        return [(at_ns, Frame(can_id, data)) for at_ns, can_id, data in released], next_ns

    def close(self) -> None:
        """End the firmware's process."""
        server, self._server = self._server, None
        if server is not None:
            with contextlib.suppress(OSError, EOFError):
                server.connection.send_bytes(b"")
                if server.connection.poll(_STACK_S) and _decoded(server)[0] == "ended":
                    _idle.append(server)
                    return
            server.kill()

    def _ask(self, message: list[Any], limit_s: float) -> Any:
        """Return the answer of the firmware's process; end the process unless it is a good one."""
        server = self._server
        if server is None:
            raise ParticipantLost(self.name, f"failed: {self._path}: its process has ended")
        try:
            server.connection.send_bytes(msgspec.msgpack.encode(message))
            if not server.connection.poll(limit_s):
                server.ask_for_stack(signal.SIGUSR1)
                what = f"no answer within {limit_s:g} s: it hangs"
                raise ParticipantLost(self.name, f"failed: {self._place()}: {what}")
            kind, content = _decoded(server)
            if kind == "answer":
                return content
            if kind == "refused":
                prefix = "" if self.name == "controller" else f"{self.name}: "
                raise InputError(f"{prefix}{content}")
            if kind == "ended":
                how = f"exit({content})"
                if content < 0:
                    how = f"killed by {signal.Signals(-content).name}"
                content = f"{self._place()}: its process ended: {how}"
            raise ParticipantLost(self.name, f"failed: {content}")
        except BaseException as error:
            server.kill()
            self._server = None
            if isinstance(error, OSError | EOFError):
                what = f"failed: {self._path}: its process was killed"
                raise ParticipantLost(self.name, what) from None
            raise

    def _place(self) -> str:
        """Return FILE:LINE of the innermost call of the user's file on the stack that was written."""
        assert self._server is not None
        name = str(self._path).encode("ascii", "backslashreplace").decode()
        match = re.search(rf'File "{re.escape(name)}", line (\d+)', self._server.stack())
        return f"{self._path}:{match[1]}" if match else str(self._path)


class _Server:
    """A process that has loaded the controller, and forks one process for each firmware."""

    def __init__(self) -> None:
        self.owner = os.getpid()
        self.connection, theirs = Pipe()
        self._stack = tempfile.TemporaryFile()  # noqa: SIM115 - lives as long as the process
        code = (
            f"import sys; sys.path[:] = {sys.path!r};"
            f"import runpy; runpy.run_path({str(_SERVER)!r}, run_name='__main__')"
        )
        handed = (theirs.fileno(), self._stack.fileno())
        self._process = subprocess.Popen(
            [sys.executable, "-u", "-c", code, *map(str, (*handed, self.owner))],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL if sys.__stderr__ is None else 2,
            pass_fds=handed,
            start_new_session=True,  # an interrupt typed at the terminal is not for the firmware
        )
        theirs.close()

    @property
    def is_alive(self) -> bool:
        """Whether the process runs, and this process started it."""
        return self.owner == os.getpid() and self._process.poll() is None

    def ask_for_stack(self, number: signal.Signals) -> None:
        """Let the firmware's process write its stack, wherever it is."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._process.pid, number)
        until = time.monotonic() + _STACK_S
        while _SERVER.name not in self.stack() and time.monotonic() < until:
            time.sleep(0.01)

    def stack(self) -> str:
        """Return the stacks written so far."""
        size = os.fstat(self._stack.fileno()).st_size
        return os.pread(self._stack.fileno(), size, 0).decode(errors="replace")

    def kill(self) -> None:
        """End the process; the one it forked ends with it."""
        self._process.kill()
        self._process.wait()
        self.connection.close()
        self._stack.close()


_idle: list[_Server] = []


@atexit.register
def _end_idle() -> None:
    for server in _idle:
        if server.owner == os.getpid():
            server.kill()


def _take_server() -> _Server:
    """Return a server that no firmware uses: of a study's many runs only the first starts one."""
    for server in [server for server in _idle if server.owner == os.getpid()]:
        _idle.remove(server)
        if server.is_alive:
            return server
        server.kill()  # it died while idle: its files are closed
    return _Server()


def _decoded(server: _Server) -> Any:
    return msgspec.msgpack.decode(server.connection.recv_bytes())

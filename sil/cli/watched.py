"""A command whose process a user's Python may end: a child does the work, this one says how it ended."""

from __future__ import annotations

import ctypes
import faulthandler
import json
import os
import re
import signal
import sys
import tempfile
import traceback
from collections.abc import Iterator
from types import FrameType
from typing import Any

from can_dbc.user_file import crash_places, resolved
from sil.cli import ENDING_SIGNALS, NOT_FINISHED

_files: list[str] = []


def go_on_in_child(file: str) -> None:
    """Return in a forked process before a user's file runs there for the first time; wait for it here."""
    _files.append(file)
    if len(_files) > 1:
        return
    stacks = tempfile.TemporaryFile()  # noqa: SIM115 - lives as long as the process
    sys.stdout.flush()
    handlers = {number: signal.getsignal(number) for number in ENDING_SIGNALS}
    # one that arrives now waits until it is known who answers it
    signal.pthread_sigmask(signal.SIG_BLOCK, ENDING_SIGNALS)
    child = os.fork()
    if child:
        _wait(child, file, stacks)
    os.setpgid(0, 0)  # an interrupt typed at the terminal comes from the parent, once
    ctypes.CDLL(None).prctl(1, signal.SIGKILL, 0, 0, 0)  # PR_SET_PDEATHSIG: ends with the parent
    for number, handler in handlers.items():
        signal.signal(number, handler)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, ENDING_SIGNALS)
    faulthandler.enable(stacks, all_threads=False)
    crash_places.append(lambda: _place(stacks))


def _wait(child: int, file: str, stacks: Any) -> None:
    """End this process as the child ended, with a line where a signal of its own killed that."""
    interrupts: list[int] = []

    def interrupt(number: int, _frame: object) -> None:
        """Interrupt the child; end it where it is in compiled code and does not answer."""
        os.kill(child, signal.SIGKILL if interrupts else number)
        interrupts.append(number)

    for number in ENDING_SIGNALS:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, interrupt)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, ENDING_SIGNALS)
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    if code == -signal.SIGKILL and len(interrupts) > 1:
        os.write(2, f"opc4 {sys.argv[1]}: interrupted\n".encode())
        code = 128 + interrupts[0]
    elif code < 0:
        where = _place(stacks) or file
        why = f"{where}: its process ended: killed by {signal.Signals(-code).name}"
        os.write(2, f"opc4 {sys.argv[1]}: {why}\n".encode(errors="replace"))
        if "--json" in sys.argv:
            os.write(1, f"{json.dumps({'error': why, 'exit_code': NOT_FINISHED})}\n".encode())
        code = NOT_FINISHED
    os._exit(code)


def places(frame: FrameType | None) -> Iterator[str]:
    """Yield FILE:LINE of each call of a user's file, innermost first."""
    for caller, line in traceback.walk_stack(frame):
        yield from _user_places(caller.f_code.co_filename, line)


def _place(stacks: Any) -> str:
    """Return FILE:LINE of the innermost call of a user's file, on the first stack that was written."""
    stack = os.pread(stacks.fileno(), 1 << 16, 0).decode(errors="replace")
    calls = re.findall(r'File "([^<"][^"]*)", line (\d+)', stack)
    return next((place for call in calls for place in _user_places(*call)), "")


def _user_places(name: str, line: str | int) -> list[str]:
    return [f"{file}:{line}" for file in _files if resolved(name) == resolved(file)]

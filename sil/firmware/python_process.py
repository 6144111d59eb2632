"""The process that runs a user's firmware: forks for each one, and says how it ended.

Started by `sil.firmware.python_file` with a connection, a file for stacks, and its parent's number.
Takes a firmware to load, then turns, then an empty message. Answers ("answer", value), or
("refused" or "failed", a line), or ("ended", exit status) from the process that forked.
"""

from __future__ import annotations

import ctypes
import faulthandler
import importlib
import importlib.util
import os
import signal
import sys
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import msgspec
import numpy as np  # noqa: F401 - most firmware needs it: loaded once, before the forks

from can_dbc.frame import Frame
from can_dbc.user_file import error_text, exits_raise
from controller.config import FirmwareConfig
from controller.firmware import Inputs, Outputs
from controller.node import ControllerNode, Steps


class _Checked:
    """A firmware whose outputs are what the node expects. `step` raises TypeError for others."""

    def __init__(self, firmware: Steps) -> None:
        self._firmware = firmware

    def step(self, now_ns: int, inputs: Inputs) -> Outputs:
        outputs = self._firmware.step(now_ns, inputs)
        if not isinstance(outputs, Outputs):
            kind = type(outputs).__name__
            raise TypeError(f"step returned {kind}; expected controller.firmware.Outputs")
        return outputs


def serve(connection: Connection, stacks: int) -> None:
    """Fork a process for each firmware, wait until it ends, and report how it ended."""
    while True:
        try:
            message = connection.recv_bytes()
        except EOFError:
            return
        parent = os.getpid()
        child = os.fork()
        if child == 0:
            _end_with(parent)
            faulthandler.enable(stacks, all_threads=False)
            faulthandler.register(signal.SIGUSR1, stacks, all_threads=False)
            with exits_raise():
                _run(connection, msgspec.msgpack.decode(message))
            os._exit(0)
        status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        try:
            connection.send_bytes(_packed("ended", status))
        except OSError:  # nobody asks any more
            return


def _run(connection: Connection, load: list[Any]) -> None:
    """Load a firmware and take turns until an empty message."""
    _, file, class_name, settings, search_path = load
    sys.path[:] = search_path
    path = Path(file)
    line, kind = 1, "refused"
    try:
        try:
            if path.is_dir():
                node = _of_checkout(path, settings)
            else:
                firmware = _load(path, class_name, settings)
                line = getattr(getattr(firmware.step, "__code__", None), "co_firstlineno", line)
                node = ControllerNode(msgspec.convert(settings, FirmwareConfig), _Checked(firmware))
            kind = "failed"
            connection.send_bytes(_packed("answer", 0))
            while message := connection.recv_bytes():
                _, until_ns, heard = msgspec.msgpack.decode(message)
                deliveries = [(at_ns, Frame(can_id, data)) for at_ns, can_id, data in heard]
                released, next_ns = node.advance(until_ns, deliveries)
                frames = [(at_ns, frame.can_id, frame.data) for at_ns, frame in released]
                connection.send_bytes(_packed("answer", (frames, next_ns)))
        except EOFError:
            pass
        except BaseException as error:
            # sys.exit, os._exit: the control unit is dead, not wrong
            kind = kind if isinstance(error, Exception) else "failed"
            connection.send_bytes(_packed(kind, error_text(path, line, error)))
    except OSError:
        pass


def _load(path: Path, class_name: str, settings: Any) -> Steps:
    spec = importlib.util.spec_from_file_location(f"opc4_own_{path.stem}", path)
    assert spec is not None and spec.loader is not None  # the name ends in .py
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses of the file look their module up
    spec.loader.exec_module(module)
    firmware_class = getattr(module, class_name, None)
    if not isinstance(firmware_class, type) or not callable(getattr(firmware_class, "step", None)):
        raise LookupError(f"no class {class_name!r} with a method 'step'; expected one")
    firmware: Steps = firmware_class(msgspec.convert(settings, FirmwareConfig))
    return firmware


def _of_checkout(folder: Path, settings: Any) -> ControllerNode:
    """Return the node of a checkout, made of its own packages in place of ours."""
    for name in list(sys.modules):
        if name.partition(".")[0] in ("can_dbc", "controller"):
            del sys.modules[name]
    sys.path.insert(0, str(folder))
    sys.dont_write_bytecode = True
    config, node = (importlib.import_module(f"controller.{name}") for name in ("config", "node"))
    controller: ControllerNode = node.ControllerNode(config.load_config(settings, "settings"))
    return controller


def _end_with(parent: int) -> None:
    """Let the kernel end this process with its parent, however that ends."""
    # PR_SET_PDEATHSIG: the parent's end kills this process, too
    ctypes.CDLL(None).prctl(1, signal.SIGKILL, 0, 0, 0)
    if os.getppid() != parent:
        sys.exit()


def _packed(kind: str, value: Any) -> bytes:
    return msgspec.msgpack.encode((kind, value))


if __name__ == "__main__":
    _connection, _stacks, _parent = map(int, sys.argv[1:])
    _end_with(_parent)
    signal.signal(signal.SIGUSR1, signal.SIG_IGN)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    serve(Connection(_connection), _stacks)

"""The control unit under replay: this very code, or the one of another checkout in a process."""

from __future__ import annotations

import contextlib
import json
import struct
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import IO, Protocol

import msgspec

from can_dbc.errors import InputError, RunError
from can_dbc.frame import Frame
from controller.config import FirmwareConfig
from sil.coupling.clock import to_seconds
from sil.coupling.transports.channel import ParticipantLost
from sil.coupling.transports.inproc import Participant

_HEAD = struct.Struct("<qH")
_FRAME = struct.Struct("<qIB")


class FirmwareUnderTest(Protocol):
    """A control unit that is given its inputs and ticks; times in ns from its first tick on."""

    def step(self, tick_ns: int, deliveries: Sequence[tuple[int, Frame]]) -> list[Frame]:
        """Run the tick with what arrived since the one before; return the frames released."""

    def restart(self) -> None:
        """Begin anew, as after switching on; times go on."""

    def close(self) -> None:
        """Release what is held."""


class OwnFirmware:
    """The firmware of this code, or the user's own in a Python file (`FILE.py:CLASS`).

    Raises InputError for a file that holds none, RunError when its step fails.
    """

    def __init__(self, config: FirmwareConfig, program: str = "") -> None:
        self._config = config
        self._program = program
        self._node: Participant | None = None
        self.restart()

    def restart(self) -> None:
        """See `FirmwareUnderTest`."""
        self.close()
        if self._program:
            from sil.nodes.own_firmware import OwnController

            self._node = OwnController(self._program, self._config)
        else:
            from controller.node import ControllerNode

            self._node = ControllerNode(self._config)
        self._base_ns: int | None = None

    def step(self, tick_ns: int, deliveries: Sequence[tuple[int, Frame]]) -> list[Frame]:
        """See `FirmwareUnderTest`."""
        if self._base_ns is None:
            self._base_ns = tick_ns
        base_ns = self._base_ns
        since = [(max(t - base_ns, 0), frame) for t, frame in deliveries]
        assert self._node is not None
        try:
            released, _ = self._node.advance(tick_ns - base_ns, since)
        except ParticipantLost as lost:
            raise lost.at(to_seconds(tick_ns)) from None
        return [frame for _, frame in released]

    def close(self) -> None:
        """See `FirmwareUnderTest`."""
        if self._node is not None:
            self._node.close()
            self._node = None


class CheckoutFirmware:
    """The firmware of another checkout, run by a process of this Python over two pipes.

    Raises InputError when its controller cannot be started with these settings, RunError when it
    ends early.
    """

    def __init__(self, checkout: Path, config: FirmwareConfig, name: str) -> None:
        self._name = name
        server = Path(__file__).with_name("firmware_process.py")
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-B", str(server), str(checkout)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            cwd=checkout,
        )
        settings = json.dumps(msgspec.to_builtins(config)).encode() + b"\n"
        answer = b""
        with contextlib.suppress(BrokenPipeError):
            self._write(settings)
            answer = self._out.readline()
        if answer != b"ready\n":
            reason = self._last_words()
            raise InputError(
                f"{name}: its controller cannot be used: {reason}; expected one that can"
            )

    @property
    def _out(self) -> IO[bytes]:
        assert self._process.stdout is not None
        return self._process.stdout

    def _write(self, block: bytes) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(block)
        self._process.stdin.flush()

    def restart(self) -> None:
        """See `FirmwareUnderTest`."""
        self._send(_HEAD.pack(-1, 0))

    def step(self, tick_ns: int, deliveries: Sequence[tuple[int, Frame]]) -> list[Frame]:
        """See `FirmwareUnderTest`. Raises RunError."""
        self._send(_HEAD.pack(tick_ns, len(deliveries)) + b"".join(map(_packed, deliveries)))
        _, count = _HEAD.unpack(self._read(_HEAD.size))
        found = []
        for _ in range(count):
            _, can_id, length = _FRAME.unpack(self._read(_FRAME.size))
            found.append(Frame(can_id, self._read(length)))
        return found

    def _send(self, block: bytes) -> None:
        try:
            self._write(block)
        except BrokenPipeError:
            raise RunError(f"{self._name}: its firmware ended: {self._last_words()}") from None

    def _read(self, size: int) -> bytes:
        block = self._out.read(size)
        if len(block) < size:
            raise RunError(f"{self._name}: its firmware ended: {self._last_words()}")
        return block

    def _last_words(self) -> str:
        self._process.kill()
        assert self._process.stderr is not None
        lines = self._process.stderr.read().decode(errors="replace").strip().splitlines()
        self.close()
        return lines[-1][:300] if lines else "without a word"

    def close(self) -> None:
        """End the process."""
        self._process.kill()
        self._process.wait()
        for pipe in (self._process.stdin, self._process.stdout, self._process.stderr):
            if pipe is not None:
                with contextlib.suppress(BrokenPipeError):
                    pipe.close()


def _packed(delivery: tuple[int, Frame]) -> bytes:
    time_ns, (can_id, data) = delivery
    return _FRAME.pack(time_ns, can_id, len(data)) + data

"""What is recorded while a run goes on: frames, trace and events, on disk after each step."""

from __future__ import annotations

import hashlib
import json
import struct
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Self

import numpy as np
from numpy.typing import NDArray

from can_dbc.frame import Frame
from sil.recording.run_record import STORED

if TYPE_CHECKING:
    from sil.coupling.bus import BusFrame

BUS_LOG, BUS_FRAMES = "bus.log", "bus.frames"
PLANT_TRACE, EVENTS = "plant.trace", "events.jsonl"
CLOCK_ZERO = "plant.zero"
"""File next to the plant's trace: the instant, ns since 1970, at which its clock is zero."""
TRACE_FORMAT = "opc4-trace-1"
_HASHED_FRAME = struct.Struct("<QIB")


class AppendedFile:
    """A new file to which blocks are appended; use as a context manager, or close it.

    When `append` returns, the operating system has the block: it survives the death of the process.
    """

    def __init__(self, path: Path) -> None:
        """Create the file, or empty an existing one."""
        self._path = path
        self._file = open(path, "wb", buffering=0)  # noqa: SIM115 - closed by close
        self.close = self._file.close

    def append(self, block: bytes) -> None:
        """Write a block.  Raises OSError naming the file."""
        left = memoryview(block)
        while left:
            try:
                left = left[self._file.write(left) :]
            except OSError as error:
                raise OSError(error.errno, error.strerror, str(self._path)) from None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


class BusLog(AppendedFile):
    """The delivered frames as a log of the form `candump -l` writes, and their hash.

    A line is `(0000000001.234567) opc4 0CFF2503#0011223344556677`, the arrival in simulated time.
    Microseconds are what canplayer reads; at 125 kbit/s to 1 Mbit/s, with releases on whole
    microseconds, they are exact.  An arrival between two microseconds is written with nine digits,
    which canplayer refuses: no time is rounded.
    """

    def __init__(self, path: Path) -> None:
        """Create the file."""
        super().__init__(path)
        self._hash = hashlib.sha256()
        self.frames = 0

    def record(self, deliveries: Sequence[BusFrame]) -> None:
        """Append the frames delivered in one step."""
        lines = []
        for delivery in deliveries:
            arrival_ns, frame = delivery.arrival_ns, delivery.frame
            self._hash.update(hashed_frame(arrival_ns, frame))
            seconds, nanoseconds = divmod(arrival_ns, 1_000_000_000)
            time = f"{seconds:010d}.{nanoseconds:09d}".removesuffix("000")
            lines.append(f"({time}) opc4 {frame.can_id:08X}#{frame.data.hex().upper()}\n")
        self.frames += len(lines)
        self.append("".join(lines).encode())

    def digest(self) -> bytes:
        """Return the SHA-256 over arrival (ns), identifier, length and data of all frames."""
        return self._hash.digest()


class FrameWriter(AppendedFile):
    """The delivered frames with their senders and release instants, which a bus log does not have."""

    def __init__(self, path: Path, senders: Sequence[str]) -> None:
        """Create the file; `senders`: everybody who can send, in the order given to the reader."""
        super().__init__(path)
        self._number = {name: number for number, name in enumerate(senders)}

    def record(self, deliveries: Sequence[BusFrame]) -> None:
        """Append the frames delivered in one step."""
        pack, number = STORED.pack, self._number
        rows = (
            pack(released_ns, arrival_ns, can_id, len(data), number[sender], data)
            for released_ns, arrival_ns, sender, (can_id, data) in deliveries
        )
        self.append(b"".join(rows))


class TraceWriter(AppendedFile):
    """The plant's rows at full precision, appended by whichever process runs the plant.

    The file is one line of JSON (format, columns) and then the rows, float64, little endian.
    """

    def __init__(self, path: Path, columns: Sequence[str]) -> None:
        """Create the file with its header."""
        super().__init__(path)
        try:
            self.append(trace_header(columns))
        except OSError:
            self.close()
            raise

    def write(self, rows: NDArray[np.float64]) -> None:
        """Append rows: [n, columns]."""
        self.append(np.ascontiguousarray(rows, dtype="<f8").tobytes())


class EventLog(AppendedFile):
    """The plant's events: one JSON object per line, written as they happen."""

    def __call__(self, time_s: float, name: str, values: Mapping[str, float]) -> None:
        """Append one event."""
        self.append(json.dumps({"time_s": time_s, "name": name, **values}).encode() + b"\n")


def trace_sha256(frames_digest: bytes, trace_path: Path) -> str:
    """Return the run's hash: SHA-256 over the frames' digest and the plant's trace, byte by byte.

    Two runs have one hash when every frame arrived at the same nanosecond with the same data and
    every value of every trace row has the same bits.
    """
    with open(trace_path, "rb") as file:
        return run_sha256(frames_digest, iter(lambda: file.read(1 << 20), b""))


def run_sha256(frames_digest: bytes, trace: Iterable[bytes]) -> str:
    """Return the hash of a run from its frames' digest and the pieces of its trace file."""
    rows = hashlib.sha256()
    for piece in trace:
        rows.update(piece)
    return hashlib.sha256(frames_digest + rows.digest()).hexdigest()


def hashed_frame(arrival_ns: int, frame: Frame) -> bytes:
    """Return the bytes of a delivered frame that are hashed: arrival, identifier, length, data."""
    return _HASHED_FRAME.pack(arrival_ns, frame.can_id, len(frame.data)) + frame.data


def trace_header(columns: Sequence[str]) -> bytes:
    """Return the first line of a trace file."""
    return json.dumps({"format": TRACE_FORMAT, "columns": list(columns)}).encode() + b"\n"

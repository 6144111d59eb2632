"""What is recorded while a run goes on: the bus log and the plant's trace, on disk after each step."""

from __future__ import annotations

import hashlib
import json
import os
import struct
from bisect import bisect_left
from collections.abc import Iterable, Sequence
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Annotated, Literal, Self

import msgspec
import numpy as np
from numpy.typing import NDArray

from can_dbc.errors import InputError
from can_dbc.frame import Frame

if TYPE_CHECKING:
    from sil.coupling.bus import Delivery

BUS_LOG = "bus.log"
PLANT_TRACE = "plant.trace"
_TRACE_FORMAT = "opc4-trace-1"
_HEADER_BYTES_AT_MOST = 65536
_HASHED_FRAME = struct.Struct("<QIB")


class AppendedFile:
    """A new file to which blocks are appended.

    When `append` returns, the operating system has the block: it survives the death of the process.
    """

    def __init__(self, path: Path) -> None:
        """Create the file, or empty an existing one."""
        self.path = path
        flags = os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_APPEND | os.O_CLOEXEC
        self._descriptor = os.open(path, flags, 0o666)

    def append(self, block: bytes) -> None:
        """Write a block.  Raises OSError naming the file."""
        left = memoryview(block)
        while left:
            try:
                left = left[os.write(self._descriptor, left) :]
            except OSError as error:
                raise OSError(error.errno, error.strerror, str(self.path)) from None

    def close(self) -> None:
        """Close the file; may be called more than once."""
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


class BusLog(AppendedFile):
    """The delivered frames as a log of the form `candump -l` writes, and their hash.

    A line is `(0000000001.234567) opc4 0CFF2503#0011223344556677`, the arrival in simulated time.
    Microseconds are what canplayer reads; at 125 kbit/s to 1 Mbit/s, with releases on whole
    microseconds, they are exact.  An arrival between two microseconds is written with nine digits,
    which canplayer refuses: no time is rounded.
    """

    def __init__(self, path: Path, channel: str = "opc4") -> None:
        """Create the file; `channel` is the name in its lines."""
        super().__init__(path)
        self._channel = channel
        self._hash = hashlib.sha256()
        self.frames = 0

    def record(self, deliveries: Sequence[Delivery]) -> None:
        """Append the frames delivered in one step."""
        lines = []
        for delivery in deliveries:
            arrival_ns, frame = delivery.arrival_ns, delivery.frame
            payload = frame.data
            self._hash.update(hashed_frame(arrival_ns, frame))
            seconds, nanoseconds = divmod(arrival_ns, 1_000_000_000)
            digits = f"{nanoseconds:09d}"
            fraction = digits.removesuffix("000")
            lines.append(
                f"({seconds:010d}.{fraction}) {self._channel} "
                f"{frame.can_id:08X}#{payload.hex().upper()}\n"
            )
        self.frames += len(lines)
        self.append("".join(lines).encode())

    def digest(self) -> bytes:
        """Return the SHA-256 over arrival (ns), identifier, length and data of all frames."""
        return self._hash.digest()


class TraceWriter(AppendedFile):
    """The plant's rows at full precision, appended by whichever process runs the plant.

    The file is one line of JSON (format, columns) and then the rows, float64, little endian.
    """

    def __init__(self, path: Path, columns: Sequence[str]) -> None:
        """Create the file with its header."""
        super().__init__(path)
        self._width = len(columns)
        self.append(trace_header(columns))

    def write(self, rows: NDArray[np.float64]) -> None:
        """Append rows: [n, columns].  Raises ValueError for another shape."""
        if rows.ndim != 2 or rows.shape[1] != self._width:
            raise ValueError(f"rows of shape {rows.shape}; expected (n, {self._width})")
        if len(rows):
            self.append(np.ascontiguousarray(rows, dtype="<f8").tobytes())


class TraceReader:
    """Reads rows of a trace file by their index, also while it is written; a torn last row is ignored."""

    def __init__(self, path: Path) -> None:
        """Read the header.  Raises InputError for a file that is not a trace."""
        with open(path, "rb") as file:
            self.columns = _columns(path, file.readline(_HEADER_BYTES_AT_MOST))
            self._begin = file.tell()
        self._path = path
        self._row_bytes = 8 * len(self.columns)
        self.rows = (path.stat().st_size - self._begin) // self._row_bytes

    def read(self, begin: int = 0, end: int | None = None) -> NDArray[np.float64]:
        """Return rows begin to end - 1, without `end` to the last: [rows, columns]."""
        end = self.rows if end is None else end
        width = len(self.columns)
        offset = self._begin + begin * self._row_bytes
        values = np.fromfile(self._path, "<f8", (end - begin) * width, offset=offset)
        return values.reshape(-1, width).astype(np.float64, copy=False)

    def first_from(self, value: float) -> int:
        """Return the index of the first row whose first column is `value` or more."""
        return bisect_left(range(self.rows), value, key=lambda k: self.read(k, k + 1)[0, 0])


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
    return json.dumps({"format": _TRACE_FORMAT, "columns": list(columns)}).encode() + b"\n"


class _Header(msgspec.Struct):
    format: Literal["opc4-trace-1"]
    columns: Annotated[tuple[str, ...], msgspec.Meta(min_length=1)]


def _columns(path: Path, line: bytes) -> tuple[str, ...]:
    try:
        if line.endswith(b"\n"):
            return msgspec.json.decode(line, type=_Header).columns
    except (msgspec.MsgspecError, RecursionError):
        pass
    raise InputError(
        f"{path}: line 1: not the header of a trace; expected one line of JSON with "
        f'"format": "{_TRACE_FORMAT}" and "columns"'
    )

"""Writing a log: under a temporary name until it is complete."""

from __future__ import annotations

import contextlib
import gzip
import os
import shutil
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterator
from types import TracebackType
from typing import BinaryIO, Final, Self

from can_dbc.errors import InputError
from sil.logs.frame import LogFrame, all_ordinary, require_possible
from sil.logs.times import NS_PER_MS, RELATIVE_BELOW_NS, format_ns

WRITE_BATCH: Final = 2048


class LogWriter(ABC):
    """Writes a log under a temporary name; it gets its own name when it is complete.

    losses: what the format could not hold, by name, counted; nothing is dropped without it.
    channel_numbers: for formats that number their channels, the number of each name.
    """

    format: str = ""
    batch = WRITE_BATCH
    """Frames that are written at once."""

    patched = False
    """The beginning of the file is written last, so that packing has to wait for it."""

    def __init__(self, path: str) -> None:
        """Open a temporary file in the folder of `path`.

        Raises InputError if that is not possible.
        """
        self.path = path
        self._written = 0
        self.losses: Counter[str] = Counter()
        self.channel_numbers: dict[str, int] = {}
        self._held: list[LogFrame] = []
        self._closed = False
        self._channels_seen: set[str] = set()
        self._ordinary = False
        self._file, self._partial = open_beside(path)
        self._out: BinaryIO = self._file
        if path.endswith(".gz") and not self.patched:
            self._out = gzip.GzipFile(filename="", mode="wb", fileobj=self._file, mtime=0)  # type: ignore[assignment]

    @property
    def frames(self) -> int:
        """Number of frames written so far."""
        return self._written + len(self._held)

    def write(self, frame: LogFrame) -> None:
        """Append one frame.

        Raises InputError, now or when its batch is written, for a frame that no bus or this format
        can carry.
        """
        self._held.append(frame)
        if len(self._held) >= self.batch:
            self.flush()

    def flush(self) -> None:
        """Write the frames that are held back."""
        if self._held:
            held = self._held
            self._check(held)
            self._held = []
            self._guarded(held)
            self._written += len(held)

    def _check(self, frames: list[LogFrame]) -> None:
        """Check that a bus can carry the frames. Raises InputError."""
        self._ordinary = all_ordinary(frames, self._channels_seen)
        if self._ordinary:
            return
        for number, frame in enumerate(frames, self._written + 1):
            require_possible(frame, f"{self.path}: frame {number}")
            self._channels_seen.add(frame.channel)

    def _guarded(self, held: list[LogFrame]) -> None:
        try:
            self._write_batch(held)
        except OSError as error:
            raise InputError(f"{self.path}: {error.strerror}; expected room to write") from None

    @abstractmethod
    def _write_batch(self, frames: list[LogFrame]) -> None:
        """Write frames, in order; the first call of all comes with the first frames."""

    @abstractmethod
    def _finish(self) -> None:
        """Write what comes after the last frame (and, for no frames at all, the beginning)."""

    def close(self) -> None:
        """Finish the log and give it its name; a second call does nothing.

        Raises InputError if the disk refuses; then nothing is left behind.
        """
        if self._closed:
            return
        try:
            self.flush()
            self._finish()
            if self._out is not self._file:
                self._out.close()
            elif self.path.endswith(".gz"):
                self._pack()
            self._file.close()
            os.replace(self._partial, self.path)
        except OSError as error:
            self.abort()
            raise InputError(f"{self.path}: {error.strerror}; expected room to write") from None
        except BaseException:
            self.abort()
            raise
        self._closed = True

    def _pack(self) -> None:
        """Replace the finished temporary file by a gzipped one."""
        self._file.seek(0)
        plain, plain_name = self._file, self._partial
        self._file, self._partial = open_beside(self.path)
        with plain, gzip.GzipFile(filename="", mode="wb", fileobj=self._file, mtime=0) as packed:
            shutil.copyfileobj(plain, packed, 1 << 20)
        os.unlink(plain_name)

    def abort(self) -> None:
        """Throw away what was written; the final name stays as it was."""
        if self._closed:
            return
        self._closed = True
        with contextlib.suppress(OSError):  # what is held back may find no room
            self._file.close()
        if os.path.exists(self._partial):
            os.unlink(self._partial)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if kind is None:
            self.close()
        else:
            self.abort()

    def channel_number(self, channel: str, lowest: int = 1) -> int:
        """Return the number (`lowest`..255) that stands for a channel name.

        A number is its own; can0, vcan0, ... become 1, as can-utils has it; a name whose
        number is taken has the next free one. An unnamed channel is 1. Raises InputError if there
        is none left.
        """
        known = self.channel_numbers.get(channel)
        if known is not None:
            return known
        taken = set(self.channel_numbers.values())
        digits = channel[len(channel.rstrip("0123456789")) :][-3:]
        wanted = 1
        if channel.isdecimal() and channel.isascii():
            wanted = int(digits)
        elif digits:
            wanted = int(digits) + 1
        if not lowest <= wanted <= 255 or wanted in taken:
            wanted = next((n for n in range(1, 256) if n not in taken), -1)
            if wanted < 0:
                raise InputError(
                    f"{self.path}: more than 255 channels; expected a format with names"
                )
        self.channel_numbers[channel] = wanted
        if str(wanted) != channel:
            self.losses[f"channel {channel or '(unnamed)'} written as {wanted}"] += 1
        return wanted


def open_beside(path: str) -> tuple[BinaryIO, str]:
    """Open a new file for a result that shall be named `path` once it is whole.

    Returns: the file and its name for now.
    Raises InputError if it cannot be made.
    """
    if os.path.exists(path) and not os.path.isfile(path):
        kind = "a folder" if os.path.isdir(path) else "a pipe or device"
        raise InputError(f"{path}: is {kind}; expected the name of a file")
    folder, name = os.path.split(os.path.abspath(path))
    for attempt in range(1000):
        partial = os.path.join(folder, f".{name}.{os.getpid()}.{attempt}.part")
        try:
            return open(partial, "x+b"), partial
        except FileExistsError:
            continue
        except OSError as error:
            raise InputError(f"{path}: {error.strerror}; expected a folder to write in") from None
    raise InputError(f"{path}: its folder has a thousand unfinished copies; expected them deleted")


@contextlib.contextmanager
def replacing(path: str) -> Iterator[BinaryIO]:
    """Open a new file that gets the name `path` if the block ends without an error.

    Raises InputError if it cannot be made.
    """
    file, partial = open_beside(path)
    try:
        with file:
            yield file
        os.replace(partial, path)
    finally:
        with contextlib.suppress(FileNotFoundError):
            os.unlink(partial)


class RelativeWriter(LogWriter):
    """Writes lines of text whose times count from the first frames of the log."""

    def __init__(self, path: str) -> None:
        super().__init__(path)
        self._begun = False
        self._origin_ns = 0

    @abstractmethod
    def _header(self, frames: list[LogFrame]) -> str:
        """Return what comes before the first frames, which are given."""

    @abstractmethod
    def _text(self, frame: LogFrame, time_ns: int) -> str:
        """Return the line of a frame; `time_ns` counts from the log's start."""

    def _begin(self, frames: list[LogFrame]) -> None:
        """Write the header, once."""
        if self._begun:
            return
        self._begun = True
        first_ns = min((frame.time_ns for frame in frames), default=0)
        if first_ns >= RELATIVE_BELOW_NS:
            self._origin_ns = first_ns // NS_PER_MS * NS_PER_MS
        self._out.write(self._header(frames).encode("ascii"))

    def _write_batch(self, frames: list[LogFrame]) -> None:
        self._begin(frames)
        first_ns = min(frame.time_ns for frame in frames)
        if first_ns < self._origin_ns:
            raise InputError(
                f"{self.path}: a frame at {format_ns(first_ns)} s is before the start of "
                f"the log at {format_ns(self._origin_ns)} s; expected candump, csv or mf4 for it"
            )
        lines = [self._text(frame, frame.time_ns - self._origin_ns) for frame in frames]
        self._out.write("".join(lines).encode("ascii"))

    def _finish(self) -> None:
        self._begin([])

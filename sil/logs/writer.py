"""Writing a log: under a temporary name until it is complete."""

from __future__ import annotations

import contextlib
import gzip
import shutil
import tempfile
from abc import ABC, abstractmethod
from collections import Counter
from pathlib import Path
from typing import BinaryIO, Self

from can_dbc.errors import InputError
from sil.files.atomic import NewFile
from sil.logs.frame import LogFrame, all_ordinary, frame_problem
from sil.logs.source import refuse_special
from sil.logs.times import NS_PER_MS, RELATIVE_BELOW_NS, format_ns


class LogWriter(ABC):
    """Writes a log under a temporary name; it gets its own name when it is complete.

    losses: what the format could not hold, by name, counted; nothing is dropped without it.
    channel_numbers: for formats that number their channels, the number of each name.
    start_ns: where times in the log may count from: a whole millisecond at or before the first
    frames, 0 if their times are relative.
    """

    format: str = ""
    batch = 2048  # frames that are written at once

    patched = False  # the beginning of the file is written last, so that packing has to wait for it

    def __init__(self, path: str) -> None:
        """Open a temporary file in the folder of `path`. Raises InputError if that is not possible."""
        self.path = path
        self._written = 0
        self.losses: Counter[str] = Counter()
        self.channel_numbers: dict[str, int] = {}
        self.start_ns = 0
        self._held: list[LogFrame] = []
        self._begun = self._closed = False
        self._known_channels: set[str] = set()
        refuse_special(path, "the name of a file")
        try:
            self._new = NewFile(Path(path))
            self._out = self._opened()
        except OSError as error:
            raise InputError(f"{path}: {error.strerror}; expected a folder to write in") from None

    def _opened(self) -> BinaryIO:
        """Return the file to write in: the new one, what packs into it, or one to be packed."""
        if not self.path.endswith(".gz"):
            return self._new.file
        if not self.patched:
            return packer(self._new.file)
        try:
            return tempfile.TemporaryFile(dir=Path(self.path).parent)
        except OSError:
            self._new.discard()
            raise

    @property
    def frames(self) -> int:
        """Number of frames written so far."""
        return self._written + len(self._held)

    def write(self, frame: LogFrame) -> None:
        """Append one frame. Raises InputError, now or with its batch, for one that cannot be written."""
        self._held.append(frame)
        if len(self._held) >= self.batch:
            self.flush()

    def flush(self) -> None:
        """Write the frames that are held back. Raises InputError as `write` does."""
        if not self._held:
            return
        frames = self._held
        if not all_ordinary(frames, self._known_channels):
            for number, frame in enumerate(frames, self._written + 1):
                if problem := frame_problem(frame):
                    raise InputError(
                        f"{self.path}: frame {number}: {problem}; expected a CAN frame"
                    )
                self._known_channels.add(frame.channel)
        self._held = []
        try:
            self._begin_with(frames)
            self._write_batch(frames)
        except OSError as error:
            raise self._no_room(error) from None
        self._written += len(frames)

    def _begin_with(self, frames: list[LogFrame]) -> None:
        """Find where times count from, and write the beginning, once."""
        if not self._begun:
            self._begun = True
            first_ns = min((frame.time_ns for frame in frames), default=0)
            if first_ns >= RELATIVE_BELOW_NS:
                self.start_ns = first_ns // NS_PER_MS * NS_PER_MS
            self._begin(frames)

    def _begin(self, frames: list[LogFrame]) -> None:  # noqa: B027 optional
        """Write what comes before the first frames, which are given (none for an empty log)."""

    @abstractmethod
    def _write_batch(self, frames: list[LogFrame]) -> None: ...

    def _finish(self) -> None:  # noqa: B027 optional
        """Write what comes after the last frame."""

    def _since_start(self, frame: LogFrame) -> int:
        """Return the time of a frame from the log's start in ns. Raises InputError before it."""
        if frame.time_ns < self.start_ns:
            raise InputError(
                f"{self.path}: a frame at {format_ns(frame.time_ns)} s is before the start of "
                f"the log at {format_ns(self.start_ns)} s; expected csv or mf4 as the target, which "
                "hold such times"
            )
        return frame.time_ns - self.start_ns

    def _no_room(self, error: OSError) -> InputError:
        return InputError(f"{self.path}: {error.strerror}; expected room to write")

    def close(self) -> None:
        """Finish the log and give it its name; a second call does nothing.

        Raises InputError if the disk refuses; then nothing is left behind.
        """
        if self._closed:
            return
        try:
            self.flush()
            self._begin_with([])
            self._finish()
            if self._out is not self._new.file:
                if self.patched:
                    self._out.seek(0)
                    with packer(self._new.file) as packed:
                        shutil.copyfileobj(self._out, packed, 1 << 20)
                self._out.close()
            self._new.keep()
        except BaseException as error:
            self.abort()
            raise self._no_room(error) if isinstance(error, OSError) else error from None
        self._closed = True

    def abort(self) -> None:
        """Throw away what was written; the final name stays as it was."""
        if self._closed:
            return
        self._closed = True
        self._new.discard()
        with contextlib.suppress(OSError, ValueError):  # what is held back has no file any more
            self._out.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *error: object) -> None:
        (self.close if kind is None else self.abort)()

    def lose(self, lost: object, name: str) -> None:
        """Count a loss if there is one."""
        if lost:
            self.losses[name] += 1

    def direction(self, frame: LogFrame) -> str:
        """Return Rx or Tx for a format that has no other."""
        self.lose(not frame.direction, "direction not recorded, written as Rx")
        return frame.direction or "Rx"

    def error_data(self, frame: LogFrame) -> bytes:
        """Return the details of an error frame for a format that has room for eight bytes."""
        self.lose(len(frame.data) > 8, "bytes of an error frame after the eighth")
        return frame.data[:8]

    def channel_number(self, channel: str, lowest: int = 1) -> int:
        """Return the number (`lowest`..255) of a channel name: its own, 1 for can0 and for none, else a free one.

        Raises InputError if there is none left.
        """
        number = self.channel_numbers.get(channel)
        if number is not None:
            return number
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
        self.lose(str(wanted) != channel, f"channel {channel or '(unnamed)'} written as {wanted}")
        return wanted


def packer(file: BinaryIO) -> BinaryIO:
    """Return a stream that packs into a file, the same bytes at any time of day."""
    return gzip.GzipFile(filename="", mode="wb", fileobj=file, mtime=0)  # type: ignore[return-value]


class TextWriter(LogWriter):
    """Writes a line of text for each frame."""

    @abstractmethod
    def _header(self, frames: list[LogFrame]) -> str:
        """Return what comes before the first frames, which are given."""

    @abstractmethod
    def _line(self, frame: LogFrame) -> str:
        """Return the line of a frame, with its end."""

    def _begin(self, frames: list[LogFrame]) -> None:
        self._out.write(self._header(frames).encode("ascii"))

    def _write_batch(self, frames: list[LogFrame]) -> None:
        self._out.write("".join(map(self._line, frames)).encode("ascii"))

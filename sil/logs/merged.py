"""Several files as one log, ordered by time, and what is selected of it."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from heapq import heappop, heappush, heapreplace
from itertools import chain, count

from can_dbc.errors import InputError
from sil.files.progress import Progress
from sil.logs.frame import MAX_TIME_NS, LogFrame
from sil.logs.reader import LogReader, unseen
from sil.logs.registry import open_log
from sil.logs.report import LogReport
from sil.logs.selection import Selection
from sil.logs.times import NS_PER_S, RELATIVE_BELOW_NS, format_ns

_BYTES_PER_MB = 1e6


@dataclass
class _Part:
    """One of the files: its reader, what is added to its times, and that of its first frame."""

    reader: LogReader
    offset_ns: int = 0
    first_ns: int = MAX_TIME_NS

    def frames(self) -> Iterator[LogFrame]:
        """Begin a reading, after which `offset_ns` and `first_ns` are known."""
        frames = iter(self.reader)
        first = next(frames, None)
        if first is None:
            return frames
        report = self.reader.report
        offset_ns = (report.start_ns or 0) if report.time_base in ("relative", "delta") else 0
        self.offset_ns, self.first_ns = offset_ns, offset_ns + first.time_ns
        frames = chain((first,), frames)
        if not offset_ns:
            return frames
        return (frame._replace(time_ns=frame.time_ns + offset_ns) for frame in frames)


class Logs:
    """Files as one log, to be read any number of times; `report` states what the last reading found.

    Times that count from a date in a file's header become absolute. Files follow each other by time;
    where they overlap their frames are interleaved, and a frame that is in several is taken once.

    Raises on iteration: InputError as a `LogReader` does, and for files of which only some have dates.
    """

    def __init__(
        self, readers: Sequence[LogReader], selection: Selection, *, show_progress: bool
    ) -> None:
        self._parts = [_Part(reader) for reader in readers]
        self._selection = selection
        self._show_progress = show_progress
        self._ready = False
        self.repeated = 0
        """Frames of the last reading that were in several files, and were taken once."""

    @property
    def path(self) -> str:
        """The names of the files."""
        return ", ".join(part.reader.path for part in self._parts)

    @property
    def report(self) -> LogReport:
        """What the last reading found in all files."""
        reports = [part.reader.report for part in self._parts]
        if len(reports) == 1:
            return reports[0]
        found = LogReport.joined(reports)
        found.files = list(self._file_lines())
        return found

    def __iter__(self) -> Iterator[LogFrame]:
        frames = self._parts[0].frames() if len(self._parts) == 1 else self._in_order()
        if self._selection:
            frames = self._selection.select(frames)
        return self._with_progress(frames) if self._show_progress else frames

    def _prepare(self) -> None:
        """Look at the beginning of each file, and order the files by it."""
        if self._ready:
            return
        for part in self._parts:
            part.frames()
            if part.reader.report.time_base == "none":
                raise InputError(
                    f"{part.reader.path}: has no times; expected logs with times, to put them in order"
                )
        self._parts.sort(key=lambda part: part.first_ns)
        early, late = self._parts[0], self._parts[-1]
        if early.first_ns < RELATIVE_BELOW_NS <= late.first_ns < MAX_TIME_NS:
            raise InputError(
                f"{early.reader.path}: its times count from its start, those of {late.reader.path} from "
                "1970; expected files of one clock"
            )
        self._ready = True

    def _in_order(self) -> Iterator[LogFrame]:
        self._prepare()
        self.repeated = 0
        waiting = deque(self._parts)
        numbers = count()
        open_files: list[tuple[int, int, LogFrame, Iterator[LogFrame]]] = []
        at_once: dict[LogFrame, int] = {}
        instant_ns = -MAX_TIME_NS
        while waiting or open_files:
            while waiting and (not open_files or waiting[0].first_ns <= open_files[0][0]):
                frames = waiting.popleft().frames()
                for frame in frames:
                    heappush(open_files, (frame.time_ns, next(numbers), frame, frames))
                    break
            if len(open_files) == 1:
                ((_, number, frame, frames),) = open_files
                next_ns = waiting[0].first_ns if waiting else 2 * MAX_TIME_NS
                yield frame
                open_files.clear()
                for frame in frames:
                    if frame[0] >= next_ns:
                        open_files.append((frame[0], number, frame, frames))
                        break
                    yield frame
                continue
            if not open_files:
                continue
            time_ns, number, frame, frames = open_files[0]
            if time_ns != instant_ns:
                at_once, instant_ns = {}, time_ns
            if at_once.setdefault(frame, number) == number:
                yield frame
            else:
                self.repeated += 1
            following = next(frames, None)
            if following is None:
                heappop(open_files)
            else:
                heapreplace(open_files, (following[0], number, following, frames))

    def _file_lines(self) -> Iterator[str]:
        end_ns: int | None = None
        for part in self._parts:
            report = part.reader.report
            if report.first_ns is None or report.last_ns is None:
                yield f"{report.path}: no frames"
                continue
            first_ns, last_ns = report.first_ns + part.offset_ns, report.last_ns + part.offset_ns
            line = f"{report.path}: {report.frames} frames, {format_ns(first_ns)} s to {format_ns(last_ns)} s"
            if end_ns is not None and first_ns > end_ns:
                line += f", after a gap of {(first_ns - end_ns) / NS_PER_S:.6f} s"
            elif end_ns is not None:
                line += f", overlaps by {(min(end_ns, last_ns) - first_ns) / NS_PER_S:.6f} s"
            yield line
            end_ns = last_ns if end_ns is None else max(end_ns, last_ns)
        if self.repeated:
            yield f"{self.repeated} frames are in several files and were taken once"

    def _with_progress(self, frames: Iterator[LogFrame]) -> Iterator[LogFrame]:
        passed: dict[str, tuple[float, float]] = {}
        sizes = {part.reader.path: _size(part.reader.path) for part in self._parts}
        with Progress(f"reading {self.path[:60]}", "MB") as progress:
            for part in self._parts:

                def show(done: float, size: float, path: str = part.reader.path) -> None:
                    passed[path], sizes[path] = (done, size), size
                    done_bytes = sum(done for done, _ in passed.values())
                    progress(done_bytes / _BYTES_PER_MB, sum(sizes.values()) / _BYTES_PER_MB)

                part.reader.on_read = show
            try:
                yield from frames
            finally:  # else the next reading would show its first frame as progress of this one
                for part in self._parts:
                    part.reader.on_read = unseen


def _size(path: str) -> float:
    try:
        return os.path.getsize(path)
    except OSError:  # standard input
        return 0.0


def open_logs(
    paths: Sequence[str | os.PathLike[str]],
    selection: Selection | None = None,
    *,
    format: str | None = None,
    strict: bool = False,
    times: str = "auto",
    show_progress: bool = False,
) -> Logs:
    """Open recorded CAN logs as one, ordered by time.

    Parameters
    ----------
    paths
        One or several logs; "-" is standard input.
    selection
        The frames that are wanted; None: all.
    format, strict, times
        As in `open_log`.
    show_progress
        Show on standard error how far it is read, if that takes more than two seconds.

    Raises
    ------
    InputError
        If a file cannot be opened or is no log.
    """
    names = [os.fspath(path) for path in paths]
    if len(set(names)) < len(names):
        raise InputError(f"{', '.join(names)}: a file given twice; expected each once")
    readers = [open_log(path, format=format, strict=strict, times=times) for path in names]
    return Logs(readers, selection or Selection(), show_progress=show_progress)

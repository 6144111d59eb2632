"""Several files as one log, ordered by time, and what is selected of it."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from heapq import heappop, heappush, heapreplace
from itertools import chain, islice
from typing import Any, TypedDict, Unpack

from can_dbc.errors import InputError
from can_dbc.instants import NS_PER_S
from sil.files.progress import Progress
from sil.files.quantity import counted
from sil.logs.frame import MAX_TIME_NS, LogFrame
from sil.logs.reader import LogReader
from sil.logs.registry import open_log
from sil.logs.report import LogReport
from sil.logs.selection import Selection
from sil.logs.times import RELATIVE_BELOW_NS, format_ns


@dataclass
class _Part:
    """One of the files: its reader, what is added to its times, and that of its first frame."""

    reader: LogReader
    offset_ns: int = 0
    first_ns: int = MAX_TIME_NS

    def blocks(self) -> Iterator[list[LogFrame]]:
        """Begin a reading, after which `offset_ns` and `first_ns` are known."""
        blocks: Iterator[list[LogFrame]] = filter(None, self.reader.blocks())
        first = next(blocks, None)
        if first is None:
            return blocks
        report = self.reader.report
        offset_ns = (report.start_ns or 0) if report.time_base in ("relative", "delta") else 0
        self.offset_ns, self.first_ns = offset_ns, offset_ns + first[0].time_ns
        blocks = chain((first,), blocks)
        if not offset_ns:
            return blocks
        return ([frame._replace(time_ns=frame[0] + offset_ns) for frame in b] for b in blocks)


class Logs:
    """Files as one log, to be read any number of times; `report` states what the last reading found.

    Times that count from a date in a file's header become absolute. Files follow each other by time;
    where they overlap their frames are interleaved, and a frame that is in several is taken once.

    Raises on iteration: InputError as a `LogReader` does, for files of which only some have dates, and
    if no frame is selected.
    """

    def __init__(
        self, readers: Sequence[LogReader], selection: Selection, *, show_progress: bool
    ) -> None:
        self._parts = [_Part(reader) for reader in readers]
        self._selection = selection
        self._show_progress = show_progress
        self._ready = False
        self.repeated = (
            0  # frames of the last reading that were in several files, and were taken once
        )

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
        report = LogReport.joined(reports)
        report.files = list(self._file_lines())
        return report

    def __iter__(self) -> Iterator[LogFrame]:
        blocks = self._parts[0].blocks() if len(self._parts) == 1 else self._in_order()
        if self._selection:
            blocks = self._selection.select(blocks)
        if self._show_progress:
            blocks = self._with_progress(blocks)
        return chain.from_iterable(self._not_empty(blocks))

    def _not_empty(self, blocks: Iterator[list[LogFrame]]) -> Iterator[list[LogFrame]]:
        frames = 0
        for block in blocks:
            frames += len(block)
            yield block
        if not frames:
            filters = " within --since, --until, --id, --pgn, --channel" if self._selection else ""
            raise InputError(f"{self.path}: no CAN frame{filters}; expected at least one")

    def _prepare(self) -> None:
        """Look at the beginning of each file, and order the files by it."""
        if self._ready:
            return
        for part in self._parts:
            part.blocks()
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

    def _in_order(self) -> Iterator[list[LogFrame]]:
        """Yield the frames of all files by time; a file is opened when its first frame is due."""
        self._prepare()
        self.repeated = 0
        waiting = deque(enumerate(self._parts))
        files: list[tuple[int, int, LogFrame, Iterator[LogFrame]]] = []
        block: list[LogFrame] = []
        at_once: dict[LogFrame, int] = {}
        instant_ns = -MAX_TIME_NS
        while waiting or files:
            while waiting and (not files or waiting[0][1].first_ns <= files[0][0]):
                number, part = waiting.popleft()
                frames: Iterator[LogFrame] = chain.from_iterable(part.blocks())
                for frame in islice(frames, 1):
                    heappush(files, (frame.time_ns, number, frame, frames))
            if not files:
                continue
            time_ns, number, frame, frames = files[0]
            if time_ns != instant_ns:
                at_once, instant_ns = {}, time_ns
            if at_once.setdefault(frame, number) == number:
                block.append(frame)
            else:
                self.repeated += 1
            if len(block) == 512:
                yield block
                block = []
            following = next(frames, None)
            if following is None:
                heappop(files)
            else:
                heapreplace(files, (following[0], number, following, frames))
        yield block

    def _file_lines(self) -> Iterator[str]:
        end_ns: int | None = None
        for part in self._parts:
            report = part.reader.report
            if report.first_ns is None or report.last_ns is None:
                yield f"{report.path}: no frames"
                continue
            first_ns, last_ns = report.first_ns + part.offset_ns, report.last_ns + part.offset_ns
            line = f"{report.path}: {counted(report.frames, 'frame')}, {format_ns(first_ns)} s to {format_ns(last_ns)} s"
            if end_ns is None:
                end_ns = last_ns
            elif first_ns > end_ns:
                line += f", after a gap of {(first_ns - end_ns) / NS_PER_S:.6f} s"
            else:
                line += f", overlaps by {(min(end_ns, last_ns) - first_ns) / NS_PER_S:.6f} s"
            yield line
            end_ns = max(end_ns, last_ns)
        if self.repeated:
            yield f"{self.repeated} frames are in several files and were taken once"

    def _with_progress(self, blocks: Iterator[list[LogFrame]]) -> Iterator[list[LogFrame]]:
        readers = [part.reader for part in self._parts]
        for reader in readers:
            reader.passed_bytes = 0.0
        with Progress(f"reading {self.path[:60]}", "MB") as progress:
            for block in blocks:
                passed = sum(reader.passed_bytes for reader in readers)
                progress(passed / 1e6, sum(reader.size for reader in readers) / 1e6)
                yield block


class Reading(TypedDict, total=False):
    """How logs are read; format, strict and times as in `open_log`."""

    selection: Selection  # the frames that are wanted [all]
    format: str | None
    strict: bool
    times: str
    show_progress: bool
    """Show on standard error how far it is read, if that takes more than two seconds."""


def open_logs(paths: Sequence[str | os.PathLike[str]], **how: Unpack[Reading]) -> Logs:
    """Open one or several recorded CAN logs as one, ordered by time; "-" is standard input.

    Raises InputError if a file cannot be opened or is no log.
    """
    names = [os.fspath(path) for path in paths]
    if len(set(names)) < len(names):
        raise InputError(f"{', '.join(names)}: a file given twice; expected each once")
    of_each: dict[str, Any] = {**how}
    selection, shown = of_each.pop("selection", Selection()), of_each.pop("show_progress", False)
    readers = [open_log(path, **of_each) for path in names]
    return Logs(readers, selection, show_progress=shown)

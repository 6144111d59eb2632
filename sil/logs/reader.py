"""Reading a log as an iterable of frames with a report of what was found."""

from __future__ import annotations

import os
from collections.abc import Iterator
from itertools import chain
from operator import lt
from tempfile import _TemporaryFileWrapper

from can_dbc.errors import InputError
from sil.logs.format import Batch, Format
from sil.logs.frame import LogFrame
from sil.logs.lockstep import LockstepFilter
from sil.logs.report import LogReport
from sil.logs.source import ByteSource
from sil.logs.times import format_ns


class LogReader:
    """Frames of a log, in its order, in bounded memory; `report` states what was found.

    Each iteration reads the file anew and begins a new report; frames are read and counted some
    thousands ahead, and the report is complete when the iteration has ended.

    Raises on iteration: InputError for an unreadable log, and with `strict` for every broken line
    or record, every step of the clock backwards, every duplicate, and a log that is cut off.
    """

    def __init__(
        self,
        path: str,
        format: Format,
        *,
        strict: bool,
        times: str,
        copy: _TemporaryFileWrapper[bytes] | None = None,
    ) -> None:
        self.path = path
        self._copy = copy
        self.passed_bytes = 0.0  # how much of the file the reading under way has read
        self.size = os.path.getsize(path) if os.path.isfile(path) else 0
        self.format = format.name
        self._format = format
        self._strict = strict
        self._times = times
        self.report = LogReport(path, format.name, strict=strict)

    def __iter__(self) -> Iterator[LogFrame]:
        return chain.from_iterable(self.blocks())

    def blocks(self) -> Iterator[list[LogFrame]]:
        """Begin a reading; yield the frames some hundreds at a time. Raises InputError as iteration does."""
        report = self.report = LogReport(self.path, self.format, strict=self._strict)
        lockstep = LockstepFilter(report)
        watch = _Watch(report, self._format.location)
        source = ByteSource(self.path, report, self._copy.name if self._copy else None)
        try:
            for batch in map(lockstep.take, self._format.read(source, report, self._times)):
                watch.take(batch)
                self.passed_bytes, self.size = source.passed_bytes, source.size
                yield batch.frames
        finally:
            source.close()
        self._refuse_silence(report)

    def _refuse_silence(self, report: LogReport) -> None:
        """Refuse a log of which nothing could be read; note an empty one. Raises InputError."""
        if report.frames or report.lockstep:
            return
        if report.skipped or report.truncated:
            first = (report.places["skipped"] + report.notes)[0]
            raise InputError(
                f"{self.path}: {first}; no CAN frame found, expected a log of format {self.format}"
            )
        report.note("no CAN frames in it")


class _Watch:
    """Counts frames and watches the clock and duplicates, batch by batch."""

    def __init__(self, report: LogReport, location_word: str) -> None:
        self._report = report
        self._location_word = location_word
        self._last_ns: int | None = None
        self._instant: list[LogFrame] = []

    def take(self, batch: Batch) -> None:
        """Count the frames of a batch and look at their times."""
        frames, report = batch.frames, self._report
        if not frames:
            return
        report.frames += len(frames)
        if not batch.ordinary:
            report.remote += sum(frame[4] for frame in frames)
            report.error += sum(frame[5] for frame in frames)
            report.fd += sum(frame[6] for frame in frames)
        times_ns = [frame[0] for frame in frames]
        if report.first_ns is None:
            report.first_ns = times_ns[0]
        if report.time_base != "none":
            runs_on = all(map(lt, times_ns, times_ns[1:]))
            if not runs_on or (self._last_ns is not None and times_ns[0] <= self._last_ns):
                self._look(batch)
            else:
                self._instant = [frames[-1]]
        self._last_ns = report.last_ns = times_ns[-1]

    def _look(self, batch: Batch) -> None:
        """Find the steps back and the duplicates of a batch in which time does not simply run."""
        report, last_ns, instant = self._report, self._last_ns, self._instant
        for frame, location in zip(batch.frames, batch.locations, strict=True):
            time_ns = frame[0]
            if last_ns is None or time_ns > last_ns:
                instant = [frame]
            elif time_ns < last_ns:
                instant = [frame]
                back = f"back from {format_ns(last_ns)} s to {format_ns(time_ns)} s"
                text = f"{self._location_word} {location}: the clock steps {back}"
                report.broken("backwards", text, "times that do not fall")
            elif frame in instant:
                twice = f"the frame {frame.can_id:X} at {format_ns(time_ns)} s is in the log twice"
                text = f"{self._location_word} {location}: {twice}"
                report.broken("duplicates", text, "every frame once")
            elif len(instant) < 64:
                instant.append(frame)
            last_ns = time_ns
        self._instant = instant

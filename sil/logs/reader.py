"""Reading a log as an iterable of frames with a report of what was found."""

from __future__ import annotations

from collections.abc import Iterator

from can_dbc.errors import InputError
from sil.logs.backend import Backend, Batch, ReadOptions
from sil.logs.byte_source import ByteSource
from sil.logs.frame import LogFrame
from sil.logs.report import KEPT_PLACES, LogReport
from sil.logs.times import format_ns

_WATCHED_INSTANT = 64
"""Frames of one instant that are kept to find duplicates among."""


class LogReader:
    """Frames of a log, in its order, in bounded memory; `report` tells what was found.

    Each iteration reads the file anew and begins a new report; the report is complete when the
    iteration has ended.

    Raises on iteration: InputError for an unreadable log, and with `strict` for every broken line
    or record, every step of the clock backwards, every duplicate, and a log that is cut off.

    Checked by: tests/unit/sil/logs/test_reader.py, tests/contracts/test_log_formats.py.
    """

    def __init__(self, path: str, backend: Backend, *, strict: bool, times: str) -> None:
        self.path = path
        self.format = backend.name
        self._backend = backend
        self._strict = strict
        self._options = ReadOptions(times)
        self.report = LogReport(path, backend.name, strict=strict)

    def __iter__(self) -> Iterator[LogFrame]:
        report = self.report = LogReport(self.path, self.format, strict=self._strict)
        source = ByteSource(self.path, report)
        try:
            yield from self._watched(self._backend.batches(source, report, self._options), report)
        finally:
            source.close()
        self._refuse_silence(report)

    def _watched(self, batches: Iterator[Batch], report: LogReport) -> Iterator[LogFrame]:
        """Hand the frames on, counting, and watching the clock."""
        last_ns = None
        instant: list[LogFrame] = []
        for batch in batches:
            frames = batch.frames
            timed = report.time_base != "none"
            for index, frame in enumerate(frames):
                time_ns = frame[0]
                if last_ns is None or time_ns > last_ns or not timed:
                    if last_ns is None:
                        report.first_ns = time_ns
                    instant = [frame]
                elif time_ns == last_ns:
                    if frame in instant:
                        self._duplicate(report, frame, batch.places[index])
                    elif len(instant) < _WATCHED_INSTANT:
                        instant.append(frame)
                else:
                    self._backwards(report, last_ns, time_ns, batch.places[index])
                    instant = [frame]
                last_ns = time_ns
                report.frames += 1
                if frame[4] or frame[5] or frame[6]:
                    report.remote += frame.remote
                    report.error += frame.error
                    report.fd += frame.fd
                yield frame
            report.last_ns = last_ns

    def _backwards(self, report: LogReport, before_ns: int, after_ns: int, place: int) -> None:
        report.backwards += 1
        where = (
            f"{self._backend.place_word} {place}: the clock steps back from "
            f"{format_ns(before_ns)} s to {format_ns(after_ns)} s"
        )
        if report.strict:
            raise InputError(f"{self.path}: {where}; expected times that do not fall")
        if len(report.backwards_places) < KEPT_PLACES:
            report.backwards_places.append(where)

    def _duplicate(self, report: LogReport, frame: LogFrame, place: int) -> None:
        report.duplicates += 1
        where = (
            f"{self._backend.place_word} {place}: the frame {frame.can_id:X} at "
            f"{format_ns(frame.time_ns)} s is there twice"
        )
        if report.strict:
            raise InputError(f"{self.path}: {where}; expected every frame once")
        if len(report.duplicate_places) < KEPT_PLACES:
            report.duplicate_places.append(where)

    def _refuse_silence(self, report: LogReport) -> None:
        """A log of which nothing could be read is refused; an empty one is noted."""
        if report.frames:
            return
        if report.skipped or report.truncated:
            first = str(report.skipped_places[0]) if report.skipped_places else report.notes[0]
            raise InputError(
                f"{self.path}: {first}; no CAN frame found, expected a {self.format} log"
            )
        report.note("no CAN frames in it")

"""What ASC and TRC logs share: lines of text whose times count from the log's own start.

Checked by: tests/unit/sil/logs/test_asc.py, tests/unit/sil/logs/test_trc.py
"""

from __future__ import annotations

from abc import ABC, abstractmethod

from can_dbc.errors import InputError
from sil.logs.backend import Batch, LogWriter
from sil.logs.frame import LogFrame
from sil.logs.report import LogReport, Place
from sil.logs.text_lines import Chunk, Line, chunk_lines
from sil.logs.times import NS_PER_MS, RELATIVE_BELOW_NS, format_ns


class NoFrame(Exception):
    """A line that is no frame; its argument names it for the report."""


class LineReader(ABC):
    """Lines one by one: their frames, and what the report is told of the others."""

    def __init__(self, report: LogReport) -> None:
        self._report = report
        report.time_base = "relative"

    @abstractmethod
    def _line(self, line: Line) -> LogFrame | None:
        """The frame of a line, None for one that counts for nothing.

        Raises: NoFrame for what is known and no frame, ValueError for a broken line, InputError
        where nothing after it can be read.
        """

    def _mixed(self, chunk: Chunk) -> Batch:
        """The frames of a chunk, each line looked at."""
        frames: list[LogFrame] = []
        places: list[int] = []
        for line in chunk_lines(chunk):
            frame = self._guarded(line)
            if frame is not None:
                frames.append(frame)
                places.append(line.number)
        return Batch(frames, places)

    def _guarded(self, line: Line) -> LogFrame | None:
        """The frame of a line; other lines and broken ones go to the report."""
        try:
            return self._line(line)
        except InputError:
            raise
        except NoFrame as known:
            self._report.other[known.args[0]] += 1
        except ValueError as error:
            place = Place(str(error), line.number, line.byte)
            if line.unterminated:
                self._report.cut(place)
            else:
                self._report.skip(place)
        return None


class RelativeWriter(LogWriter):
    """Writes lines of text; the first frames tell from which instant times count."""

    def __init__(self, path: str) -> None:
        super().__init__(path)
        self._begun = False
        self._origin_ns = 0

    @abstractmethod
    def _header(self, frames: list[LogFrame]) -> str:
        """What stands before the first frames, which are given."""

    @abstractmethod
    def _text(self, frame: LogFrame, time_ns: int) -> str:
        """The line of a frame; `time_ns` counts from the log's start."""

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
                f"{self.path}: a frame at {format_ns(first_ns)} s lies before the start of "
                f"the log at {format_ns(self._origin_ns)} s; expected candump, csv or mf4 for it"
            )
        lines = [self._text(frame, frame.time_ns - self._origin_ns) for frame in frames]
        self._out.write("".join(lines).encode("ascii"))

    def _finish(self) -> None:
        self._begin([])

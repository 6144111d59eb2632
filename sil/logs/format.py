"""What a log format has to offer, and what the text formats share."""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import takewhile
from typing import Final, NamedTuple

from can_dbc.errors import InputError
from sil.logs.frame import LogFrame, frame_problem, ordinary_frame
from sil.logs.report import Location, LogReport
from sil.logs.source import ByteSource, Chunk, Line, chunk_lines, chunks
from sil.logs.times import RELATIVE_BELOW_NS
from sil.logs.writer import LogWriter

ZONE_NOTE: Final = "the start in the header names no time zone; it is taken as UTC"


class Batch(NamedTuple):
    """Frames in the log's order and where each begins: line, byte or number of the frame.

    ordinary: all are known to be classic data frames.
    """

    frames: list[LogFrame]
    locations: Sequence[int]
    ordinary: bool = False


class Format(NamedTuple):
    """A log format; the registry lists one for each.

    suffixes: of file names, the usual one first.
    recognise: whether a file that begins with these bytes is of this format.
    read: the batches of a source; what is broken goes to the report. `times` is "auto", or "delta"
    or "recorded" to say what the times of a candump log are.
    writer: open a writer for a new log.
    location: what the numbers in a batch count: "line", "byte" or "frame".
    """

    name: str
    suffixes: tuple[str, ...]
    recognise: Callable[[bytes], bool]
    read: Callable[[ByteSource, LogReport, str], Iterable[Batch]]
    writer: Callable[[str], LogWriter]
    location: str = "line"


class NotAFrame(Exception):
    """A line that belongs in a log and is no frame.

    name: what it is, "" for what need not be counted; count: how many of these it stands for.
    """

    def __init__(self, name: str, count: int = 1) -> None:
        super().__init__(name)
        self.name = name
        self.count = count


class TextReader(ABC):
    """Reads a log of lines; a format says how a line becomes a frame."""

    time_base = "absolute"  # what the times of a log are until its lines say otherwise

    def __init__(self, source: ByteSource, report: LogReport, times: str) -> None:
        self._source = source
        self._report = report
        report.time_base = self.time_base
        self._times = times
        self._ids: dict[str, tuple[int, bool]] = {}

    def __iter__(self) -> Iterator[Batch]:
        for chunk in chunks(self._source):
            if chunk.text.isspace():
                continue
            batch = None if chunk.unterminated else self._quick(chunk)
            batch = batch or self._each_line(chunk)
            if batch.frames:
                yield batch

    def _quick(self, chunk: Chunk) -> Batch | None:
        """Return the frames of a chunk by a quick way, None if there is none for it."""
        return None

    @abstractmethod
    def _line(self, line: Line) -> LogFrame | None:
        """Return the frame of a line, None for one that counts for nothing.

        Raises NotAFrame for what is known and no frame, ValueError for a broken line, InputError
        where nothing after it can be read.
        """

    def _each_line(self, chunk: Chunk) -> Batch:
        frames: list[LogFrame] = []
        locations: list[int] = []
        for line in chunk_lines(chunk):
            if (frame := self._guarded(line)) is not None:
                frames.append(frame)
                locations.append(line.number)
        return Batch(frames, locations)

    def _guarded(self, line: Line) -> LogFrame | None:
        """Return the frame of a line; other lines and broken ones go to the report."""
        try:
            frame = self._line(line)
            if frame is not None and (problem := frame_problem(frame)):
                raise ValueError(problem)
            return frame
        except InputError:
            raise
        except NotAFrame as other:
            if other.name:
                self._report.other[other.name] += other.count
        except ValueError as error:
            location = Location(str(error), line.number, line.byte)
            if line.unterminated:
                self._report.cut(location)
            else:
                self._report.skip(location)
        return None

    def _by_pattern(
        self, chunk: Chunk, pattern: re.Pattern[str], origin_ns: int, unit_ns: int
    ) -> Batch:
        """Return the frames of a chunk in which most lines are classic data frames.

        The groups of the pattern are the time before and after the point, channel, identifier,
        direction, length, data, and any other line as a whole.
        """
        frames: list[LogFrame] = []
        locations: list[int] = []
        lines: Sequence[Line] = ()
        ids = self._ids
        scale = [unit_ns // 10**decimals for decimals in range(10)]
        for index, words in enumerate(pattern.findall(chunk.text[:-1])):
            whole, fraction, channel, digits, way, code, data, other = words
            identity = ids.get(digits)
            payload = bytes.fromhex(data)
            if identity is None or len(payload) != int(code):
                if not whole and not other:
                    continue
                lines = lines or list(chunk_lines(chunk))
                frame = self._guarded(lines[index])
                if frame is None:
                    continue
                if whole and len(ids) < 100_000:
                    ids[digits] = frame.can_id, frame.extended
            else:
                time_ns = origin_ns + int(whole + fraction) * scale[len(fraction)]
                frame = ordinary_frame(time_ns, identity[0], payload, identity[1], channel, way)
            frames.append(frame)
            locations.append(chunk.line + index)
        return Batch(frames, locations)


def leading_bytes(words: Sequence[str], base: int = 16) -> bytes:
    """Return the bytes that the first of the words are: two hex digits or a decimal number each."""
    digits = re.compile("[0-9A-Fa-f]{2}" if base == 16 else r"\d{1,3}")
    values = (int(word, base) for word in takewhile(digits.fullmatch, words))
    return bytes(takewhile(range(256).__contains__, values))


def time_base(time_ns: int) -> str:
    """Return the kind of times of a log by one of them: since 1970, or since its own start."""
    return "absolute" if time_ns >= RELATIVE_BELOW_NS else "relative"

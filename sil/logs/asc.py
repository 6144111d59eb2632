"""Vector ASC logs (CANalyzer, CANoe, and tools that write alike).

python-can's reader takes `timestamps relative` for absolute, a length code of 9 to 15 for CAN FD
lengths, drops all but eight bytes of longer lines, and carries times as floats; so this reader
stands in front of it. Times are kept as recorded, counted from the start of the measurement; a
comment of our own writer, `// time origin S s`, tells the instant they count from.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Final

from sil.logs.asc_line import AscEvent, AscFrame, AscState, parse_event
from sil.logs.backend import Batch, LogWriter, ReadOptions
from sil.logs.byte_source import ByteSource
from sil.logs.calendar_text import parse_date, write_date
from sil.logs.frame import MAX_TIME_NS, MOST_KNOWN_IDS, LogFrame, ordinary_frame
from sil.logs.relative_text import LineReader, RelativeWriter
from sil.logs.report import LogReport
from sil.logs.text_lines import Chunk, Line, chunks, line_at
from sil.logs.times import (
    NS_PER_S,
    enough_decimals,
    format_ns,
    parse_decimal_ns,
)

_HEADER: Final = re.compile(
    r"\s*(?:date\s|base\s+(?:hex|dec)|begin\s+triggerblock|(?:no\s+)?internal\s+events)",
    re.IGNORECASE,
)
_EVENT: Final = re.compile(
    r"\s*\d+\.\d+\s+(?:CANFD\s+)?\d+\s+(?:(?:Rx|Tx)\s+)?(?:[0-9A-F]+x?\s+(?:Rx|Tx)|ErrorFrame)\b",
    re.IGNORECASE,
)
_BASE: Final = re.compile(
    r"base\s+(hex|dec)(?:\s+timestamps\s+(absolute|relative))?\s*\Z", re.IGNORECASE
)
_DATE: Final = re.compile(r"date\s+(.*)\Z", re.IGNORECASE)
_OTHER_HEADER: Final = re.compile(
    r"(?:(?:no\s+)?internal\s+events\s+logged|begin\s+triggerblock\b.*|end\s+triggerblock)\s*\Z",
    re.IGNORECASE,
)
_PLAIN: Final = re.compile(
    r"^(?: *(\d{1,9})\.(\d{1,9}) +(0|[1-9]\d{0,3}) +([0-9A-F]{1,8})(x?) +(Rx|Tx) +d ([0-8])"
    r"((?: [0-9A-F]{2}){0,8})(?: +Length = [^\n]*)?[ \r]*|([^\n]*))$",
    re.MULTILINE,
)
"""A line as nearly all are, taken apart; of any other line, the whole of it."""

_SCALE: Final = tuple(10 ** (9 - decimals) for decimals in range(10))
_ORIGIN: Final = re.compile(r"//\s*time origin (\d{1,10}\.\d{1,9}) s\s*\Z")
_TIMED: Final = re.compile(r"(\d{1,10}\.\d{1,12})\s+(\S.*)\Z")


class AscReader(LineReader):
    """State of one reading: number base, kind of times, and where they count from."""

    def __init__(self, report: LogReport) -> None:
        super().__init__(report)
        self._state = AscState()
        self._deltas = False
        self._origin_ns = 0
        self._last_ns = 0
        self._ids: dict[str, int] = {}

    def read(self, source: ByteSource) -> Iterator[Batch]:
        """Frames chunk by chunk."""
        for chunk in chunks(source):
            batch = self._plain(chunk) if self._is_plain(chunk) else self._mixed(chunk)
            if batch.frames:
                yield batch

    def _is_plain(self, chunk: Chunk) -> bool:
        """Whether the header lies before this chunk and tells hex numbers and plain times."""
        if chunk.line == 1 or chunk.unterminated or self._deltas or self._state.decimal:
            return False
        if self._origin_ns > MAX_TIME_NS // 2:
            return False
        return "base" not in chunk.text.lower()

    def _plain(self, chunk: Chunk) -> Batch:
        """The frames of a chunk in which most lines are data frames in hex."""
        frames: list[LogFrame] = []
        places: list[int] = []
        ids = self._ids
        found = _PLAIN.findall(chunk.text[:-1])
        for index, words in enumerate(found):
            seconds, fraction, channel, digits, mark, way, code, data, other = words
            can_id = ids.get(digits + mark, -1)
            if not seconds or can_id < 0 or len(data) != 3 * int(code):
                if not seconds and not other:
                    continue
                frame = self._guarded(line_at(chunk, index))
                if frame is None:
                    continue
                if seconds and len(ids) < MOST_KNOWN_IDS:
                    ids[digits + mark] = frame.can_id
            else:
                time_ns = int(seconds) * NS_PER_S + int(fraction) * _SCALE[len(fraction)]
                payload = bytes.fromhex(data)
                frame = ordinary_frame(
                    self._origin_ns + time_ns, can_id, payload, mark == "x", channel, way
                )
            frames.append(frame)
            places.append(chunk.line + index)
        return Batch(frames, places)

    def _line(self, line: Line) -> LogFrame | None:
        text = line.text.strip()
        if not text:
            return None
        timed = _TIMED.match(text)
        if timed is None:
            self._header(text)
            return None
        time_ns = parse_decimal_ns(timed[1])
        if self._deltas:
            time_ns += self._last_ns
        self._last_ns = time_ns
        event = parse_event(timed[2], self._state)
        if isinstance(event, AscEvent):
            if event.name:
                self._report.other[event.name] += 1
            return None
        return self._frame(time_ns, event, line)

    def _frame(self, time_ns: int, event: AscFrame, line: Line) -> LogFrame:
        if line.unterminated and not event.surely_whole:
            raise ValueError("the last line has no end and may be cut short")
        if event.remark:
            self._report.note(event.remark)
        if self._origin_ns + time_ns > MAX_TIME_NS:
            raise ValueError("a time out of range")
        return event.frame._replace(time_ns=self._origin_ns + time_ns)

    def _header(self, text: str) -> None:
        """Take in a line without a time."""
        report = self._report
        if text.startswith("//"):
            origin = _ORIGIN.match(text)
            if origin:
                self._origin_ns = parse_decimal_ns(origin[1])
                report.time_base = "absolute"
            return
        base = _BASE.match(text)
        if base:
            self._state.decimal = base[1].lower() == "dec"
            self._deltas = (base[2] or "").lower() == "relative"
            if self._deltas:
                report.time_base = "delta"
            return
        date = _DATE.match(text)
        if date:
            report.start_ns = parse_date(date[1])
            if report.start_ns is None:
                report.note(f"date {date[1][:40]!r} was not understood; the times do not need it")
            return
        if not _OTHER_HEADER.match(text):
            raise ValueError(f"{text[:40]!r} is no ASC line")


class AscWriter(RelativeWriter):
    """Writes classic and CANFD lines, six decimals if whole microseconds suffice, else nine."""

    format = "asc"

    def __init__(self, path: str, decimals: int | None = None) -> None:
        """decimals: 6 (times are then rounded) or 9; None for what the first frames need."""
        super().__init__(path)
        self._decimals = decimals
        self._exact = decimals is None

    def _header(self, frames: list[LogFrame]) -> str:
        if self._decimals is None:
            self._decimals = enough_decimals(frames)
        date = write_date(self._origin_ns)
        header = f"date {date}\nbase hex  timestamps absolute\ninternal events logged\n"
        if self._origin_ns:
            header += f"// time origin {format_ns(self._origin_ns, 9)} s\n"
        return header + f"Begin Triggerblock {date}\n   0.000000 Start of measurement\n"

    def _text(self, frame: LogFrame, time_ns: int) -> str:
        decimals = self._decimals
        if time_ns % 1000 and decimals == 6:
            if self._exact:
                decimals = 9
            else:
                self.losses["times rounded to the microsecond"] += 1
        stamp = format_ns(time_ns, decimals)
        number = self.channel_number(frame.channel)
        if not frame.direction and not frame.error:
            self.losses["direction not recorded, written as Rx"] += 1
        direction = frame.direction or "Rx"
        if frame.error:
            return self._error(stamp, number, direction, frame)
        identifier = f"{frame.can_id:X}{'x' if frame.extended else ''}"
        if frame.fd:
            flags = 0x10 if frame.remote else 0
            flags |= 0x1000 | frame.brs << 13 | frame.esi << 14
            spaced = frame.data.hex(" ").upper()
            return (
                f"{stamp:>11} CANFD {number:>3} {direction:<4} {identifier:>11} {'':>33} "
                f"{frame.brs:d} {frame.esi:d} {frame.dlc:x} {len(frame.data):>2} {spaced} "
                f"{0:>8} {0:>4} {flags:>8X} 0 0 0 0 0\n"
            )
        kind = "r" if frame.remote else "d"
        line = f"{stamp:>11} {number:<2} {identifier:<15} {direction:<4} {kind} {frame.dlc:X}"
        if frame.data:
            line += f" {frame.data.hex(' ').upper()}"
        return line + "\n"

    def _error(self, stamp: str, number: int, direction: str, frame: LogFrame) -> str:
        if frame.can_id or frame.data or frame.extended or frame.remote:
            self.losses["error frame class and details"] += 1
        if frame.fd:
            return f"{stamp:>11} CANFD {number:>3} {direction:<4} ErrorFrame\n"
        if frame.direction:
            self.losses["direction of an error frame"] += 1
        return f"{stamp:>11} {number:<2} ErrorFrame\n"

    def _finish(self) -> None:
        super()._finish()
        self._out.write(b"End TriggerBlock\n")


class Asc:
    """The ASC format."""

    name = "asc"
    suffixes: tuple[str, ...] = (".asc",)
    place_word = "line"

    def sniff(self, head: bytes) -> bool:
        """Whether one of the first lines is a header or frame line of an ASC log."""
        first = head.decode("latin-1").split("\n")[:200]
        return any(_HEADER.match(text) or _EVENT.match(text) for text in first)

    def batches(
        self, source: ByteSource, report: LogReport, options: ReadOptions
    ) -> Iterator[Batch]:
        """The frames of an ASC log."""
        return AscReader(report).read(source)

    def writer(self, path: str) -> LogWriter:
        """A writer of a new ASC log."""
        return AscWriter(path)

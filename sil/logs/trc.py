"""PEAK TRC logs: versions 1.0 to 2.1 are read, 2.1 is written.

Source: PEAK CAN TRC file format, as the files of PCAN-View and PEAK-Converter show it.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Final

from can_dbc.errors import InputError
from can_dbc.instants import NS_PER_S
from sil.logs.format import (
    ZONE_NOTE,
    Batch,
    NotAFrame,
    TextReader,
    leading_bytes,
    time_base,
)
from sil.logs.frame import DLC_LENGTHS, MAX_TIME_NS, LogFrame
from sil.logs.report import Location
from sil.logs.source import Chunk, Line
from sil.logs.times import NS_PER_MS, parse_decimal_ns, utc_calendar, utc_ns
from sil.logs.writer import TextWriter

_DAY_NS: Final = 86_400 * NS_PER_S
_EPOCH_DAYS: Final = 25_569  # days from 1899-12-30, where PEAK's times begin, to 1970-01-01

_VERSION_1: Final = re.compile(
    r"(\d+)\)\s+(\d+(?:\.\d+)?)\s+(?:(?:(\d{1,2})\s+)?(Rx|Tx|Warng|Error)\s+)?"
    r"([0-9A-F]{4,8})\s+(?:-\s+)?(\d{1,2})(?:\s+(.*))?\Z"
)
_PLAIN: Final = {
    version: re.compile(
        rf"^(?: *\d+\)? +(\d{{1,12}})\.(\d{{1,6}}){middle} +([0-8])((?: +[0-9A-F]{{2}}){{0,8}})[ \r]*"
        r"|([^\n]*))$",
        re.MULTILINE,
    )
    for version, middle in (
        ("1.1", r"()(?= +\w+ +([0-9A-F]{4}|[0-9A-F]{8}) ) +(Rx|Tx) +\w+"),
        ("2.1", r" +DT +([1-9]\d?) +([0-9A-F]{4}|[0-9A-F]{8}) +(Rx|Tx) +-"),
    )
}
"""Common lines: time, bus, identifier, direction, length, data; of any other line, all of it."""

_DEFAULT_COLUMNS: Final = {"2.0": "N,O,T,I,d,l,D", "2.1": "N,O,T,B,I,d,R,L,D"}
_FD_TYPES: Final = {
    "FD": (False, False),
    "FB": (True, False),
    "FE": (True, True),
    "BI": (False, True),
}
"""Bit rate switch and error state of the types of CAN FD frames."""


class TrcReader(TextReader):
    """State of one reading: version, columns, and the instant the offsets count from."""

    time_base = "relative"
    _version = ""
    _columns: Sequence[str] = ()
    _origin_ns: int | None = None
    _measuring = False

    def _quick(self, chunk: Chunk) -> Batch | None:
        if self._version == "2.1" and ",".join(self._columns) != _DEFAULT_COLUMNS["2.1"]:
            return None
        origin_ns = self._origin_ns
        if origin_ns is None or origin_ns > MAX_TIME_NS // 2 or ";$" in chunk.text:
            return None
        pattern = _PLAIN.get(self._version)
        return pattern and self._by_pattern(chunk, pattern, origin_ns, NS_PER_MS)

    def _line(self, line: Line) -> LogFrame | None:
        text = line.text.strip()
        if not text:
            return None
        if text[0] == ";":
            self._header(text, line.number)
            return None
        self._measuring = True
        if first := _VERSION_1.match(text):
            return self._version_1(first)
        if self._version.startswith("2"):
            return self._version_2(text)
        raise ValueError(f"{text[:40]!r} is no TRC line")

    def _header(self, text: str, number: int) -> None:
        report = self._report
        name, _, value = text.partition("=")
        if name == ";$FILEVERSION":
            self._version = value.strip()
            if self._version not in ("1.0", "1.1", "1.2", "1.3", "2.0", "2.1"):
                raise InputError(
                    f"{report.path}: TRC version {value[:20]!r}; expected one from 1.0 to 2.1"
                )
            self._columns = _DEFAULT_COLUMNS.get(self._version, "").split(",")
        elif name == ";$STARTTIME":
            days_ns = parse_decimal_ns(value.strip(), _DAY_NS)
            self._origin_ns = days_ns - _EPOCH_DAYS * _DAY_NS
            report.time_base = time_base(self._origin_ns)
            if report.start_ns is None and report.time_base == "absolute":
                report.start_ns = self._origin_ns
        elif name == ";$COLUMNS":
            columns = [column.strip() for column in value.split(",")]
            needed = {"O", "T", "I", "D"} <= set(columns) and {"l", "L"} & set(columns)
            if not needed or not set(columns) <= set("NOTBIdRlLDSA") or columns[-1] != "D":
                raise InputError(
                    f"{report.path}: columns {value[:40]!r}; expected N,O,T,B,I,d,R,L,D or alike"
                )
            self._columns = columns
            report.note(ZONE_NOTE)
        elif self._version in ("", "1.0") or report.start_ns is None:
            date = r"(\d\d)\.(\d\d)\.(\d{4}) (\d\d):(\d\d):(\d\d)\.(\d{3})"
            if start := re.match(rf";\s*Start time:\s*{date}", text):
                day, month, year, hour, minute, second, milli = map(int, start.groups())
                start_ns = utc_ns(year, month, day, hour, minute, second, milli * NS_PER_MS)
                report.note(ZONE_NOTE)
                if self._measuring and self._version in ("", "1.0"):
                    report.refuse_second(Location("", line=number))
                report.start_ns = start_ns

    def _time(self, text: str) -> int:
        """Milliseconds from the start as nanoseconds from 1970 or from the start."""
        offset_ns = parse_decimal_ns(text, NS_PER_MS)
        if self._origin_ns is None and self._version not in ("", "1.0"):
            self._report.note("no $STARTTIME: times are counted from the start of the log")
        return (self._origin_ns or 0) + offset_ns

    def _version_1(self, match: re.Match[str]) -> LogFrame:
        _, offset, bus, kind, digits, length_text, rest = match.groups()
        words = (rest or "").split()
        if kind == "Warng" or (kind is None and digits == "FFFFFFFF"):
            raise NotAFrame("status line")
        remote = words[:1] == ["RTR"] and kind != "Error"
        type_name = "ER" if kind == "Error" else "RR" if remote else "DT"
        direction = kind if kind in ("Rx", "Tx") else ""
        length = int(length_text)
        return self._built(type_name, offset, bus or "", digits, direction, length, words)

    def _version_2(self, text: str) -> LogFrame:
        columns = self._columns
        words = text.split(maxsplit=len(columns) - 1)
        type_at = columns.index("T")
        if len(words) <= type_at:
            raise ValueError(f"{text[:40]!r} is no TRC line")
        kind = words[type_at]
        if other := {"ST": "status line", "EC": "error counter line", "EV": "event"}.get(kind):
            raise NotAFrame(other)
        if kind not in _FD_TYPES and kind not in ("DT", "RR", "ER"):
            raise ValueError(f"{kind[:10]!r} is no type of a message")
        identifier_at = columns.index("I")
        if kind == "ER" and words[identifier_at : identifier_at + 1] in (["Rx"], ["Tx"]):
            words = text.split(maxsplit=len(columns) - 2)
            words.insert(identifier_at, "-")
        if len(words) < len(columns) - 1:
            raise ValueError(f"{len(words)} columns; expected {len(columns)}")
        column = dict(zip(columns, [*words, ""], strict=False))
        return self._frame(kind, column)

    def _frame(self, kind: str, column: dict[str, str]) -> LogFrame:
        """Return the frame of a version 2 line, from its columns by their letters."""
        bus, digits = column.get("B", ""), column["I"]
        if bus and not (bus.isdecimal() and len(bus) < 4):
            raise ValueError(f"bus {bus[:10]!r} is no number")
        coded = "L" in column
        length_text = column["L"] if coded else column["l"]
        if not (length_text.isdecimal() and int(length_text) <= (15 if coded else 64)):
            raise ValueError(f"length {length_text[:10]!r}")
        if not re.match(r"[0-9A-Fa-f]{1,8}\Z", digits):
            if kind != "ER":
                raise ValueError(f"identifier {digits[:10]!r}")
            digits = "0"
        length = int(length_text)
        if coded and kind in _FD_TYPES:
            length = DLC_LENGTHS[length]
        words, direction = column["D"].split(), column.get("d", "")
        return self._built(kind, column["O"], bus, digits, direction, length, words)

    def _built(
        self,
        kind: str,
        offset: str,
        bus: str,
        digits: str,
        direction: str,
        length: int,
        words: list[str],
    ) -> LogFrame:
        """Return a frame of a type as version 2 has them, from its texts and its data length."""
        fd, remote, error = kind in _FD_TYPES, kind == "RR", kind == "ER"
        brs, esi = _FD_TYPES.get(kind, (False, False))
        data = b"" if remote else _bytes(words, length if fd else min(length, 8))
        return LogFrame(
            self._time(offset),
            int(digits, 16),
            data,
            len(digits) > 4 and not error,
            *(remote, error, fd, brs, esi),
            channel=str(int(bus)) if bus else "",
            direction=direction,
            raw_dlc=length if remote or (not fd and not error and length > 8) else 0,
        )


def _bytes(words: list[str], length: int) -> bytes:
    """Return exactly `length` bytes; only `--` may follow. Raises ValueError for fewer or other words."""
    data = leading_bytes(words[:length])
    if len(data) != length:
        raise ValueError(f"no {length} bytes of data as stated")
    if any(word != "--" for word in words[length:]):
        raise ValueError(f"more than the {length} bytes of data stated")
    return data


class TrcWriter(TextWriter):
    """Writes version 2.1, times in milliseconds with three decimals as PEAK's own tools."""

    format = "trc"

    def __init__(self, path: str) -> None:
        super().__init__(path)
        self._number = 0

    def _header(self, frames: list[LogFrame]) -> str:
        days, part_ns = divmod(self.start_ns, _DAY_NS)
        fraction = (part_ns * 10**15 + _DAY_NS // 2) // _DAY_NS
        moment = utc_calendar(self.start_ns)
        milliseconds = self.start_ns // NS_PER_MS % 1000
        return (
            ";$FILEVERSION=2.1\n"
            f";$STARTTIME={days + _EPOCH_DAYS}.{fraction:015d}\n"
            ";$COLUMNS=N,O,T,B,I,d,R,L,D\n"
            ";\n"
            f";   Start time: {moment:%d.%m.%Y %H:%M:%S}.{milliseconds:03d}.000\n"
            ";---------------------------------------------------------------------\n"
            ";   Message   Time    Type    ID     Rx/Tx\n"
            ";   Number    Offset  |  Bus  [hex]  |  Reserved\n"
            ";   |         [ms]    |  |    |      |  |  Data Length Code\n"
            ";   |         |       |  |    |      |  |  |    Data [hex] ...\n"
            ";---+-- ------+------ +- +- --+----- +- +- +--- +- -- -- -- -- -- -- --\n"
        )

    def _line(self, frame: LogFrame) -> str:
        time_ns = self._since_start(frame)
        self.lose(time_ns % 1000, "times rounded to the microsecond")
        whole, fraction = divmod((time_ns + 500) // 1000, 1000)
        self._number += 1
        bus = self.channel_number(frame.channel)
        direction = self.direction(frame)
        identifier = f"{frame.can_id:08X}" if frame.extended else f"{frame.can_id:04X}"
        kind = "RR" if frame.remote else "DT"
        if frame.fd and not frame.remote:
            kind = (("FD", "BI"), ("FB", "FE"))[frame.brs][frame.esi]
        self.lose(frame.fd and frame.remote, "CAN FD flag of a remote frame")
        if frame.error:
            kind, identifier = "ER", "-"
            lost = frame.can_id or frame.extended or frame.fd or frame.remote
            self.lose(lost, "error frame class and flags")
            frame = frame._replace(data=self.error_data(frame))
        return (
            f"{self._number:>7} {whole:>9}.{fraction:03d} {kind} {bus:<2} {identifier:>8} "
            f"{direction} -  {frame.dlc:<2}   {frame.data.hex(' ').upper()}\n"
        )


def recognise(head: bytes) -> bool:
    """Return whether there is a TRC header, or a first line as version 1 has them."""
    text = head.decode("latin-1")
    if ";$FILEVERSION=" in text:
        return True
    lines = [line for line in text.split("\n") if line.strip() and line[0] != ";"]
    return bool(lines) and bool(re.match(r"\s*\d+\)\s+\d+(?:\.\d+)?\s+\S+\s+\S", lines[0]))

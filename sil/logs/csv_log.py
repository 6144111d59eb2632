"""CSV logs: our own table, and those of python-can, SavvyCAN (GVRET) and CSS Electronics.

Our columns: `time_s,channel,direction,id,extended,remote,error,fd,brs,esi,dlc,data`, numbers of
flags 0 or 1, id and data in hex, dlc the code on the wire; nothing of a frame is lost.
"""

from __future__ import annotations

import base64
import re
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, Final, NamedTuple

from can_dbc.errors import InputError
from sil.logs.format import Batch, NotAFrame, TextReader, time_base
from sil.logs.frame import DLC_LENGTHS, LogFrame
from sil.logs.report import LogReport, printable
from sil.logs.source import ByteSource, Line
from sil.logs.times import format_ns, parse_decimal_ns
from sil.logs.writer import TextWriter

OUR_HEADER: Final = "time_s,channel,direction,id,extended,remote,error,fd,brs,esi,dlc,data"


def _flag(text: str) -> bool:
    if text.lower() not in ("0", "1", "false", "true"):
        raise ValueError(f"{text[:10]!r} is neither 0 nor 1")
    return text.lower() in ("1", "true")


def _identifier(text: str) -> int:
    match = re.match(r"(?:0x)?([0-9A-Fa-f]{1,8})\Z", text)
    if match is None:
        raise ValueError(f"identifier {text[:12]!r} is not hex")
    return int(match[1], 16)


def _number(most: int, what: str, text: str) -> int:
    if not (text.isascii() and text.isdecimal() and len(text) < 4 and int(text) <= most):
        raise ValueError(f"{text[:10]!r} is no {what} up to {most}")
    return int(text)


def _hex_bytes(text: str) -> bytes:
    if not re.fullmatch(r"(?:[0-9A-Fa-f]{2})*", text):
        raise ValueError(f"data {text[:24]!r} is not pairs of hex digits")
    return bytes.fromhex(text)


def _base64(text: str) -> bytes:
    try:
        return base64.b64decode(text, validate=True)
    except ValueError as broken:
        raise ValueError(f"data {text[:24]!r} is not base64 ({broken})") from None


Column = tuple[str, Callable[[str], Any]]


class Dialect(NamedTuple):
    """The table of one tool: how its header begins, and what its columns are.

    columns: time first, `data` last; `length` is the number of data bytes, `dlc` the code on the wire.
    spread: each byte of the data has a column of its own.
    """

    header: str
    columns: tuple[Column, ...]
    separator: str
    spread: bool


_COLUMNS: Final[dict[str, Column]] = {
    "seconds": ("time_ns", parse_decimal_ns),
    "microseconds": ("time_ns", partial(parse_decimal_ns, unit_ns=1000)),
    "id": ("can_id", _identifier),
    "length": ("length", partial(_number, 64, "count")),
    "dlc": ("dlc", partial(_number, 15, "length code")),
    "data": ("data", _hex_bytes),
    "base64": ("data", _base64),
    "channel": ("channel", str),
    "direction": ("direction", str),
    "way": ("direction", str.capitalize),
    "is_tx": ("direction", lambda text: "Tx" if _flag(text) else "Rx"),
    **{name: (name, _flag) for name in ("extended", "remote", "error", "fd", "brs", "esi")},
}
"""The field of a frame that each kind of column holds, and how its text is read."""


_CSS_HEADER: Final = "timestampepoch;buschannel;id;ide;dlc;datalength;dir;edl;brs;{}databytes"
DIALECTS: Final = tuple(
    Dialect(
        header,
        tuple(map(_COLUMNS.__getitem__, columns.split())),
        separator=";" if ";" in header else ",",
        spread=header.endswith(",d1"),
    )
    for header, columns in (
        (OUR_HEADER, "seconds channel direction id extended remote error fd brs esi dlc data"),
        (
            "timestamp,arbitration_id,extended,remote,error,dlc,data",
            "seconds id extended remote error length base64",
        ),
        (
            "time stamp,id,extended,dir,bus,len,d1",
            "microseconds id extended way channel length data",
        ),
        ("time stamp,id,extended,bus,len,d1", "microseconds id extended channel length data"),
        (
            _CSS_HEADER.format("esi;"),
            "seconds channel id extended dlc length is_tx fd brs esi data",
        ),
        (_CSS_HEADER.format(""), "seconds channel id extended dlc length is_tx fd brs data"),
    )
)


def _dialect(header: str) -> Dialect | None:
    """Return the dialect of a header line, None if it is of none."""
    plain = header.strip().lower().replace('"', "")
    for dialect in DIALECTS:
        if plain == dialect.header or (dialect.spread and plain.startswith(dialect.header)):
            return dialect
    return None


_Middle = tuple[LogFrame, int]  # a frame without time and data, and the length of its data


def _middle(columns: tuple[Column, ...], words: list[str]) -> _Middle:
    """Return what the words between time and data say. Raises ValueError for a broken one."""
    row: dict[str, Any] = {
        name: read(word.strip()) for (name, read), word in zip(columns, words, strict=True)
    }
    length, dlc = row.pop("length", None), row.pop("dlc", None)
    remote = row.get("remote", False)
    fd = row.setdefault("fd", not remote and (length or 0) > 8)
    if length is None:
        length = DLC_LENGTHS[dlc] if fd else min(dlc, 8)
    if remote:
        row["raw_dlc"] = length if dlc is None else dlc
    elif dlc is not None and dlc > 8 and not fd:
        row["raw_dlc"] = dlc
    return LogFrame(0, **row), length


class CsvReader(TextReader):
    """State of one reading: the dialect, once the header is read."""

    _dialect: Dialect | None = None

    def __init__(self, source: ByteSource, report: LogReport, times: str) -> None:
        super().__init__(source, report, times)
        self._rows: dict[tuple[str, ...], _Middle] = {}

    def __iter__(self) -> Iterator[Batch]:
        for number, batch in enumerate(super().__iter__()):
            if number == 0:
                self._report.time_base = time_base(batch.frames[0].time_ns)
            yield batch
        if self._dialect is None:
            self._report.note("an empty file")

    def _line(self, line: Line) -> LogFrame | None:
        if not line.text.strip():
            return None
        if self._dialect is None:
            self._dialect = self._header(line.text)
            return None
        if line.text[0] in '"tT' and _dialect(line.text) is self._dialect:
            raise NotAFrame("header of a further part")
        if line.unterminated and self._dialect.spread and line.text[-2:-1] == ",":
            raise ValueError("the last line has no end and may be cut short")
        return self._frame(self._dialect, line.text)

    def _frame(self, dialect: Dialect, text: str) -> LogFrame:
        last = len(dialect.columns) - 1
        words = text.split(dialect.separator, last)
        if dialect.spread:
            after = [word.strip() for word in "".join(words[last:]).split(dialect.separator)]
            words[last:] = ["".join(word.rjust(2, "0") for word in after if word)]
        if len(words) <= last or dialect.separator in words[last]:
            count = text.count(dialect.separator) + 1
            raise ValueError(f"{count} columns; expected {last + 1} as in the header")
        key = tuple(words[1:last])
        if (middle := self._rows.get(key)) is None:
            middle = _middle(dialect.columns[1:last], words[1:last])
            if len(self._rows) < 1 << 14:
                self._rows[key] = middle
        time_ns: int = dialect.columns[0][1](words[0].strip())
        data: bytes = dialect.columns[last][1](words[last].strip())
        frame, length = middle
        if frame.remote:
            data = b""
        elif len(data) != length:
            raise ValueError(f"{len(data)} bytes of data; expected {length}")
        return tuple.__new__(LogFrame, (time_ns, frame[1], data, *frame[3:]))

    def _header(self, text: str) -> Dialect:
        """Return the dialect of the log. Raises InputError if the header is unknown."""
        if dialect := _dialect(text):
            return dialect
        names = text.strip().split(",")
        if names[0] == "time_s":
            raise InputError(
                f"{self._report.path}: line 1: holds signals ({printable(', '.join(names[1:4]))}, "
                "...), no CAN frames; expected a log of frames (convert turns this into MF4)"
            )
        raise InputError(
            f"{self._report.path}: line 1: header {printable(repr(text.strip()[:60]))} is unknown; expected "
            f"{OUR_HEADER}, or python-can's, SavvyCAN's or CSS Electronics' columns"
        )


class CsvWriter(TextWriter):
    """Writes our own table, nine decimals."""

    format = "csv"

    def _header(self, frames: list[LogFrame]) -> str:
        return OUR_HEADER + "\n"

    def _line(self, frame: LogFrame) -> str:
        if "," in frame.channel:
            raise InputError(
                f"{self.path}: channel name {frame.channel!r} has a comma in it; expected "
                "another name, or another format"
            )
        return (
            f"{format_ns(frame.time_ns, 9)},{frame.channel},{frame.direction},"
            f"{frame.can_id:X},{frame.extended:d},{frame.remote:d},{frame.error:d},"
            f"{frame.fd:d},{frame.brs:d},{frame.esi:d},{frame.dlc},{frame.data.hex().upper()}\n"
        )


def recognise(head: bytes) -> bool:
    """Return whether the first line is a header we know, of frames or of signals."""
    first = head.decode("latin-1").split("\n", 1)[0]
    return _dialect(first) is not None or first.startswith("time_s,")

"""CSV logs: our own table, and those of python-can, SavvyCAN (GVRET) and CSS Electronics.

Our columns: `time_s,channel,direction,id,extended,remote,error,fd,brs,esi,dlc,data`, numbers of
flags 0 or 1, id and data in hex, dlc the code on the wire; nothing of a frame is lost.
"""

from __future__ import annotations

import base64
import re
from collections.abc import Callable, Iterator
from typing import Any, Final, NamedTuple

from can_dbc.errors import InputError
from sil.logs.format import Batch, Format, TextReader, time_base
from sil.logs.frame import DLC_LENGTHS, LogFrame, frame_problem
from sil.logs.report import LogReport, printable
from sil.logs.source import ByteSource, Line
from sil.logs.times import format_ns, parse_decimal_ns
from sil.logs.writer import LogWriter

OUR_HEADER: Final = "time_s,channel,direction,id,extended,remote,error,fd,brs,esi,dlc,data"
_HEX: Final = re.compile(r"(?:0x)?([0-9A-Fa-f]{1,8})\Z")
_HEX_BYTES: Final = re.compile(r"(?:[0-9A-Fa-f]{2})*\Z")
_FLAGS: Final = {"0": False, "1": True, "false": False, "true": True}


def _flag(text: str) -> bool:
    if text.lower() not in _FLAGS:
        raise ValueError(f"{text[:10]!r} is neither 0 nor 1")
    return _FLAGS[text.lower()]


def _identifier(text: str) -> int:
    match = _HEX.match(text)
    if match is None:
        raise ValueError(f"identifier {text[:12]!r} is not hex")
    return int(match[1], 16)


def _count(text: str) -> int:
    if not (text.isascii() and text.isdecimal() and len(text) < 4 and int(text) <= 64):
        raise ValueError(f"{text[:10]!r} is no count up to 64")
    return int(text)


def _code(text: str) -> int:
    if _count(text) > 15:
        raise ValueError(f"{text[:10]!r} is no length code up to 15")
    return int(text)


def _hex_bytes(text: str) -> bytes:
    if not _HEX_BYTES.match(text):
        raise ValueError(f"data {text[:24]!r} is not pairs of hex digits")
    return bytes.fromhex(text)


def _base64(text: str) -> bytes:
    try:
        return base64.b64decode(text, validate=True)
    except ValueError as broken:
        raise ValueError(f"data {text[:24]!r} is not base64 ({broken})") from None


def _microseconds(text: str) -> int:
    return parse_decimal_ns(text, 1000)


def _numbered_direction(text: str) -> str:
    return "Tx" if _flag(text) else "Rx"


Column = tuple[str, Callable[[str], Any]]


class Dialect(NamedTuple):
    """The table of one tool: how its header begins, and what its columns are.

    columns: the field of a frame that each column holds, and how its text is read. `length` is the
    number of data bytes, `dlc` the code on the wire, `data` comes last.
    spread: each byte of the data has a column of its own.
    """

    header: str
    separator: str
    columns: tuple[Column, ...]
    spread: bool = False


_ID: Final[Column] = ("can_id", _identifier)
_EXTENDED: Final[Column] = ("extended", _flag)
_SECONDS: Final[Column] = ("time_ns", parse_decimal_ns)
_CHANNEL: Final[Column] = ("channel", str)
_LENGTH: Final[Column] = ("length", _count)
_DATA: Final[Column] = ("data", _hex_bytes)
_ERROR: Final[Column] = ("error", _flag)
_REMOTE: Final[Column] = ("remote", _flag)
_FD_FLAGS: Final[tuple[Column, ...]] = (("fd", _flag), ("brs", _flag), ("esi", _flag))
_GVRET: Final[tuple[Column, ...]] = (("time_ns", _microseconds), _ID, _EXTENDED)
_CSS: Final[tuple[Column, ...]] = (
    *(_SECONDS, _CHANNEL, _ID, _EXTENDED, ("dlc", _code), _LENGTH),
    *(("direction", _numbered_direction), *_FD_FLAGS),
)
_DIRECTION: Final[Column] = ("direction", str)
_OUR_FIRST: Final[tuple[Column, ...]] = (
    *(_SECONDS, _CHANNEL, _DIRECTION, _ID, _EXTENDED, _REMOTE),
)

DIALECTS: Final = (
    Dialect(
        OUR_HEADER,
        ",",
        (*_OUR_FIRST, _ERROR, *_FD_FLAGS, ("dlc", _code), _DATA),
    ),
    Dialect(
        "timestamp,arbitration_id,extended,remote,error,dlc,data",
        ",",
        (_SECONDS, _ID, _EXTENDED, _REMOTE, _ERROR, _LENGTH, ("data", _base64)),
    ),
    Dialect(
        "time stamp,id,extended,dir,bus,len,d1",
        ",",
        (*_GVRET, ("direction", str.capitalize), _CHANNEL, _LENGTH, _DATA),
        spread=True,
    ),
    Dialect("time stamp,id,extended,bus,len,d1", ",", (*_GVRET, _CHANNEL, _LENGTH, _DATA), True),
    Dialect(
        "timestampepoch;buschannel;id;ide;dlc;datalength;dir;edl;brs;esi;databytes",
        ";",
        (*_CSS, _DATA),
    ),
    Dialect(
        "timestampepoch;buschannel;id;ide;dlc;datalength;dir;edl;brs;databytes",
        ";",
        (*_CSS[:-1], _DATA),
    ),
)


def _dialect(header: str) -> Dialect | None:
    """Return the dialect of a header line, None if it is of none."""
    plain = header.strip().lower().replace('"', "")
    for dialect in DIALECTS:
        if plain == dialect.header or (dialect.spread and plain.startswith(dialect.header)):
            return dialect
    return None


def _frame(dialect: Dialect, text: str) -> LogFrame:
    """Return the frame of a row. Raises ValueError for a broken one."""
    words = [word.strip() for word in text.split(dialect.separator)]
    last = len(dialect.columns) - 1
    if dialect.spread:
        words[last:] = ["".join(word.rjust(2, "0") for word in words[last:] if word)]
    if len(words) != len(dialect.columns):
        raise ValueError(f"{len(words)} columns; expected {len(dialect.columns)} as in the header")
    row: dict[str, Any] = {
        name: read(word) for (name, read), word in zip(dialect.columns, words, strict=True)
    }
    length, dlc, data = row.pop("length", None), row.pop("dlc", None), row["data"]
    remote = row.get("remote", False)
    fd = row.setdefault("fd", not remote and (length or 0) > 8)
    if dlc is not None and length is None:
        length = DLC_LENGTHS[dlc] if fd or len(data) > 8 else min(dlc, 8)
    if remote:
        row["raw_dlc"], row["data"] = (length if dlc is None else dlc), b""
    elif len(data) != length:
        raise ValueError(f"{len(data)} bytes of data; expected {length}")
    elif dlc is not None and dlc > 8 and not fd:
        row["raw_dlc"] = dlc
    frame = LogFrame(**row)
    problem = frame_problem(frame)
    if problem is not None:
        raise ValueError(problem)
    return frame


class CsvReader(TextReader):
    """State of one reading: the dialect, once the header is read."""

    def __init__(self, report: LogReport) -> None:
        super().__init__(report)
        self._dialect: Dialect | None = None

    def read(self, source: ByteSource) -> Iterator[Batch]:
        """Yield the frames chunk by chunk."""
        first = True
        for batch in super().read(source):
            if first:
                self._report.time_base = time_base(batch.frames[0].time_ns)
                first = False
            yield batch
        if self._dialect is None:
            self._report.note("an empty file")

    def _line(self, line: Line) -> LogFrame | None:
        if not line.text.strip():
            return None
        if self._dialect is None:
            self._dialect = self._header(line.text)
            return None
        if line.unterminated and self._dialect.spread and line.text[-2:-1] == ",":
            raise ValueError("the last line has no end and may be cut short")
        return _frame(self._dialect, line.text)

    def _header(self, text: str) -> Dialect:
        """Return the dialect of the log. Raises InputError if the header is unknown."""
        dialect = _dialect(text)
        if dialect is not None:
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


class CsvWriter(LogWriter):
    """Writes our own table, nine decimals."""

    format = "csv"

    def __init__(self, path: str) -> None:
        super().__init__(path)
        self._out.write((OUR_HEADER + "\n").encode("ascii"))

    def _write_batch(self, frames: list[LogFrame]) -> None:
        rows = []
        for frame in frames:
            if "," in frame.channel:
                raise InputError(
                    f"{self.path}: channel name {frame.channel!r} has a comma in it; expected "
                    "another name, or another format"
                )
            rows.append(
                f"{format_ns(frame.time_ns, 9)},{frame.channel},{frame.direction},"
                f"{frame.can_id:X},{frame.extended:d},{frame.remote:d},{frame.error:d},"
                f"{frame.fd:d},{frame.brs:d},{frame.esi:d},{frame.dlc},{frame.data.hex().upper()}\n"
            )
        self._out.write("".join(rows).encode("ascii"))

    def _finish(self) -> None:
        """Write nothing more after the last row."""


def _recognise(head: bytes) -> bool:
    """Return whether the first line is a header we know, of frames or of signals."""
    first = head.decode("latin-1").split("\n", 1)[0]
    return _dialect(first) is not None or first.startswith("time_s,")


def _read(source: ByteSource, report: LogReport, times: str) -> Iterator[Batch]:
    return CsvReader(report).read(source)


FORMAT: Final = Format("csv", (".csv",), _recognise, _read, CsvWriter)

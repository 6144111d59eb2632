"""CSV logs: our own table written; that, python-can's, SavvyCAN's and CSS Electronics' read.

Our columns: `time_s,channel,direction,id,extended,remote,error,fd,brs,esi,dlc,data`, numbers of
flags 0 or 1, id and data in hex, dlc the code on the wire; nothing of a frame is lost.
"""

from __future__ import annotations

import base64
import binascii
import re
from collections.abc import Callable, Iterator
from typing import Final

from can_dbc.errors import InputError
from sil.logs.backend import Batch, LogWriter, ReadOptions
from sil.logs.byte_source import ByteSource
from sil.logs.frame import DLC_LENGTHS, LogFrame, frame_problem
from sil.logs.report import LogReport, Place, printable
from sil.logs.text_lines import Line, lines
from sil.logs.times import RELATIVE_BELOW_NS, format_ns, parse_decimal_ns

OUR_HEADER: Final = "time_s,channel,direction,id,extended,remote,error,fd,brs,esi,dlc,data"
_PYTHON_CAN: Final = "timestamp,arbitration_id,extended,remote,error,dlc,data"
_SAVVYCAN: Final = "time stamp,id,extended,dir,bus,len,d1,"
_CSS: Final = "timestampepoch;buschannel;id;ide;dlc;datalength;dir;edl;brs"
_HEX: Final = re.compile(r"(?:0x)?([0-9A-Fa-f]{1,8})\Z")
_HEX_BYTES: Final = re.compile(r"(?:[0-9A-Fa-f]{2})*\Z")
_FLAGS: Final = {"0": False, "1": True, "false": False, "true": True}


def _flag(text: str) -> bool:
    value = _FLAGS.get(text.strip().lower())
    if value is None:
        raise ValueError(f"{text[:10]!r} is neither 0 nor 1")
    return value


def _identifier(text: str) -> int:
    match = _HEX.match(text.strip())
    if match is None:
        raise ValueError(f"identifier {text[:12]!r} is not hex")
    return int(match[1], 16)


def _count(text: str, most: int) -> int:
    text = text.strip()
    if not (text.isascii() and text.isdecimal() and len(text) < 4 and int(text) <= most):
        raise ValueError(f"{text[:10]!r} is no count up to {most}")
    return int(text)


def _hex_bytes(text: str) -> bytes:
    text = text.strip()
    if not _HEX_BYTES.match(text):
        raise ValueError(f"data {text[:24]!r} is not pairs of hex digits")
    return bytes.fromhex(text)


def _require_columns(found: list[str], count: int) -> None:
    if len(found) != count:
        raise ValueError(f"{len(found)} columns where the header tells {count}")


def _require_length(data: bytes, length: int) -> None:
    if len(data) != length:
        raise ValueError(f"{len(data)} bytes of data where {length} are told")


def _ours(text: str) -> LogFrame:
    found = text.split(",")
    _require_columns(found, 12)
    remote, error, fd = _flag(found[5]), _flag(found[6]), _flag(found[7])
    dlc = _count(found[10], 15)
    data = _hex_bytes(found[11])
    raw_dlc = 0
    if remote:
        raw_dlc = dlc
    elif fd or len(data) > 8:
        _require_length(data, DLC_LENGTHS[dlc])
    else:
        _require_length(data, min(dlc, 8))
        raw_dlc = dlc if dlc > 8 else 0
    return LogFrame(
        parse_decimal_ns(found[0]),
        _identifier(found[3]),
        data,
        _flag(found[4]),
        remote,
        error,
        fd,
        _flag(found[8]),
        _flag(found[9]),
        found[1],
        found[2],
        raw_dlc,
    )


def _python_can(text: str) -> LogFrame:
    found = text.split(",")
    _require_columns(found, 7)
    remote, length = _flag(found[3]), _count(found[5], 64)
    try:
        data = base64.b64decode(found[6].strip(), validate=True)
    except binascii.Error as broken:
        raise ValueError(f"data {found[6][:24]!r} is not base64 ({broken})") from None
    if not remote:
        _require_length(data, length)
    return LogFrame(
        parse_decimal_ns(found[0]),
        _identifier(found[1]),
        b"" if remote else data,
        _flag(found[2]),
        remote,
        _flag(found[4]),
        fd=length > 8,
        raw_dlc=length if remote else 0,
    )


def _savvycan(text: str) -> LogFrame:
    found = text.rstrip(",").split(",")
    if len(found) < 6:
        raise ValueError(f"{len(found)} columns where at least 6 are needed")
    length = _count(found[5], 64)
    data = _hex_bytes("".join(word.strip().rjust(2, "0") for word in found[6:] if word.strip()))
    _require_length(data, length)
    return LogFrame(
        parse_decimal_ns(found[0].strip(), 1000),
        _identifier(found[1]),
        data,
        _flag(found[2]),
        fd=length > 8,
        channel=found[4].strip(),
        direction=found[3].strip().capitalize(),
    )


def _css(text: str) -> LogFrame:
    found = text.split(";")
    if len(found) not in (10, 11):
        raise ValueError(f"{len(found)} columns where the header tells 10 or 11")
    data = _hex_bytes(found[-1])
    _require_length(data, _count(found[5], 64))
    fd = _flag(found[7])
    dlc = _count(found[4], 15)
    return LogFrame(
        parse_decimal_ns(found[0]),
        _identifier(found[2]),
        data,
        _flag(found[3]),
        fd=fd,
        brs=_flag(found[8]),
        esi=_flag(found[9]) if len(found) == 11 else False,
        channel=found[1].strip(),
        direction=("Rx", "Tx")[_flag(found[6])],
        raw_dlc=dlc if not fd and dlc > 8 else 0,
    )


def _row_parser(header: str) -> Callable[[str], LogFrame] | None:
    """The reading of the rows under a header line, or None for an unknown header."""
    plain = header.strip().lower().replace('"', "")
    if plain == OUR_HEADER:
        return _ours
    if plain == _PYTHON_CAN:
        return _python_can
    if plain.startswith(_SAVVYCAN):
        return _savvycan
    if plain.startswith(_CSS) and plain.endswith("databytes"):
        return _css
    return None


class CsvReader:
    """State of one reading."""

    def __init__(self, report: LogReport) -> None:
        self._report = report
        self._row: Callable[[str], LogFrame] | None = None

    def read(self, source: ByteSource) -> Iterator[Batch]:
        """Frames in batches."""
        report = self._report
        frames: list[LogFrame] = []
        places: list[int] = []
        for line in lines(source):
            if not line.text.strip():
                continue
            if self._row is None:
                self._row = self._header(line.text)
                continue
            try:
                if line.unterminated and self._row is _savvycan and line.text[-2:-1] == ",":
                    raise ValueError("the last line has no end and may be cut short")
                frame = self._row(line.text)
                problem = frame_problem(frame)
                if problem is not None:
                    raise ValueError(problem)
            except ValueError as error:
                self._broken(line, str(error))
                continue
            frames.append(frame)
            places.append(line.number)
            if len(frames) >= 4096:
                self._tell_base(frames)
                yield Batch(frames, places)
                frames, places = [], []
        if frames:
            self._tell_base(frames)
            yield Batch(frames, places)
        if self._row is None:
            report.note("an empty file")

    def _tell_base(self, frames: list[LogFrame]) -> None:
        if not self._report.frames:
            absolute = frames[0].time_ns >= RELATIVE_BELOW_NS
            self._report.time_base = "absolute" if absolute else "relative"

    def _broken(self, line: Line, reason: str) -> None:
        place = Place(reason, line.number, line.byte)
        if line.unterminated:
            self._report.cut(place)
        else:
            self._report.skip(place)

    def _header(self, text: str) -> Callable[[str], LogFrame]:
        row = _row_parser(text)
        if row is None:
            names = text.strip().split(",")
            if names[0] == "time_s":
                signals = printable(", ".join(names[1:4]))
                raise InputError(
                    f"{self._report.path}: line 1: holds signals ({signals}, ...), no CAN frames; "
                    "expected a log of frames (convert turns this into MF4)"
                )
            raise InputError(
                f"{self._report.path}: line 1: header {text.strip()[:60]!r} is unknown; expected "
                f"{OUR_HEADER}, or python-can's, SavvyCAN's or CSS Electronics' columns"
            )
        return row


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
                raise InputError(f"{self.path}: channel name {frame.channel!r} has a comma in it")
            rows.append(
                f"{format_ns(frame.time_ns, 9)},{frame.channel},{frame.direction},"
                f"{frame.can_id:X},{frame.extended:d},{frame.remote:d},{frame.error:d},"
                f"{frame.fd:d},{frame.brs:d},{frame.esi:d},{frame.dlc},{frame.data.hex().upper()}\n"
            )
        self._out.write("".join(rows).encode("ascii"))

    def _finish(self) -> None:
        """There is nothing after the last row."""


class CsvLog:
    """The CSV formats."""

    name = "csv"
    suffixes: tuple[str, ...] = (".csv",)
    place_word = "line"

    def sniff(self, head: bytes) -> bool:
        """Whether the first line is a header we know, of frames or of signals."""
        first = head.decode("latin-1").split("\n", 1)[0]
        return _row_parser(first) is not None or first.startswith("time_s,")

    def batches(
        self, source: ByteSource, report: LogReport, options: ReadOptions
    ) -> Iterator[Batch]:
        """The frames of a CSV log."""
        return CsvReader(report).read(source)

    def writer(self, path: str) -> LogWriter:
        """A writer of our own table."""
        return CsvWriter(path)

"""Vector ASC logs (CANalyzer, CANoe, and tools that write alike).

Times are those recorded, counted from the start of the measurement: the `date`, or, as python-can
writes it, that of the trigger block. A comment of our own writer, `// time origin S s`, gives the
instant that they count from.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Final, NamedTuple

from can_dbc.errors import InputError
from can_dbc.instants import NS_PER_S
from sil.logs.format import ZONE_NOTE, Batch, NotAFrame, TextReader, leading_bytes
from sil.logs.frame import DLC_LENGTHS, MAX_TIME_NS, LogFrame
from sil.logs.report import Location
from sil.logs.source import Chunk, Line
from sil.logs.times import enough_decimals, format_ns, parse_date, parse_decimal_ns, write_date
from sil.logs.writer import TextWriter

_PLAIN: Final = re.compile(
    r"^(?: *(\d{1,9})\.(\d{1,9}) +(0|[1-9]\d{0,3}) +([0-9A-F]{1,8}x?) +(Rx|Tx) +d ([0-8])"
    r"((?: [0-9A-F]{2}){0,8})(?: +Length = [^\n]*)?[ \r]*|([^\n]*))$",
    re.MULTILINE,
)
"""A common line by its parts; any other line in one piece."""

_FLAG_REMOTE: Final = 0x10


_CLASSIC = re.compile(
    r"(\d{1,5})\s+([0-9A-Fa-f]{1,10})(x?)\s+(Rx|TxRq|Tx)\s+([dr])(?:\s+(.*))?\Z", re.IGNORECASE
)
_FD = re.compile(
    r"CANFD\s+(\d{1,5})\s+(Rx|TxRq|Tx)\s+([0-9A-F]{1,8})(x?)\s+(?:(?![01]\s+[01]\s+(?:[0-9A-F]|1[0-5])\s+\d)"
    r"([A-Za-z_]\S*)\s+)?([01])\s+([01])\s+([0-9A-F]|1[0-5])\s+(\d{1,2})(?:\s+(.*))?\Z",
    re.IGNORECASE,
)
_TIMED: Final = re.compile(r"(\d{1,10}\.\d{1,12})\s+(\S.*)\Z")
_HEX_WORD = re.compile(r"[0-9A-Fa-f]{1,8}\Z")
_OTHER_EVENTS: Final = {
    r"start of measurement": "",
    r"CAN\s+\d+\s+|\d+\s+Statistic:": "status line",
    r"\d+\s+J1939TP\b": "reassembled J1939 message",
    r"\d+\s+OverloadFrame\b": "overload frame",
    r"CANXL\b": "CAN XL frame",
    r"\d+\s+[A-Z_]\w*x?\s+(?:Rx|Tx|TxRq)\s": "frame with a symbolic name instead of its identifier",
}


class WrongBase(Exception):
    """The bytes of a line are of the other number base than the header states."""


class _Event(NamedTuple):
    """A frame without its time, and whether its line is surely whole."""

    frame: LogFrame
    whole: bool = True


def parse_event(text: str, decimal: bool) -> _Event:
    """Parse the line after its time; decimal: its numbers are decimal, not hex.

    Raises NotAFrame for an event of another kind, ValueError for a broken frame line, WrongBase for
    one that proves the other base.
    """
    if classic := _CLASSIC.match(text):
        return _classic(classic, decimal)
    error = re.match(
        r"(\d{1,5})\s+ErrorFrame\b|CANFD\s+(\d{1,5})\s+(Rx|TxRq|Tx)\s+ErrorFrame\b",
        text,
        re.IGNORECASE,
    )
    if error:
        channel, fd = error[1] or error[2], error[1] is None
        direction = error[3].capitalize() if (error[3] or "").lower() in ("rx", "tx") else ""
        frame = LogFrame(0, 0, b"", False, error=True, fd=fd, channel=str(int(channel)))
        return _Event(frame._replace(direction=direction))
    if text[:5].upper() == "CANFD":
        return _fd(text, decimal)
    for pattern, name in _OTHER_EVENTS.items():
        if re.match(pattern, text, re.IGNORECASE):
            raise NotAFrame(name)
    if re.match(
        r"\d+\s+\S+\s+(?:Rx|Tx|TxRq)\b|\d+\s+[0-9A-F]+x?\s+\S+\s+[dr]\b|"
        r"\d+\s+[0-9A-F]{1,8}x?(?:\s+[RT])?\s*\Z",
        text,
        re.IGNORECASE,
    ):
        raise ValueError(f"{text[:40]!r} is not a whole frame")
    raise NotAFrame("event of another kind")


def _direction(word: str) -> str:
    """Return Rx or Tx. Raises NotAFrame for a request to send, which is no frame on the bus."""
    if word.lower() == "txrq":
        raise NotAFrame("request to send")
    return word.capitalize()


def _identifier(digits: str, decimal: bool) -> int:
    if decimal and not digits.isdecimal():
        raise ValueError(f"identifier {digits}; expected a decimal number as the header states")
    return int(digits, 10 if decimal else 16)


def _check_base(words: Sequence[str], count: int, decimal: bool) -> None:
    """Raise WrongBase if `count` words are bytes, and only in the other base."""
    here, other = (r"\d{1,3}", "[0-9A-Fa-f]{2}") if decimal else ("[0-9A-Fa-f]{2}", r"\d{1,3}")
    data = words[:count]
    whole = 0 < count == len(data) and all(re.fullmatch(other, word) for word in data)
    if whole and not all(re.fullmatch(here, word) for word in data):
        raise WrongBase


def _classic(match: re.Match[str], decimal: bool) -> _Event:
    channel, digits, extended, way, kind, rest = match.groups()
    base = 10 if decimal else 16
    code_text, *words = (rest or "").split() or [""]
    is_hex = bool(_HEX_WORD.match(code_text))
    _check_base(words, int(code_text, 16) if is_hex else 0, decimal)
    can_id = _identifier(digits, decimal)
    frame = LogFrame(0, can_id, b"", bool(extended), channel=str(int(channel)))
    frame = frame._replace(direction=_direction(way))
    coded = is_hex and len(code_text) <= 2
    if kind.lower() == "r":
        raw_dlc = int(code_text, base) if coded and (base == 16 or code_text.isdecimal()) else 0
        return _Event(frame._replace(remote=True, raw_dlc=raw_dlc), coded or bool(words))
    if not coded:
        raise ValueError("no length after d")
    if decimal and not code_text.isdecimal():
        raise ValueError(f"length {code_text} ; expected a decimal number as the header states")
    code = int(code_text, base)
    data = leading_bytes(words, base)
    length, raw_dlc, fd = code, 0, code > 8 and len(data) > 8
    if code > 8 and not fd:
        length, raw_dlc = 8, code
    if len(data) != length or code > 64:
        raise ValueError(f"{len(data)} bytes of data; expected {code_text}")
    whole = not decimal or len(words) > length
    return _Event(frame._replace(data=data, fd=fd, raw_dlc=raw_dlc), whole)


def _fd(text: str, decimal: bool) -> _Event:
    match = _FD.match(text)
    if match is None:
        raise ValueError(f"{text[:40]!r} is no whole CANFD line")
    channel, way, digits, extended, _name, brs, esi, code_text, length_text, rest = match.groups()
    direction = _direction(way)
    length, code = int(length_text), int(code_text, 10 if len(code_text) == 2 else 16)
    words = (rest or "").split()
    _check_base(words, length, decimal)
    data = leading_bytes(words[:length], 10 if decimal else 16)
    if len(data) != length:
        raise ValueError(f"{len(data)} bytes of data; expected {length}")
    flags_text = words[length + 2] if len(words) > length + 2 else ""
    flags = int(flags_text, 16) if _HEX_WORD.match(flags_text) else None
    remote = length == 0 and (code > 0 or bool(flags and flags & _FLAG_REMOTE))
    # A remote frame of can-utils has no other flag if it is classic.
    fd = flags != _FLAG_REMOTE if remote else flags is None or bool(flags & 0x1000)
    fd = fd or length > 8 or brs == "1" or esi == "1"
    if not remote and length != (DLC_LENGTHS[code] if fd else min(code, 8)):
        raise ValueError(f"length code {code_text} does not match {length} bytes")
    can_id, raw_dlc = _identifier(digits, decimal), code if remote or (not fd and code > 8) else 0
    kinds = bool(extended), remote, False, fd, brs == "1", esi == "1"
    frame = LogFrame(0, can_id, data, *kinds, str(int(channel)), direction, raw_dlc)
    return _Event(frame, len(words) > length + 3)


class AscReader(TextReader):
    """State of one reading: number base, kind of times, and where they count from."""

    time_base = "relative"
    _decimal = _deltas = False
    _origin_ns = _last_ns = 0
    _block_ns: int | None = None
    _measuring = False  # a line with a time came

    def _quick(self, chunk: Chunk) -> Batch | None:
        """Return the frames if the header came before and has hex numbers and plain times."""
        odd = chunk.line == 1 or self._deltas or self._decimal
        text = chunk.text.lower()
        if odd or self._origin_ns > MAX_TIME_NS // 2 or "base" in text or "date" in text:
            return None
        self._measuring = True
        return self._by_pattern(chunk, _PLAIN, self._origin_ns, NS_PER_S)

    def _line(self, line: Line) -> LogFrame | None:
        text = line.text.strip()
        if not text:
            return None
        timed = _TIMED.match(text)
        if timed is None:
            self._header(text, line.number)
            return None
        self._measuring = True
        time_ns = parse_decimal_ns(timed[1])
        if self._deltas:
            time_ns += self._last_ns
        self._last_ns = time_ns
        try:
            event = parse_event(timed[2], self._decimal)
        except WrongBase:
            is_hex = "decimal" if self._decimal else "hex"
            raise InputError(
                f"{self._report.path}: line {line.number}: its bytes are not {is_hex}, as the header has it; "
                f"expected base {'hex' if self._decimal else 'dec'} in the header"
            ) from None
        except NotAFrame as other:
            if line.unterminated and other.name:
                raise ValueError("the last line has no end and may be cut short") from None
            # "Start of measurement" at 0: times count from the date of the block (python-can)
            if not other.name and time_ns == 0 and self._block_ns is not None:
                self._count_from(self._block_ns)
            raise
        if line.unterminated and not event.whole:
            raise ValueError("the last line has no end and may be cut short")
        return event.frame._replace(time_ns=self._origin_ns + time_ns)

    def _header(self, text: str, number: int) -> None:
        """Take in a line without a time. Raises ValueError if it is no header, InputError if it is broken."""
        report = self._report
        if text.startswith("//"):
            if origin := re.match(r"//\s*time origin (\d{1,10}\.\d{1,9}) s\s*\Z", text):
                self._origin_ns = parse_decimal_ns(origin[1])
                report.time_base = "absolute"
                report.notes[:] = [note for note in report.notes if note != ZONE_NOTE]
            return
        word, _, rest = text.lower().partition(" ")
        if word in ("base", "timestamps"):
            rest = text.lower() if word == "timestamps" else rest
            events = r"(?:\s*(?:no\s+)?internal events logged)?"
            times = r"(?:\s*timestamps\s+(absolute|relative))?"
            stated = re.fullmatch(rf"(?:\s*(hex|dec))?{events}{times}{events}\s*", rest)
            if stated is None or not (stated[1] or word == "timestamps"):
                expected = "base hex|dec  timestamps absolute|relative"
                raise InputError(
                    f"{report.path}: line {number}: {text[:60]!r}; expected {expected}"
                )
            if stated[1]:
                self._decimal = stated[1] == "dec"
            if stated[2] or word == "base":
                self._deltas = stated[2] == "relative"
            report.time_base = "delta" if self._deltas else report.time_base
            return
        if word == "date":
            start_ns = parse_date(text[4:])
            if start_ns is None:
                expected = "expected one as date Sat Sep 30 10:06:13.191 2017"
                raise InputError(f"{report.path}: line {number}: {text[:60]!r}; {expected}")
            if self._measuring:
                report.refuse_second(Location("", line=number))
            self._count_from(start_ns)
            return
        if block := re.match(r"begin\s+triggerblock\b(.*)\Z", text, re.IGNORECASE):
            self._block_ns = parse_date(block[1])
        elif not re.match(
            r"(?:(?:no\s+)?internal\s+events\s+logged|end\s+triggerblock)\s*\Z", text, re.IGNORECASE
        ):
            raise ValueError(f"{text[:40]!r} is no ASC line")

    def _count_from(self, start_ns: int) -> None:
        """Set the start of the measurement, which a header states without a zone."""
        self._report.note(ZONE_NOTE)
        self._report.start_ns = start_ns


class AscWriter(TextWriter):
    """Writes classic and CANFD lines, six decimals if whole microseconds suffice, else nine."""

    format = "asc"

    def _header(self, frames: list[LogFrame]) -> str:
        self._decimals = enough_decimals(frames)
        base = "base hex  timestamps absolute\ninternal events logged\n"
        start = "   0.000000 Start of measurement\n"
        if not self.start_ns:
            return f"{base}Begin Triggerblock\n{start}"
        date = write_date(self.start_ns)
        origin = f"// time origin {format_ns(self.start_ns, 9)} s\n"
        return f"date {date}\n{base}{origin}Begin Triggerblock {date}\n{start}"

    def _line(self, frame: LogFrame) -> str:
        time_ns = self._since_start(frame)
        stamp = format_ns(time_ns, 9 if time_ns % 1000 else self._decimals)
        number = self.channel_number(frame.channel)
        if frame.error:
            return self._error(stamp, number, frame)
        direction = self.direction(frame)
        identifier = f"{frame.can_id:X}{'x' if frame.extended else ''}"
        if frame.fd:
            flags = _FLAG_REMOTE if frame.remote else 0
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

    def _error(self, stamp: str, number: int, frame: LogFrame) -> str:
        lost = frame.can_id or frame.data or frame.extended or frame.remote
        self.lose(lost, "error frame class and details")
        if frame.fd:
            return f"{stamp:>11} CANFD {number:>3} {frame.direction or 'Rx':<4} ErrorFrame\n"
        self.lose(frame.direction, "direction of an error frame")
        return f"{stamp:>11} {number:<2} ErrorFrame\n"

    def _finish(self) -> None:
        self._out.write(b"End TriggerBlock\n")


def recognise(head: bytes) -> bool:
    """Return whether one of the first lines is a header or frame line of an ASC log."""
    mark = re.compile(
        r"\s*(?:date\s|base\s+(?:hex|dec)|begin\s+triggerblock|(?:no\s+)?internal\s+events|"
        r"\d+\.\d+\s+(?:CANFD\s+)?\d+\s+(?:(?:Rx|Tx)\s+)?(?:[0-9A-F]+x?\s+(?:Rx|Tx)|ErrorFrame)\b)",
        re.IGNORECASE,
    )
    return any(map(mark.match, head.decode("latin-1").split("\n")[:200]))

"""One event of an ASC log (the line after its time) as a frame or a named event."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Final, NamedTuple

from sil.logs.frame import DLC_LENGTHS, LogFrame, frame_problem


@dataclass(slots=True)
class AscState:
    """What the header said about the lines: numbers in decimal instead of hex."""

    decimal: bool = False


class AscEvent(NamedTuple):
    """A line that is no frame; `name` is "" for what need not be counted."""

    name: str


class AscFrame(NamedTuple):
    """A frame (its time not set) and whether nothing after the line's last character can matter."""

    frame: LogFrame
    surely_whole: bool
    remark: str = ""


_CLASSIC = re.compile(
    r"(\d{1,5})\s+([0-9A-Fa-f]{1,10})(x?)\s+(Rx|TxRq|Tx)\s+([dr])(?:\s+(.*))?\Z", re.IGNORECASE
)
_CLASSIC_LOOK = re.compile(r"\d+\s+\S+\s+(?:Rx|Tx|TxRq)\b|\d+\s+[0-9A-F]+x?\s+\S+\s+[dr]\b", re.I)
_SYMBOLIC = re.compile(r"\d+\s+[A-Za-z_]\w*x?\s+(?:Rx|Tx|TxRq)\s", re.IGNORECASE)
_ERROR = re.compile(r"(\d{1,5})\s+ErrorFrame\b", re.IGNORECASE)
_FD = re.compile(
    r"CANFD\s+(\d{1,5})\s+(Rx|TxRq|Tx)\s+([0-9A-F]{1,8})(x?)\s+(?:(?![01]\s+[01]\s+[0-9A-F]\s+\d)"
    r"([A-Za-z_]\S*)\s+)?([01])\s+([01])\s+([0-9A-F])\s+(\d{1,2})(?:\s+(.*))?\Z",
    re.IGNORECASE,
)
_FD_ERROR = re.compile(r"CANFD\s+(\d{1,5})\s+(Rx|TxRq|Tx)\s+ErrorFrame\b", re.IGNORECASE)
_HEX_BYTE = re.compile(r"[0-9A-Fa-f]{2}\Z")
_DECIMAL_BYTE = re.compile(r"\d{1,3}\Z")
_HEX_WORD = re.compile(r"[0-9A-Fa-f]{1,8}\Z")
_NAMED: Final = (
    (re.compile(r"start of measurement", re.I), ""),
    (re.compile(r"CAN\s+\d+\s+Status:|\d+\s+Statistic:|CAN\s+\d+\s+", re.I), "status line"),
    (re.compile(r"\d+\s+J1939TP\b", re.I), "reassembled J1939 message"),
    (re.compile(r"\d+\s+OverloadFrame\b", re.I), "overload frame"),
    (re.compile(r"CANXL\b", re.I), "CAN XL frame"),
)


def parse_event(text: str, state: AscState) -> AscFrame | AscEvent:
    """Parse the line after its time.

    Raises: ValueError with the reason for a broken frame line.
    Checked by: tests/unit/sil/logs/test_asc.py.
    """
    classic = _CLASSIC.match(text)
    if classic:
        return _classic(classic, state)
    if text[:5].upper() == "CANFD":
        return _fd(text, state)
    error = _ERROR.match(text)
    if error:
        frame = LogFrame(0, 0, b"", False, error=True, channel=_channel(error[1]))
        return AscFrame(frame, True)
    for pattern, name in _NAMED:
        if pattern.match(text):
            return AscEvent(name)
    if _SYMBOLIC.match(text):
        return AscEvent("frame with a symbolic name in place of its identifier")
    if _CLASSIC_LOOK.match(text):
        raise ValueError(f"{text[:40]!r} is no whole frame")
    return AscEvent("event of another kind")


def _channel(digits: str) -> str:
    return str(int(digits))


def _direction(word: str) -> str | None:
    """Rx or Tx; None for a request to send, which is no frame on the bus."""
    return {"rx": "Rx", "tx": "Tx"}.get(word.lower())


def _bytes(words: list[str], decimal: bool) -> bytes:
    """The bytes at the beginning of a list of words."""
    pattern, base = (_DECIMAL_BYTE, 10) if decimal else (_HEX_BYTE, 16)
    found = []
    for word in words:
        if not pattern.match(word) or int(word, base) > 255:
            break
        found.append(int(word, base))
    return bytes(found)


def _checked(frame: LogFrame, surely_whole: bool, remark: str = "") -> AscFrame:
    problem = frame_problem(frame)
    if problem:
        raise ValueError(problem)
    return AscFrame(frame, surely_whole, remark)


def _classic(match: re.Match[str], state: AscState) -> AscFrame | AscEvent:
    channel, digits, extended, way, kind, rest = match.groups()
    base = 10 if state.decimal else 16
    if state.decimal and not digits.isdecimal():
        raise ValueError(f"identifier {digits} is not decimal as the header tells")
    direction = _direction(way)
    words = (rest or "").split()
    if direction is None:
        return AscEvent("request to send")
    can_id = int(digits, base)
    code_text = words[0] if words else ""
    if kind.lower() == "r":
        coded = bool(_HEX_WORD.match(code_text)) and len(code_text) <= 2
        raw_dlc = int(code_text, base) if coded and (base == 16 or code_text.isdecimal()) else 0
        frame = LogFrame(
            0,
            can_id,
            b"",
            bool(extended),
            remote=True,
            channel=_channel(channel),
            direction=direction,
            raw_dlc=raw_dlc,
        )
        return _checked(frame, coded or len(words) > 1)
    if not _HEX_WORD.match(code_text) or len(code_text) > 2:
        raise ValueError("no length after d")
    if state.decimal and not code_text.isdecimal():
        raise ValueError(f"length {code_text} is not decimal as the header tells")
    code = int(code_text, base)
    data = _bytes(words[1:], state.decimal)
    length, raw_dlc, fd, remark = code, 0, False, ""
    if code > 8 and len(data) <= 8:
        length, raw_dlc = 8, code
    elif code > 8:
        fd, remark = True, "classic lines with more than 8 bytes were read as CAN FD"
    if len(data) != length or code > 64:
        raise ValueError(f"{len(data)} bytes of data where {code_text} is told")
    frame = LogFrame(
        0,
        can_id,
        data,
        bool(extended),
        fd=fd,
        channel=_channel(channel),
        direction=direction,
        raw_dlc=raw_dlc,
    )
    return _checked(frame, not state.decimal or len(words) > 1 + length, remark)


def _fd(text: str, state: AscState) -> AscFrame | AscEvent:
    error = _FD_ERROR.match(text)
    if error:
        frame = LogFrame(
            0,
            0,
            b"",
            False,
            error=True,
            fd=True,
            channel=_channel(error[1]),
            direction=_direction(error[2]) or "",
        )
        return AscFrame(frame, True)
    match = _FD.match(text)
    if match is None:
        raise ValueError(f"{text[:40]!r} is no whole CANFD line")
    channel, way, digits, extended, _name, brs, esi, code_text, length_text, rest = match.groups()
    direction = _direction(way)
    if direction is None:
        return AscEvent("request to send")
    code, length = int(code_text, 16), int(length_text)
    words = (rest or "").split()
    data = _bytes(words[:length], False)
    if len(data) != length:
        raise ValueError(f"{len(data)} bytes of data where {length} are told")
    flags_text = words[length + 2] if len(words) > length + 2 else ""
    flags = int(flags_text, 16) if _HEX_WORD.match(flags_text) else None
    remote = length == 0 and (code > 0 or bool(flags and flags & 0x10))
    fd = remote or flags is None or bool(flags & 0x1000)
    if not fd and (length > 8 or brs == "1" or esi == "1"):
        fd = True
    raw_dlc = code if remote else 0
    if not remote:
        if length != (DLC_LENGTHS[code] if fd else min(code, 8)):
            raise ValueError(f"length code {code_text} beside {length} bytes")
        raw_dlc = code if not fd and code > 8 else 0
    frame = LogFrame(
        0,
        int(digits, 16),
        data,
        bool(extended),
        remote,
        False,
        fd,
        brs == "1",
        esi == "1",
        _channel(channel),
        direction,
        raw_dlc,
    )
    return _checked(frame, len(words) > length + 3)

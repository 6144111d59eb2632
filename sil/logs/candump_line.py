"""One line of candump output, in any of its forms, as a frame.

Forms: the log form of `candump -l` (`(1.000000) can0 123#1122 R`), the screen form with absolute,
dated, delta, zero-based or no times, extra message information, ASCII, binary or swapped data,
colours; numbered lines and trailing remarks as J1939 printers write them; TruckDevil's print.
Source: can-utils' own printing (lib.c, candump.c).
"""

from __future__ import annotations

import re
from typing import Final, NamedTuple

from sil.logs.frame import LogFrame, frame_problem
from sil.logs.times import parse_decimal_ns, utc_ns

ERROR_FLAG: Final = 0x20000000
DROPPED: Final = "frame dropped by the recorder"


class NotAFrame(Exception):
    """A line that belongs in such a log and is no frame.

    name: what it is, "" for what need not be counted; count: how many of these it stands for.
    """

    def __init__(self, name: str, count: int = 1) -> None:
        super().__init__(name)
        self.name = name
        self.count = count


class Parsed(NamedTuple):
    """A line's frame (its time 0 when it has none) and what else the line told.

    length_told: the line itself says how many bytes of data there are.
    ended: the line's last word is whole, whatever may have followed it.
    """

    frame: LogFrame
    timed: bool
    length_told: bool


_ANSI = re.compile(r"\x1b\[[0-9;]*m")
_TIME = re.compile(r"(?:\d{1,12}\s+)?\(([^()]{1,48})\)\s+")
_DATE = re.compile(r"(\d{4})-(\d\d)-(\d\d) (\d\d):(\d\d):(\d\d)\.(\d{6}|\d{9})\Z")
_COMPACT = re.compile(r"([!-~]{1,64})\s+([0-9A-Fa-f]{1,8})#(\S*)(?:\s+([RT]))?\s*(?:\s;.*)?\Z")
_SCREEN = re.compile(
    r"([!-~]{1,64})\s+(?:(RX|TX) ([BS-]) ([ER-])\s+)?([0-9A-F]{3}|[0-9A-F]{8})\s+"
    r"(?:\[(\d{1,2})\]|\{([0-9A-F])\})(.*)\Z"
)
_SCREEN_XL = re.compile(r"\S{1,64}\s.*\[\d{4}\] \([0-9A-F]{2}\|[0-9A-F]{2}:")
_SCREEN_DATA = re.compile(
    r"\s*((?:[0-9A-F]{2}|[01]{8})(?:[ `](?:[0-9A-F]{2}|[01]{8}))*)?"
    r"(?:\s+(?:'.*'|`.*`|ERRORFRAME))?\s*\Z"
)
_TRUCKDEVIL = re.compile(
    r"([0-9A-F]{8})\s+([0-9A-F]{2}) ([0-9A-F]{4}) ([0-9A-F]{2}) --> ([0-9A-F]{2}) "
    r"\[(\d{4})\] ([0-9A-F]*)\Z"
)
_XL = re.compile(r"[0-9A-Fa-f]{2}:[0-9A-Fa-f]{2}:[0-9A-Fa-f]{8}#")
_REMOTE = re.compile(r"[Rr](?:([0-8])(?:_([9A-Fa-f]))?)?\Z")
_DATA = re.compile(r"((?:\.?[0-9A-Fa-f]{2})*)(?:_([9A-Fa-f]))?\Z")
_DROPPED = re.compile(r"DROPCOUNT: dropped (\d+) CAN frame")


def parse_line(text: str) -> Parsed:
    """Parse one line.

    Raises: NotAFrame for a known line that is no frame; ValueError with what is broken.
    Checked by: tests/unit/sil/logs/test_candump.py.
    """
    if "\x1b" in text:
        text = _ANSI.sub("", text)
    line = text.strip()
    if not line or line[0] in "#;":
        raise NotAFrame("")
    if text[0] == "\t":
        raise NotAFrame("error frame explanation line")
    dropped = _DROPPED.match(line)
    if dropped:
        raise NotAFrame(DROPPED, int(dropped[1][:9]))
    timed = _TIME.match(line)
    time_ns = 0
    if timed:
        time_ns = _time(timed[1])
        line = line[timed.end() :]
    compact = _COMPACT.match(line)
    if compact:
        frame, told = _compact(time_ns, compact)
    else:
        screen = _SCREEN.match(line)
        if screen:
            frame, told = _screen(time_ns, screen)
        else:
            frame, told = _other(time_ns, line)
    problem = frame_problem(frame)
    if problem:
        raise ValueError(problem)
    return Parsed(frame, timed is not None, told)


def _time(text: str) -> int:
    date = _DATE.match(text)
    if date is None:
        time_ns = parse_decimal_ns(text)
        if time_ns < 0:
            raise ValueError(f"time {text} is negative")
        return time_ns
    year, month, day, hour, minute, second = (int(date[i]) for i in range(1, 7))
    try:
        return utc_ns(year, month, day, hour, minute, second, int(date[7].ljust(9, "0")))
    except (ValueError, OverflowError):
        raise ValueError(f"there is no date {text}") from None


def _identifier(digits: str) -> tuple[int, bool, bool]:
    """Split an identifier word into number, extended, error."""
    if len(digits) not in (3, 8):
        raise ValueError(f"identifier {digits} has {len(digits)} digits; candump writes 3 or 8")
    number = int(digits, 16)
    if len(digits) == 3:
        return number, False, False
    if number & ERROR_FLAG:
        if number > 0x3FFFFFFF:
            raise ValueError(f"identifier {digits} has more than 29 bits")
        return number & ~ERROR_FLAG, False, True
    return number, True, False


def _compact(time_ns: int, match: re.Match[str]) -> tuple[LogFrame, bool]:
    channel, digits, body, direction_letter = match.groups()
    direction = {"R": "Rx", "T": "Tx", None: ""}[direction_letter]
    if _XL.match(body):
        raise NotAFrame("CAN XL frame")
    can_id, extended, error = _identifier(digits)
    remote = _REMOTE.match(body)
    if remote:
        raw_dlc = int(remote[2] or remote[1] or "0", 16)
        frame = LogFrame(
            time_ns,
            can_id,
            b"",
            extended,
            remote=True,
            channel=channel,
            direction=direction,
            raw_dlc=raw_dlc,
            error=error,
        )
        return frame, bool(direction or remote[2])
    fd = body.startswith("#")
    flags = 0
    if fd:
        if len(body) < 2 or body[1] not in "0123456789ABCDEFabcdef":
            raise ValueError("no flags after ## of a CAN FD frame")
        flags, body = int(body[1], 16), body[2:]
    data = _DATA.match(body)
    if data is None:
        raise ValueError(f"data {body[:24]!r} is not pairs of hex digits")
    payload = bytes.fromhex(data[1].replace(".", ""))
    if data[2] and (fd or len(payload) != 8):
        raise ValueError(f"raw length code _{data[2]} beside {len(payload)} bytes")
    frame = LogFrame(
        time_ns,
        can_id,
        payload,
        extended,
        False,
        error,
        fd,
        bool(flags & 1),
        bool(flags & 2),
        channel,
        direction,
        int(data[2] or "0", 16),
    )
    return frame, bool(direction or data[2]) or len(payload) == 64


def _screen(time_ns: int, match: re.Match[str]) -> tuple[LogFrame, bool]:
    channel, direction, brs, esi, digits, length_text, code_text, rest = match.groups()
    can_id, extended, error = _identifier(digits)
    fd = length_text is not None and len(length_text) == 2
    raw_dlc = int(code_text, 16) if code_text else 0
    length = int(length_text) if length_text else min(raw_dlc, 8)
    direction = (direction or "").capitalize()
    if rest.strip() == "remote request":
        return (
            LogFrame(
                time_ns,
                can_id,
                b"",
                extended,
                remote=True,
                channel=channel,
                direction=direction,
                raw_dlc=raw_dlc or length,
            ),
            True,
        )
    body = _SCREEN_DATA.match(rest)
    if body is None:
        raise ValueError(f"data {rest.strip()[:24]!r} is not bytes")
    words = re.split("[ `]", body[1]) if body[1] else []
    if len(words) != length:
        raise ValueError(f"{len(words)} bytes of data where [{length}] is told")
    base = 2 if words and len(words[0]) == 8 else 16
    if any(len(word) != len(words[0]) for word in words):
        raise ValueError("bytes in two notations")
    payload = bytes(int(word, base) for word in words)
    if body[1] and "`" in body[1]:
        payload = payload[::-1]
    if not fd and length > 8:
        raise ValueError(f"length [{length}] of a classic frame")
    frame = LogFrame(
        time_ns,
        can_id,
        payload,
        extended,
        False,
        error,
        fd,
        fd and brs == "B",
        fd and esi == "E",
        channel,
        direction,
        raw_dlc if raw_dlc > 8 else 0,
    )
    return frame, True


def _other(time_ns: int, line: str) -> tuple[LogFrame, bool]:
    truck = _TRUCKDEVIL.match(line)
    if truck:
        can_id = int(truck[1], 16)
        if len(truck[7]) != 2 * int(truck[6]):
            raise ValueError(f"{len(truck[7])} hex digits where [{truck[6]}] bytes are told")
        if int(truck[6]) > 8:
            raise NotAFrame("reassembled J1939 message")
        if (can_id >> 26 & 7, can_id & 0xFF) != (int(truck[2], 16), int(truck[4], 16)):
            raise ValueError("priority and source beside the identifier are other ones")
        return LogFrame(time_ns, can_id, bytes.fromhex(truck[7])), True
    if _SCREEN_XL.match(line):
        raise NotAFrame("CAN XL frame")
    raise ValueError(f"{line[:40]!r} is no candump line")


def surely_whole(parsed: Parsed, earlier: list[LogFrame]) -> bool:
    """Whether a last line without a line end can be taken for whole.

    A cut can shorten data unseen. It is whole when the line tells its length, has all the bytes
    there can be, or the frame last seen with the same identifier was as long; and it has a
    direction if the others have one.
    """
    frame = parsed.frame
    if earlier and earlier[-1].direction and not frame.direction:
        return False
    if parsed.length_told or (len(frame.data) == 8 and not frame.fd):
        return True
    for before in reversed(earlier):
        if before.can_id == frame.can_id and before.extended == frame.extended:
            return (
                len(before.data) == len(frame.data)
                and before.remote == frame.remote
                and before.raw_dlc == frame.raw_dlc
            )
    return False

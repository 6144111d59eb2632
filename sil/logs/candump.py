"""candump logs: every form that can-utils prints is read, the log form of `candump -l` written.

Forms: the log form (`(1.000000) can0 123#1122 R`), the screen form with absolute, dated, delta,
zero-based or no times, extra message information, ASCII, binary or swapped data, colours; numbered
lines and trailing remarks as J1939 printers write them; TruckDevil's print.
Source: can-utils' own printing (lib.c, candump.c).
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from functools import lru_cache
from itertools import pairwise, repeat
from operator import add
from typing import Final, NamedTuple

from can_dbc.errors import InputError
from sil.logs.format import Batch, Format, NotAFrame, TextReader, time_base
from sil.logs.frame import MAX_TIME_NS, LogFrame
from sil.logs.source import Chunk, Line
from sil.logs.times import NS_PER_S, enough_decimals, format_ns, parse_decimal_ns, utc_ns
from sil.logs.writer import LogWriter

_MOST_KNOWN_IDS: Final = 100_000
_ERROR_FLAG: Final = 0x20000000
_DROPPED_NAME: Final = "frame dropped by the recorder"
_LETTER: Final = {"": "", "Rx": " R", "Tx": " T"}
_DECIDED_BY: Final = 256
"""Frames from which (if there are so many) times and differences of time are distinguished."""

_BUS_ERROR: Final = 0x80
"""SocketCAN's class of an error seen on the bus (CAN_ERR_BUSERROR)."""
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
_PLAIN_IDENTIFIER: Final = re.compile(r"[01][0-9A-Fa-f]{7}\Z|[0-7][0-9A-Fa-f]{2}\Z")
_PLAIN_CHANNEL: Final = re.compile(r"[!-~]{1,64}\Z")
_DATA_LENGTHS: Final = frozenset(range(0, 17, 2))
_MOST_SECONDS: Final = 9_223_372_035
_LETTERS: Final = {"R": "Rx", "T": "Tx"}


class Parsed(NamedTuple):
    """The frame of a line (at time 0 if the line has no time), and what else the line states.

    has_length: the line itself states how many bytes of data there are.
    """

    frame: LogFrame
    timed: bool
    has_length: bool


def parse_line(text: str) -> Parsed:
    """Parse one line.

    Raises NotAFrame for a known line that is no frame; ValueError with what is broken.
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
        raise NotAFrame(_DROPPED_NAME, int(dropped[1][:9]))
    timed = _TIME.match(line)
    time_ns = 0
    if timed:
        time_ns = _time(timed[1])
        line = line[timed.end() :]
    compact = _COMPACT.match(line)
    if compact:
        frame, has_length = _compact(time_ns, compact)
    else:
        screen = _SCREEN.match(line)
        if screen:
            frame, has_length = _screen(time_ns, screen)
        else:
            frame, has_length = _other(time_ns, line)
    return Parsed(frame, timed is not None, has_length)


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
    if number & _ERROR_FLAG:
        if number > 0x3FFFFFFF:
            raise ValueError(f"identifier {digits} has more than 29 bits")
        return number & ~_ERROR_FLAG, False, True
    return number, True, False


def _compact(time_ns: int, match: re.Match[str]) -> tuple[LogFrame, bool]:
    channel, digits, body, letter = match.groups()
    direction = _LETTERS.get(letter, "")
    if _XL.match(body):
        raise NotAFrame("CAN XL frame")
    can_id, extended, error = _identifier(digits)
    frame = LogFrame(time_ns, can_id, b"", extended, error=error, channel=channel)
    frame = frame._replace(direction=direction)
    remote = _REMOTE.match(body)
    if remote:
        raw_dlc = int(remote[2] or remote[1] or "0", 16)
        return frame._replace(remote=True, raw_dlc=raw_dlc), bool(direction or remote[2])
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
        raise ValueError(f"raw length code _{data[2]} with {len(payload)} bytes; expected 8")
    brs, esi, raw_dlc = bool(flags & 1), bool(flags & 2), int(data[2] or "0", 16)
    frame = frame._replace(data=payload, fd=fd, brs=brs, esi=esi, raw_dlc=raw_dlc)
    return frame, bool(direction or data[2]) or len(payload) == 64


def _screen(time_ns: int, match: re.Match[str]) -> tuple[LogFrame, bool]:
    channel, way, brs, esi, digits, length_text, code_text, rest = match.groups()
    can_id, extended, error = _identifier(digits)
    fd = length_text is not None and len(length_text) == 2
    raw_dlc = int(code_text, 16) if code_text else 0
    length = int(length_text) if length_text else min(raw_dlc, 8)
    frame = LogFrame(time_ns, can_id, b"", extended, error=error, channel=channel)
    frame = frame._replace(direction=(way or "").capitalize())
    if rest.strip() == "remote request":
        return frame._replace(remote=True, error=False, raw_dlc=raw_dlc or length), True
    body = _SCREEN_DATA.match(rest)
    if body is None:
        raise ValueError(f"data {rest.strip()[:24]!r} is not bytes")
    words = re.split("[ `]", body[1]) if body[1] else []
    if len(words) != length:
        raise ValueError(f"{len(words)} bytes of data; expected [{length}]")
    base = 2 if words and len(words[0]) == 8 else 16
    if any(len(word) != len(words[0]) for word in words):
        raise ValueError("bytes in two notations")
    payload = bytes(int(word, base) for word in words)
    if body[1] and "`" in body[1]:
        payload = payload[::-1]
    if not fd and length > 8:
        raise ValueError(f"length [{length}] of a classic frame")
    brs, esi = fd and brs == "B", fd and esi == "E"
    raw_dlc = raw_dlc if raw_dlc > 8 else 0
    return frame._replace(data=payload, fd=fd, brs=brs, esi=esi, raw_dlc=raw_dlc), True


def _other(time_ns: int, line: str) -> tuple[LogFrame, bool]:
    truck = _TRUCKDEVIL.match(line)
    if truck:
        can_id = int(truck[1], 16)
        if len(truck[7]) != 2 * int(truck[6]):
            raise ValueError(f"{len(truck[7])} hex digits; expected [{truck[6]}] bytes")
        if int(truck[6]) > 8:
            raise NotAFrame("reassembled J1939 message")
        if (can_id >> 26 & 7, can_id & 0xFF) != (int(truck[2], 16), int(truck[4], 16)):
            raise ValueError("priority and source do not match the identifier")
        return LogFrame(time_ns, can_id, bytes.fromhex(truck[7])), True
    if _SCREEN_XL.match(line):
        raise NotAFrame("CAN XL frame")
    raise ValueError(f"{line[:40]!r} is no candump line")


def surely_whole(parsed: Parsed, earlier: Sequence[LogFrame]) -> bool:
    """Return whether a last line without a line end can be taken for whole.

    A cut can shorten data without a trace. A line is whole if it states its length, has as many
    bytes as there can be, or the last frame of the same identifier was as long; and if it has a
    direction where the others have one.
    """
    frame = parsed.frame
    if earlier and earlier[-1].direction and not frame.direction:
        return False
    if parsed.has_length or (len(frame.data) == 8 and not frame.fd):
        return True
    for before in reversed(earlier):
        if before.can_id == frame.can_id and before.extended == frame.extended:
            return (
                len(before.data) == len(frame.data)
                and before.remote == frame.remote
                and before.raw_dlc == frame.raw_dlc
            )
    return False


@lru_cache(_MOST_KNOWN_IDS)
def _plain_identifier(digits: str) -> tuple[int, bool] | None:
    """Return number and extended flag of a data frame's identifier, None for other words."""
    return (int(digits, 16), len(digits) == 8) if _PLAIN_IDENTIFIER.match(digits) else None


def plain_frames(text: str, count: int) -> list[LogFrame] | None:
    """Return the frames of `count` lines of text, None when one of them is not a common line."""
    if "\r" in text:
        text = text.replace("\r\n", "\n")
    first = text[: text.find("\n")]
    directed = first.endswith((" R", " T"))
    step = 10 if directed else 9
    words = _words(text, count, first, step)
    if words is None:
        return None
    whole, fractions, channels = words[1::step], words[3::step], words[5::step]
    digits, data = words[6::step], words[8::step]
    ways = words[9::step] if directed else []
    seconds = set(whole)
    known = {word: _plain_identifier(word) for word in set(digits)}
    ids = {word: item[0] for word, item in known.items() if item is not None}
    extended = {word: item[1] for word, item in known.items() if item is not None}
    if not (
        all(word.isdigit() and len(word) <= 10 and int(word) <= _MOST_SECONDS for word in seconds)
        and set(map(len, fractions)) == {9}
        and "".join(fractions).isdigit()
        and _DATA_LENGTHS.issuperset(map(len, data))
        and all(map(_PLAIN_CHANNEL.match, set(channels)))
        and len(ids) == len(known)
        and _LETTERS.keys() >= set(ways)
    ):
        return None
    try:
        payloads = list(map(bytes.fromhex, data))
    except ValueError:
        return None
    seconds_ns = {word: int(word) * NS_PER_S for word in seconds}
    no = repeat(False)
    rows = zip(
        map(add, map(seconds_ns.__getitem__, whole), map(int, fractions)),
        map(ids.__getitem__, digits),
        payloads,
        map(extended.__getitem__, digits),
        *(no, no, no, no, no),
        channels,
        map(_LETTERS.__getitem__, ways) if directed else repeat(""),
        repeat(0),
        strict=False,
    )
    return list(map(tuple.__new__, repeat(LogFrame), rows))


def _words(text: str, count: int, first: str, step: int) -> list[str] | None:
    """Return the words of the lines, `step` of each, None if the marks are not where they belong.

    The words are ( seconds . fraction ) channel identifier # data and, of ten, the direction.
    """
    point, closing = first.find("."), first.find(") ")
    if closing - point == 7:
        padding = "000 ) "
    elif closing - point == 10:
        padding = " ) "
    else:
        return None
    if first[:1] != "(":
        return None
    text = "( " + text[1:-1].replace("\n(", " ( ").replace(") ", padding)
    if not (text.isascii() and text.isprintable()):
        return None
    text = text.replace(".", " . ").replace("#", " # ")
    words = text.split(" ")
    if len(words) != step * count:
        return None
    marks = (("(", 0), (".", 2), (")", 4), ("#", 7))
    if all(words[at::step].count(mark) == count for mark, at in marks):
        return words
    return None


class CandumpReader(TextReader):
    """State of one reading: what the times of the log are."""

    _decided = False
    _timed: bool | None = None
    _sum_ns = 0
    _earlier: Sequence[LogFrame] = ()

    def __iter__(self) -> Iterator[Batch]:
        held = Batch([], [])
        for batch in super().__iter__():
            self._earlier = batch.frames
            if not self._decided:
                held = Batch(held.frames + batch.frames, [*held.locations, *batch.locations])
                if len(held.frames) < _DECIDED_BY:
                    continue
                batch, held = held, Batch([], [])
            yield self._with_times(batch)
        if held.frames:
            yield self._with_times(held)

    def _quick(self, chunk: Chunk) -> Batch | None:
        if self._timed is False:
            return None
        count = chunk.text.count("\n")
        frames = plain_frames(chunk.text, count)
        if frames is None:
            return None
        self._timed = True
        return Batch(frames, range(chunk.line, chunk.line + count), ordinary=True)

    def _line(self, line: Line) -> LogFrame:
        parsed = parse_line(line.text)
        if line.unterminated and not surely_whole(parsed, self._earlier):
            raise ValueError("the last line has no end and may be cut short")
        if self._timed is None:
            self._timed = parsed.timed
        if parsed.timed is not self._timed:
            known_times = "has times" if self._timed else "has none"
            raise ValueError(f"other than the lines before it, which {known_times}")
        return parsed.frame

    def _with_times(self, batch: Batch) -> Batch:
        if not self._decided:
            self._decide(batch.frames)
        if self._times != "delta":
            return batch
        total = self._sum_ns
        summed = []
        for frame in batch.frames:
            total += frame.time_ns
            summed.append(frame._replace(time_ns=total))
        if total > MAX_TIME_NS:
            raise InputError(
                f"{self._report.path}: line {batch.locations[-1]}: the differences add up to "
                f"{total // NS_PER_S} s; expected times within 292 years"
            )
        self._sum_ns = total
        return Batch(summed, batch.locations)

    def _decide(self, frames: list[LogFrame]) -> None:
        """Find out from the first frames what the times of this log are."""
        self._decided = True
        report = self._report
        if not self._timed:
            report.time_base = "none"
            report.note("the lines have no times: every frame is at 0")
        elif self._times == "delta" or (self._times == "auto" and look_like_deltas(frames)):
            if self._times == "auto":
                report.note("the times are differences from line to line; they were summed up")
            self._times = "delta"
            report.time_base = "delta"
        else:
            report.time_base = time_base(frames[0].time_ns)


def look_like_deltas(frames: list[LogFrame]) -> bool:
    """Return whether times are differences (`candump -t d`) and not counted from zero (`-t z`).

    Both begin at 0.  Differences fall in at least a fifth of the steps, or are all the same;
    a clock does neither.
    """
    times = [frame.time_ns for frame in frames]
    if len(times) < 3 or times[0] != 0:
        return False
    steps = [after - before for before, after in pairwise(times[1:])]
    falls = sum(step < 0 for step in steps)
    same = not any(steps) and times[1] != 0 and len(steps) >= 2
    return same or 5 * falls >= len(steps)


class CandumpWriter(LogWriter):
    """Writes `(seconds) channel id#data`, which can-utils and python-can read.

    Six decimals if the log's times are whole microseconds, else nine.
    """

    format = "candump"

    def __init__(self, path: str) -> None:
        super().__init__(path)
        self._names: dict[str, str] = {}

    def _begin(self, frames: list[LogFrame]) -> None:
        self._decimals = enough_decimals(frames)

    def _write_batch(self, frames: list[LogFrame]) -> None:
        self._out.write("".join(map(self._line, frames)).encode("ascii"))

    def _line(self, frame: LogFrame) -> str:
        time_ns, can_id, data, extended, remote, error, fd, _, _, channel, direction, raw = frame
        if time_ns < 0:
            raise InputError(
                f"{self.path}: a frame at {format_ns(time_ns)} s, and candump has no times below 0; "
                "expected csv or mf4 as the target"
            )
        seconds, nano = divmod(time_ns, NS_PER_S)
        exact = self._decimals == 9 or nano % 1000
        stamp = f"{seconds:010d}.{nano:09d}" if exact else f"{seconds:010d}.{nano // 1000:06d}"
        name = self._names.get(channel)
        if name is None:
            name = self._names[channel] = self._interface(channel)
        digits = f"{can_id:08X}" if extended else f"{can_id:03X}"
        if remote or error or fd or raw:
            body = self._special(frame, digits)
        else:
            body = f"{digits}#{data.hex().upper()}"
        return f"({stamp}) {name} {body}{_LETTER[direction]}\n"

    def _interface(self, channel: str) -> str:
        """Return the network interface name of a channel; numbered channels count from can0."""
        if not channel:
            self.losses["unnamed channel written as can0"] += 1
            return "can0"
        if channel.isdecimal() and channel.isascii():
            name = f"can{max(int(channel[:6]) - 1, 0)}"
            self.losses[f"channel {channel} written as {name}"] += 1
            return name
        return channel

    def _special(self, frame: LogFrame, digits: str) -> str:
        if frame.error:
            if frame.extended or frame.remote or frame.fd:
                self.losses["flags of an error frame"] += 1
            if not frame.can_id and not frame.data:
                self.losses["error frame without a class written as a bus error"] += 1
                return f"{_ERROR_FLAG | _BUS_ERROR:08X}#{bytes(8).hex()}"
            return f"{_ERROR_FLAG | frame.can_id:08X}#{frame.data.hex().upper()}"
        if frame.remote:
            if frame.fd:
                self.losses["CAN FD flag of a remote frame"] += 1
            length = min(frame.raw_dlc, 8)
            raw = f"_{frame.raw_dlc:X}" if frame.raw_dlc > 8 else ""
            return f"{digits}#R{length or ''}{raw}"
        if frame.fd:
            flags = 4 | frame.brs | frame.esi << 1
            return f"{digits}##{flags:X}{frame.data.hex().upper()}"
        return f"{digits}#{frame.data.hex().upper()}_{frame.raw_dlc:X}"


def _recognise(head: bytes) -> bool:
    """Return whether one of the first lines is a candump line."""
    for text in head.decode("latin-1").split("\n")[:200]:
        try:
            parse_line(text.removesuffix("\r"))
        except NotAFrame as known:
            if known.name == _DROPPED_NAME:
                return True
        except ValueError:
            continue
        else:
            return True
    return False


FORMAT: Final = Format(
    "candump", (".log", ".candump", ".txt"), _recognise, CandumpReader, CandumpWriter
)

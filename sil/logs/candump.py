"""candump logs: every form that can-utils prints is read, the log form of `candump -l` written.

Forms: the log form (`(1.000000) can0 123#1122 R`), the screen form with absolute, dated, delta,
zero-based or no times, extra message information, ASCII, binary or swapped data, colours; numbered
lines and trailing remarks as J1939 printers write them; TruckDevil's print.
Source: can-utils' own printing (lib.c, candump.c).
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from contextlib import suppress
from itertools import accumulate, chain, pairwise, repeat
from typing import Final, NamedTuple

from can_dbc.errors import InputError
from can_dbc.frame import MAX_ID
from can_dbc.instants import NS_PER_S
from sil.logs.format import Batch, NotAFrame, TextReader, time_base
from sil.logs.frame import MAX_TIME_NS, LogFrame
from sil.logs.source import Chunk, Line
from sil.logs.times import enough_decimals, format_ns, parse_decimal_ns, utc_ns
from sil.logs.writer import TextWriter

_ERROR_FLAG: Final = 0x20000000
_DIRECTIONS: Final = {"": "", "R": "Rx", "T": "Tx"}

_COMPACT = re.compile(r"([!-~]{1,64})\s+([0-9A-Fa-f]{1,8})#(\S*)(?:\s+([RT]))?\s*(?:\s;.*)?\Z")
_PLAIN: Final = re.compile(
    r"^\((\d{1,10}+)\.(\d++)\) ([!-~]{1,64}+) ([01][0-9A-Fa-f]{7}|[0-7][0-9A-Fa-f]{2})"
    r"#([0-9A-Fa-f]{0,16}+)(?: ([RT]))?+\r?+$",
    re.MULTILINE | re.ASCII,
)
"""A classic data frame as `candump -l` writes it, which most lines are."""

_SCREEN = re.compile(
    r"([!-~]{1,64})\s+(?:(RX|TX) ([BS-]) ([ER-])\s+)?([0-9A-F]{3}|[0-9A-F]{8})\s+"
    r"(?:\[(\d{1,2})\]|\{([0-9A-F])\})(.*)\Z"
)
_TRUCKDEVIL = re.compile(
    r"([0-9A-F]{8})\s+([0-9A-F]{2}) ([0-9A-F]{4}) ([0-9A-F]{2}) --> ([0-9A-F]{2}) "
    r"\[(\d{4})\] ([0-9A-F]*)\Z"
)
_TIME = re.compile(r"(?:\d{1,12}\s+)?\(([^()]{1,48})\)\s+")
_DATA = re.compile(r"(?:#([0-9A-Fa-f]))?((?:\.?[0-9A-Fa-f]{2})*)(?:_([9A-Fa-f]))?\Z")
_DROPPED = re.compile(r"DROPCOUNT: dropped (\d+) CAN frame")


class Parsed(NamedTuple):
    """The frame of a line, at 0 if it is not timed, and whether it states how many bytes of data it has."""

    frame: LogFrame
    timed: bool
    has_length: bool


def parse_line(text: str) -> Parsed:
    """Parse one line. Raises NotAFrame for a known line that is no frame; ValueError with what is broken."""
    if "\x1b" in text:
        text = re.sub(r"\x1b\[[0-9;]*m", "", text)
    line = text.strip()
    if not line or line[0] in "#;":
        raise NotAFrame("")
    if text[0] == "\t":
        raise NotAFrame("error frame explanation line")
    if dropped := _DROPPED.match(line):
        raise NotAFrame("frame dropped by the recorder", int(dropped[1][:9]))
    timed = _TIME.match(line)
    time_ns = _time(timed[1]) if timed else 0
    line = line[timed.end() :] if timed else line
    for pattern, parse in ((_COMPACT, _compact), (_SCREEN, _screen), (_TRUCKDEVIL, _truckdevil)):
        if match := pattern.match(line):
            frame, has_length = parse(match)
            return Parsed(frame._replace(time_ns=time_ns), timed is not None, has_length)
    if re.match(r"\S{1,64}\s.*\[\d{4}\] \([0-9A-F]{2}\|[0-9A-F]{2}:", line):
        raise NotAFrame("CAN XL frame")
    raise ValueError(f"{line[:40]!r} is no candump line")


def _time(text: str) -> int:
    date = re.match(r"(\d{4})-(\d\d)-(\d\d) (\d\d):(\d\d):(\d\d)\.(\d{6}|\d{9})\Z", text)
    if date is None:
        time_ns = parse_decimal_ns(text)
        if time_ns < 0:
            raise ValueError(f"time {text} is negative")
        return time_ns
    *moment, fraction = date.groups()
    try:
        return utc_ns(*map(int, moment)) + int(fraction.ljust(9, "0"))
    except (ValueError, OverflowError):
        raise ValueError(f"there is no date {text}") from None


def _identifier(digits: str) -> tuple[int, bool, bool]:
    """Split an identifier word into number, extended, error."""
    if len(digits) not in (3, 8):
        raise ValueError(f"identifier {digits} has {len(digits)} digits; candump writes 3 or 8")
    number = int(digits, 16)
    if number & ~_ERROR_FLAG > MAX_ID:
        raise ValueError(f"identifier {digits}; expected at most 1FFFFFFF")
    error = bool(number & _ERROR_FLAG)
    return number & ~_ERROR_FLAG, len(digits) == 8 and not error, error


def _compact(match: re.Match[str]) -> tuple[LogFrame, bool]:
    channel, digits, body, letter = match.groups()
    if ":" in body and re.match(r"[0-9A-Fa-f]{2}:[0-9A-Fa-f]{2}:[0-9A-Fa-f]{8}#", body):
        raise NotAFrame("CAN XL frame")
    can_id, extended, error = _identifier(digits)
    direction = _DIRECTIONS[letter or ""]
    is_remote = body[:1] in ("R", "r")
    if is_remote and (remote := re.match(r"[Rr](?:([0-8])(?:_([9A-Fa-f]))?)?\Z", body)):
        code = int(remote[2] or remote[1] or "0", 16)
        flags = extended, True, error, False, False, False
        frame = LogFrame(0, can_id, b"", *flags, channel, direction, code)
        return frame, bool(direction or remote[2])
    data = _DATA.match(body)
    if data is None:
        raise ValueError(f"data {body[:24]!r} is not pairs of hex digits")
    payload = bytes.fromhex(data[2].replace(".", ""))
    fd, fd_flags = data[1] is not None, int(data[1] or "0", 16)
    if data[3] and (fd or len(payload) != 8):
        raise ValueError(f"raw length code _{data[3]} with {len(payload)} bytes; expected 8")
    flags = extended, False, error, fd, bool(fd_flags & 1), bool(fd_flags & 2)
    frame = LogFrame(0, can_id, payload, *flags, channel, direction, int(data[3] or "0", 16))
    return frame, bool(direction or data[3]) or len(payload) == 64


def _screen(match: re.Match[str]) -> tuple[LogFrame, bool]:
    channel, way, brs, esi, digits, length_text, code_text, rest = match.groups()
    can_id, extended, error = _identifier(digits)
    direction = (way or "").capitalize()
    fd = length_text is not None and len(length_text) == 2
    code = int(code_text or "0", 16)
    length = int(length_text) if length_text else min(code, 8)
    if rest.strip() == "remote request":
        flags = extended, True, False, False, False, False
        return LogFrame(0, can_id, b"", *flags, channel, direction, code or length), True
    body = re.match(
        r"\s*((?:[0-9A-F]{2}|[01]{8})(?:[ `](?:[0-9A-F]{2}|[01]{8}))*)?"
        r"(?:\s+(?:'.*'|`.*`|ERRORFRAME))?\s*\Z",
        rest,
    )
    if body is None:
        raise ValueError(f"data {rest.strip()[:24]!r} is not bytes")
    words = re.split("[ `]", body[1]) if body[1] else []
    if len(words) != length:
        raise ValueError(f"{len(words)} bytes of data; expected [{length}]")
    if len(set(map(len, words))) > 1:
        raise ValueError("bytes in two notations")
    payload = bytes(int(word, 2 if len(word) == 8 else 16) for word in words)
    if body[1] and "`" in body[1]:
        payload = payload[::-1]
    flags = extended, False, error, fd, fd and brs == "B", fd and esi == "E"
    raw_dlc = code if code > 8 else 0
    return LogFrame(0, can_id, payload, *flags, channel, direction, raw_dlc), True


def _truckdevil(match: re.Match[str]) -> tuple[LogFrame, bool]:
    digits, priority, _group, source, _destination, length, data = match.groups()
    can_id = int(digits, 16)
    if len(data) != 2 * int(length):
        raise ValueError(f"{len(data)} hex digits; expected [{length}] bytes")
    if int(length) > 8:
        raise NotAFrame("reassembled J1939 message")
    if (can_id >> 26 & 7, can_id & 0xFF) != (int(priority, 16), int(source, 16)):
        raise ValueError("priority and source do not match the identifier")
    return LogFrame(0, can_id, bytes.fromhex(data)), True


def surely_whole(parsed: Parsed, earlier: Sequence[LogFrame]) -> bool:
    """Return whether a last line without a line end, which may be cut within its data, is surely whole.

    It states its length, has as many bytes as there can be, or as the last frame of its identifier;
    and it has a direction where the others have one.
    """
    frame = parsed.frame
    if earlier and earlier[-1].direction and not frame.direction:
        return False
    if parsed.has_length or (len(frame.data) == 8 and not frame.fd):
        return True
    same = (f for f in reversed(earlier) if f[1] == frame[1] and f.extended == frame.extended)
    before = next(same, None)
    return (
        before is not None
        and len(before.data) == len(frame.data)
        and (before.remote, before.raw_dlc) == (frame.remote, frame.raw_dlc)
    )


def plain_frames(text: str, count: int) -> list[LogFrame] | None:
    """Return the frames of `count` lines of text, None when one of them is not a common line."""
    rows = _PLAIN.findall(text)
    if len(rows) != count:
        return None
    seconds, fractions, channels, digits, data, letters = zip(*rows, strict=True)
    units = {6: 1000, 9: 1}.get(len(fractions[0]))
    if units is None or len(set(map(len, fractions))) > 1:
        return None
    times_ns = [int(a + b) * units for a, b in zip(seconds, fractions, strict=True)]
    try:
        payloads = list(map(bytes.fromhex, data))
    except ValueError:
        return None
    if max(times_ns) > MAX_TIME_NS:
        return None
    ids = {word: int(word, 16) for word in set(digits)}
    extended = {word: len(word) == 8 for word in ids}
    no = repeat(False)
    columns = zip(
        times_ns,
        map(ids.__getitem__, digits),
        payloads,
        map(extended.__getitem__, digits),
        *(no, no, no, no, no),
        channels,
        map(_DIRECTIONS.__getitem__, letters),
        repeat(0),
        strict=False,
    )
    return list(map(tuple.__new__, repeat(LogFrame), columns))


class CandumpReader(TextReader):
    """State of one reading: what the times of the log are."""

    _timed: bool | None = None
    _sum_ns = 0
    _earlier: Sequence[LogFrame] = ()

    def __iter__(self) -> Iterator[Batch]:
        batches = super().__iter__()
        start = Batch([], [])
        for batch in batches:
            start = Batch(start.frames + batch.frames, [*start.locations, *batch.locations])
            self._earlier = start.frames
            if len(start.frames) >= 256:
                break
        if start.frames:
            self._decide(start.frames)
            yield from map(self._with_times, chain((start,), batches))

    def _quick(self, chunk: Chunk) -> Batch | None:
        count = chunk.text.count("\n")
        frames = None if self._timed is False else plain_frames(chunk.text, count)
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
        self._earlier = batch.frames
        if self._times != "delta":
            return batch
        steps = (frame.time_ns for frame in batch.frames)
        _, *times_ns = accumulate(steps, initial=self._sum_ns)
        self._sum_ns = times_ns[-1]
        if self._sum_ns > MAX_TIME_NS:
            raise InputError(
                f"{self._report.path}: line {batch.locations[-1]}: the differences add up to "
                f"{self._sum_ns // NS_PER_S} s; expected times within 292 years"
            )
        pairs = zip(batch.frames, times_ns, strict=True)
        return Batch([frame._replace(time_ns=t) for frame, t in pairs], batch.locations)

    def _decide(self, frames: list[LogFrame]) -> None:
        """Find out from the first frames what the times of this log are."""
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

    Both begin at 0; differences fall in at least a fifth of the steps, or are all the same.
    """
    times = [frame.time_ns for frame in frames]
    if len(times) < 3 or times[0] != 0:
        return False
    steps = [after - before for before, after in pairwise(times[1:])]
    falls = sum(step < 0 for step in steps)
    same = not any(steps) and times[1] != 0 and len(steps) >= 2
    return same or 5 * falls >= len(steps)


class CandumpWriter(TextWriter):
    """Writes `(seconds) channel id#data`, which can-utils and python-can read.

    Six decimals if the log's times are whole microseconds, else nine.
    """

    format = "candump"

    def __init__(self, path: str) -> None:
        super().__init__(path)
        self._names: dict[str, str] = {}

    def _header(self, frames: list[LogFrame]) -> str:
        self._decimals = enough_decimals(frames)
        return ""

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
        if channel not in self._names:
            self._names[channel] = self._interface(channel)
        digits = f"{can_id:08X}" if extended else f"{can_id:03X}"
        if remote or error or fd or raw:
            body = self._special(frame, digits)
        else:
            body = f"{digits}#{data.hex().upper()}"
        return f"({stamp}) {self._names[channel]} {body}{direction and f' {direction[0]}'}\n"

    def _interface(self, channel: str) -> str:
        """Return the network interface name of a channel; numbered channels count from can0."""
        if channel and not (channel.isdecimal() and channel.isascii()):
            return channel
        name = f"can{max(int(channel[:6] or 0) - 1, 0)}"
        self.lose(True, f"channel {channel or '(unnamed)'} written as {name}")
        return name

    def _special(self, frame: LogFrame, digits: str) -> str:
        if frame.error:
            self.lose(frame.extended or frame.remote or frame.fd, "flags of an error frame")
            if frame.can_id or frame.data:
                return f"{_ERROR_FLAG | frame.can_id:08X}#{frame.data.hex().upper()}"
            self.lose(True, "error frame without a class written as a bus error")
            can_err_buserror = 0x80
            return f"{_ERROR_FLAG | can_err_buserror:08X}#{bytes(8).hex()}"
        if frame.remote:
            self.lose(frame.fd, "CAN FD flag of a remote frame")
            length = min(frame.raw_dlc, 8)
            raw = f"_{frame.raw_dlc:X}" if frame.raw_dlc > 8 else ""
            return f"{digits}#R{length or ''}{raw}"
        if frame.fd:
            flags = 4 | frame.brs | frame.esi << 1
            return f"{digits}##{flags:X}{frame.data.hex().upper()}"
        return f"{digits}#{frame.data.hex().upper()}_{frame.raw_dlc:X}"


def recognise(head: bytes) -> bool:
    """Return whether one of the first lines is a candump line, or only losses are recorded."""
    lines = head.decode("latin-1").split("\n")
    for text in lines[:200]:
        with suppress(NotAFrame, ValueError):
            return bool(parse_line(text.removesuffix("\r")))
    return any(map(_DROPPED.match, lines))

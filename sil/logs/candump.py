"""candump logs: all the forms of `candump_line` read, the log form of `candump -l` written.

python-can's own reader takes only the log form, crashes on all others, and carries times as
floats (0.2 µs off today); so this reader stands in front of it for every file.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from typing import Final

from can_dbc.errors import InputError
from sil.logs.backend import Batch, LogWriter, ReadOptions
from sil.logs.byte_source import ByteSource
from sil.logs.candump_line import DROPPED, ERROR_FLAG, NotAFrame, parse_line, surely_whole
from sil.logs.candump_plain import PlainChunks
from sil.logs.frame import MAX_TIME_NS, MOST_KNOWN_IDS, LogFrame
from sil.logs.report import LogReport, Place
from sil.logs.text_lines import Chunk, chunk_lines, chunks
from sil.logs.times import NS_PER_S, RELATIVE_BELOW_NS, enough_decimals

_LETTER: Final = {"": "", "Rx": " R", "Tx": " T"}
_DECIDED_BY: Final = 256
"""Frames that are looked at (if there are so many) to tell differences of time from times."""

_BUS_ERROR: Final = 0x80
"""SocketCAN's class of an error seen on the bus (CAN_ERR_BUSERROR)."""


class CandumpReader:
    """State of one reading: the kind of its times and the last chunk's frames."""

    def __init__(self, report: LogReport, options: ReadOptions) -> None:
        self._report = report
        self._times = options.times
        self._decided = False
        self._timed: bool | None = None
        self._sum_ns = 0
        self._plain_chunks = PlainChunks()
        self._earlier: list[LogFrame] = []

    def read(self, source: ByteSource) -> Iterator[Batch]:
        """Frames chunk by chunk."""
        held = Batch([], [])
        for chunk in chunks(source):
            batch = self._plain(chunk) or self._mixed(chunk)
            if batch.frames:
                self._earlier = batch.frames
                if not self._decided:
                    held = Batch(held.frames + batch.frames, [*held.places, *batch.places])
                    if len(held.frames) < _DECIDED_BY:
                        continue
                    batch, held = held, Batch([], [])
                yield self._with_times(batch)
        if held.frames:
            yield self._with_times(held)

    def _plain(self, chunk: Chunk) -> Batch | None:
        """The frames of a chunk when every line of it is a common one."""
        if chunk.unterminated or self._timed is False:
            return None
        count = chunk.text.count("\n")
        frames = self._plain_chunks.frames(chunk.text, count)
        if frames is None:
            return None
        self._timed = True
        return Batch(frames, range(chunk.line, chunk.line + count))

    def _mixed(self, chunk: Chunk) -> Batch:
        """The frames of a chunk with other lines in it."""
        frames: list[LogFrame] = []
        places: list[int] = []
        report = self._report
        for line in chunk_lines(chunk):
            try:
                parsed = parse_line(line.text)
            except NotAFrame as known:
                if known.name:
                    report.other[known.name] += known.count
                continue
            except ValueError as error:
                place = Place(str(error), line.number, line.byte)
                if line.unterminated:
                    report.cut(place)
                else:
                    report.skip(place)
                continue
            if line.unterminated and not surely_whole(parsed, self._earlier + frames):
                report.cut(
                    Place("the last line has no end and may be cut short", line.number, line.byte)
                )
                continue
            if self._timed is None:
                self._timed = parsed.timed
            if parsed.timed is not self._timed:
                known_times = "has times" if self._timed else "has none"
                report.skip(
                    Place(f"other than the lines before it, which {known_times}", line.number)
                )
                continue
            frames.append(parsed.frame)
            places.append(line.number)
        return Batch(frames, places)

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
                f"{self._report.path}: line {batch.places[-1]}: the differences add up to "
                f"{total // NS_PER_S} s; expected times within 292 years"
            )
        self._sum_ns = total
        return Batch(summed, batch.places)

    def _decide(self, frames: list[LogFrame]) -> None:
        """Find out what the times of this log are, from its first chunk."""
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
            absolute = frames[0].time_ns >= RELATIVE_BELOW_NS
            report.time_base = "absolute" if absolute else "relative"


def look_like_deltas(frames: list[LogFrame]) -> bool:
    """Whether times are differences (`candump -t d`) and not counted from zero (`-t z`).

    Both begin at 0.  Differences fall in at least a fifth of the steps, or are all the same;
    a clock does neither.
    Checked by: tests/unit/sil/logs/test_candump.py.
    """
    times = [frame.time_ns for frame in frames]
    if len(times) < 3 or times[0] != 0:
        return False
    steps = [after - before for before, after in pairwise(times[1:])]
    falls = sum(step < 0 for step in steps)
    same = not any(steps) and times[1] != 0 and len(steps) >= 2
    return same or 5 * falls >= len(steps)


class CandumpWriter(LogWriter):
    """Writes `(seconds) channel id#data`, six decimals if the log's times are whole microseconds,
    else nine; can-utils and python-can read both."""

    format = "candump"

    def __init__(self, path: str, decimals: int | None = None) -> None:
        """decimals: 6 (times are then rounded) or 9; None for what the first frames need."""
        if decimals not in (None, 6, 9):
            raise InputError(f"{path}: {decimals} decimals; expected 6 or 9")
        super().__init__(path)
        self._decimals = decimals
        self._exact = False
        self._names: dict[str, str] = {}
        self._prefixes: dict[tuple[int, bool], str] = {}

    def _write_batch(self, frames: list[LogFrame]) -> None:
        if self._decimals is None:
            self._decimals = enough_decimals(frames)
            self._exact = True
        if self._ordinary and self._decimals == 6 and not any(f[0] % 1000 for f in frames):
            text = self._plain(frames)
        else:
            text = "".join([self._line(frame) for frame in frames])
        self._out.write(text.encode("ascii"))

    def _plain(self, frames: list[LogFrame]) -> str:
        """Lines of classic data frames at whole microseconds."""
        names = {frame[9]: self._name(frame[9]) for frame in frames}
        hexes = "\n".join([frame[2].hex() for frame in frames]).upper().split("\n")
        prefixes = self._prefixes
        if len(prefixes) > MOST_KNOWN_IDS:
            prefixes.clear()
        lines = []
        for frame, digits in zip(frames, hexes, strict=True):
            time_ns, can_id, _, extended, _, _, _, _, _, channel, direction, _ = frame
            prefix = prefixes.get((can_id, extended))
            if prefix is None:
                prefix = prefixes[can_id, extended] = _identifier(frame)
            lines.append(
                f"({time_ns // NS_PER_S:010d}.{time_ns % NS_PER_S // 1000:06d}) {names[channel]} "
                f"{prefix}#{digits}{_LETTER[direction]}\n"
            )
        return "".join(lines)

    def _line(self, frame: LogFrame) -> str:
        """The line of any frame."""
        time_ns = frame.time_ns
        if time_ns < 0:
            raise InputError(f"{self.path}: time {time_ns} ns; candump expected times from 0")
        decimals = self._decimals
        if decimals == 6 and time_ns % 1000:
            if self._exact:
                decimals = 9
            else:
                self.losses["times rounded to the microsecond"] += 1
                time_ns += 500
        seconds, nano = divmod(time_ns, NS_PER_S)
        stamp = (
            f"{seconds:010d}.{nano:09d}" if decimals == 9 else f"{seconds:010d}.{nano // 1000:06d}"
        )
        if frame.error or frame.remote or frame.fd or frame.raw_dlc:
            body = self._special(frame)
        else:
            body = f"{_identifier(frame)}#{frame.data.hex().upper()}"
        return f"({stamp}) {self._name(frame.channel)} {body}{_LETTER[frame.direction]}\n"

    def _finish(self) -> None:
        """There is nothing after the last line."""

    def _name(self, channel: str) -> str:
        name = self._names.get(channel)
        if name is None:
            name = self._names[channel] = self._interface(channel)
        return name

    def _interface(self, channel: str) -> str:
        """The network interface name of a channel; numbered channels count from can0."""
        if not channel:
            self.losses["unnamed channel written as can0"] += 1
            return "can0"
        if channel.isdecimal() and channel.isascii():
            name = f"can{max(int(channel[:6]) - 1, 0)}"
            self.losses[f"channel {channel} written as {name}"] += 1
            return name
        return channel

    def _special(self, frame: LogFrame) -> str:
        digits = _identifier(frame)
        if frame.error:
            if frame.extended or frame.remote or frame.fd:
                self.losses["flags of an error frame"] += 1
            if not frame.can_id and not frame.data:
                self.losses["error frame without a class written as a bus error"] += 1
                return f"{ERROR_FLAG | _BUS_ERROR:08X}#{bytes(8).hex()}"
            return f"{ERROR_FLAG | frame.can_id:08X}#{frame.data.hex().upper()}"
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


def _identifier(frame: LogFrame) -> str:
    return f"{frame.can_id:08X}" if frame.extended else f"{frame.can_id:03X}"


class Candump:
    """The candump format."""

    name = "candump"
    suffixes: tuple[str, ...] = (".log", ".candump", ".txt")
    place_word = "line"

    def sniff(self, head: bytes) -> bool:
        """Whether one of the first lines is a candump line."""
        for text in head.decode("latin-1").split("\n")[:200]:
            try:
                parse_line(text.removesuffix("\r"))
            except NotAFrame as known:
                if known.name == DROPPED:
                    return True
            except ValueError:
                continue
            else:
                return True
        return False

    def batches(
        self, source: ByteSource, report: LogReport, options: ReadOptions
    ) -> Iterator[Batch]:
        """The frames of a candump log."""
        return CandumpReader(report, options).read(source)

    def writer(self, path: str) -> LogWriter:
        """A writer of the log form."""
        return CandumpWriter(path)

"""A truck's log: its shifts, and the signals around each, as the mapping names them."""

from __future__ import annotations

from array import array
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import cached_property
from itertools import accumulate, pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray

from can_dbc.codec import encode
from can_dbc.errors import InputError
from can_dbc.frame import join_id
from can_dbc.instants import NS_PER_S
from can_dbc.messages import GEAR_PARK, Etc1, Etc2
from sil.files.quantity import counted
from sil.j1939.mapping import Meaning, Sender, SignalMapping
from sil.logs import LogFrame
from sil.report.figure import Floats
from sil.shifts.cutter import Shift, ShiftFinder
from sil.shifts.reported import PGN_ETC1, PGN_ETC2

SHAFT_SPEEDS: Final[tuple[Meaning, ...]] = ("input_shaft_rad_s", "output_shaft_rad_s")
GEARS: Final[tuple[Meaning, ...]] = ("current_gear", "selected_gear")
_FLAG_AND_SPEEDS: Final[tuple[Meaning, ...]] = ("shift_in_process", *SHAFT_SPEEDS)
_Taker = Callable[[LogFrame], None]


@dataclass(frozen=True)
class Samples:
    """Valid values of one signal. time_s, values: [n] each; times from the origin asked for."""

    time_s: Floats
    values: Floats
    origin: str

    def within(self, begin_s: float, end_s: float) -> Samples:
        """Return the samples of a time: arrays [m], s and the signal's unit."""
        inside = (self.time_s >= begin_s) & (self.time_s <= end_s)
        return Samples(self.time_s[inside], self.values[inside], self.origin)

    def median(self, begin_s: float, end_s: float) -> float | None:
        """Return the median of the values from begin to end, None without any."""
        values = self.within(begin_s, end_s).values
        return float(np.median(values)) if len(values) else None

    @property
    def period_s(self) -> float:
        """Median distance of two samples; 0 for fewer than two."""
        return float(np.median(np.diff(self.time_s))) if len(self.time_s) > 1 else 0.0


@dataclass
class _Series:
    """All frames of one sender's message, each with as many bytes as the DBC states."""

    times_ns: array[int] = field(default_factory=lambda: array("q"))
    content: bytearray = field(default_factory=bytearray)

    @cached_property
    def pieces(self) -> list[NDArray[np.int64]]:
        """The times in ns, cut where the clock steps back; call it when all frames are there."""
        times_ns = np.array(self.times_ns, dtype=np.int64)
        return np.split(times_ns, np.flatnonzero(np.diff(times_ns) < 0) + 1)


def is_data_of(frame: LogFrame, can_id: int | None) -> bool:
    """Return whether a frame is a data frame with a 29-bit identifier."""
    return frame.can_id == can_id and frame.extended and not (frame.remote or frame.error)


class TruckLog:
    """The shifts of a log, and the frames of all mapped messages."""

    def __init__(self, path: str, mapping: SignalMapping) -> None:
        self.path = path
        self.mapping = mapping
        self.frames = 0
        self.shifts: list[Shift] = []
        self.notes: list[str] = []
        self._series: dict[Sender, _Series] = {}
        self._latest: dict[tuple[str, int], dict[Meaning, float]] = {}
        self._short = 0

    def read(self, frames: Iterable[LogFrame], stop_id: int | None = None) -> bool:
        """Read all frames; return False at a frame with the identifier `stop_id`, not having read on."""
        finder = ShiftFinder()
        takers: dict[tuple[str, int, bool], list[_Taker]] = {}
        for frame in frames:
            self.frames += 1
            if frame[4] or frame[5]:  # remote or error
                continue
            key = frame[9], frame[1], frame[3]
            of_frame = takers.get(key)
            if of_frame is None:
                if is_data_of(frame, stop_id):
                    return False
                of_frame = self._takers(finder, *key)
                if len(takers) < 20_000:
                    takers[key] = of_frame
            for take in of_frame:
                take(frame)
        self._finish(finder)
        return True

    def _takers(
        self, finder: ShiftFinder, channel: str, can_id: int, extended: bool
    ) -> list[_Taker]:
        """Return what takes the data frames of an identifier."""
        takers: list[_Taker] = []
        if self.mapping.is_standard and extended:
            takers += filter(None, [finder.follow(channel, can_id)])
        sender = self.mapping.sender(channel, can_id, extended)
        if sender is not None:
            length = self.mapping.length(sender.message)
            series = self._series.setdefault(sender, _Series())
            translate = None if self.mapping.is_standard else self._translator(sender, finder)

            def take(frame: LogFrame) -> None:
                if len(frame.data) < length:
                    self._short += 1
                    return
                series.times_ns.append(frame.time_ns)
                series.content += frame.data[:length]
                if translate is not None:
                    translate(frame)

            takers.append(take)
        return takers

    def _translator(self, sender: Sender, finder: ShiftFinder) -> _Taker:
        """Return what passes frames of another layout to the finder, as ETC1 and ETC2.

        What a frame does not carry has the sender's latest value.
        """
        rows = self.mapping.rows
        latest = self._latest.setdefault((sender.channel, sender.source), {})
        carried = {row.meaning for row in rows if row.message == sender.message}
        followed: list[tuple[_Taker, int, Callable[[dict[Meaning, float]], Etc1 | Etc2]]] = []
        for meanings, pgn, message in (
            (_FLAG_AND_SPEEDS, PGN_ETC1, _etc1),
            (GEARS, PGN_ETC2, _etc2),
        ):
            can_id = join_id(6, pgn, sender.source)
            take = finder.follow(sender.channel, can_id) if carried.intersection(meanings) else None
            if take is not None:
                followed.append((take, can_id, message))

        def translate(frame: LogFrame) -> None:
            for meaning in carried:
                latest.pop(meaning, None)
            for index, value in self.mapping.values(sender, frame.data).items():
                latest.setdefault(rows[index].meaning, value)
            for take, can_id, message in followed:
                data = encode(message(latest)).data
                take(LogFrame(frame.time_ns, can_id, data, channel=frame.channel))

        return translate

    def _finish(self, finder: ShiftFinder) -> None:
        self.shifts = finder.finish()
        short = 0 if self.mapping.is_standard else self._short
        counts = (
            (finder.unfinished, "shift", "without beginning or end in the log"),
            (short, "frame", "shorter than the DBC states, left out"),
            (len(finder.unflagged), "change", "of gear outside of flagged shifts, not compared"),
        )
        self.notes = finder.notes + [f"{counted(n, noun)} {what}" for n, noun, what in counts if n]
        self._series = {
            sender: series for sender, series in self._series.items() if series.times_ns
        }

    def require_shifts(self) -> None:
        """Raise InputError in one line if shaft speeds, gears or shifts are missing."""
        messages = {sender.message for sender in self._series}
        missing = [
            " or ".join(f"{name} ({self.mapping.identifier(name)})" for name in names)
            or f"signal for {' and '.join(meanings)} in {self.mapping.path}"
            for meanings in (SHAFT_SPEEDS, GEARS)
            for names in (self.mapping.messages_of(*meanings),)
            if not messages.intersection(names)
        ]
        if missing:
            raise InputError(
                f"{self.path}: no ValveCommand of our control unit, and no {', no '.join(missing)} among "
                f"{counted(self.frames, 'frame')}; expected both of a truck's transmission, or --map FILE"
            )
        if not self.shifts:
            raise InputError(
                f"{self.path}: no gear shift among {counted(self.frames, 'frame')}"
                f"{''.join(f'; {note}' for note in self.notes)}; expected a log of a drive"
            )

    def samples(
        self, meaning: Meaning, shift: Shift, begin_ns: int, end_ns: int, origin_ns: int
    ) -> Samples | None:
        """Return the valid values of a meaning from begin to end, times from `origin_ns`.

        Of the mapping's rows for the meaning, the first that has any; of several senders, that of
        the shift, else the lowest address on its channel, else on another.
        """
        for index, row in enumerate(self.mapping.rows):
            if row.meaning != meaning:
                continue
            senders = [s for s in self._series if s.message == row.message]
            for sender in sorted(
                senders, key=lambda s: (s.channel != shift.channel, s.source != shift.source, s)
            ):
                samples = [
                    ((time_ns - origin_ns) / NS_PER_S, values[index])
                    for time_ns, content in self._window(sender, begin_ns, end_ns)
                    if index in (values := self.mapping.values(sender, content))
                ]
                if samples:
                    time_s, sample_values = np.array(sorted(samples)).T
                    where = f"{row.message}.{row.signal} of {sender.source:#04x}"
                    return Samples(time_s, sample_values, where)
        return None

    def gap_s(self, shift: Shift, begin_ns: int, end_ns: int) -> float:
        """Return the longest time from begin to end without a frame of what shows the shift."""
        times = [begin_ns, end_ns]
        for name in self.mapping.messages_of(*_FLAG_AND_SPEEDS, *GEARS):
            sender = Sender(name, shift.channel, shift.source)
            if sender in self._series:
                times += (time_ns for time_ns, _ in self._window(sender, begin_ns, end_ns))
        return max(b - a for a, b in pairwise(sorted(times))) / NS_PER_S

    def _window(self, sender: Sender, begin_ns: int, end_ns: int) -> list[tuple[int, bytes]]:
        series, length = self._series[sender], self.mapping.length(sender.message)
        begins = accumulate(map(len, series.pieces), initial=0)
        windows = (
            range(*(begin + np.searchsorted(times_ns, (begin_ns, end_ns + 1))).tolist())
            for begin, times_ns in zip(begins, series.pieces, strict=False)
        )
        inside = max(windows, key=len)
        return [
            (series.times_ns[i], bytes(series.content[i * length : (i + 1) * length]))
            for i in inside
        ]


def _etc1(latest: dict[Meaning, float]) -> Etc1:
    speeds = (latest.get(name, -1.0) for name in SHAFT_SPEEDS)
    entry, output = (max(w, 0.0) if -0.006 < w < 841.0 else None for w in speeds)  # to 8031 rpm
    shifts = {0.0: False, 1.0: True}.get(latest.get("shift_in_process", -1.0))
    return Etc1(shift_in_process=shifts, input_shaft_rad_s=entry, output_shaft_rad_s=output)


def _etc2(latest: dict[Meaning, float]) -> Etc2:
    gears = (latest.get(name) for name in GEARS)
    current, selected = (
        None if gear is None or not -125 < round(gear) <= GEAR_PARK else round(gear)
        for gear in gears
    )
    return Etc2(selected, current_gear=current)

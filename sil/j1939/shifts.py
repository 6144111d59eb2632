"""The gear shifts of any truck, out of its J1939 log."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any, Final

from can_dbc.frame import split_id
from can_dbc.messages import GEAR_PARK
from sil.files.quantity import counted
from sil.j1939.engine import PGN_EEC1, EngineFigures, EngineTrace
from sil.j1939.gear_history import PGN_ETC2, SETTLE_NS, GearHistory
from sil.j1939.shift_flag import PGN_ETC1, FlagTracker
from sil.logs.frame import LogFrame
from sil.logs.times import format_ns

_GEAR_NAMES: Final = {0: "N", GEAR_PARK: "P"}
RATIO_TOLERANCE: Final = 0.05
_MOST_NOTES: Final = 20
_GATEWAY_NS: Final = 100_000_000
"""A gateway forwards within this; the same shift of the same sender on two channels is one."""

TRANSMISSION: Final = 3
"""Source address of transmission #1 (SAE J1939-81)."""


@dataclass(frozen=True, slots=True)
class Shift:
    """A gear shift in a log.

    from_gear, to_gear: None if unknown; negative is reverse, 0 neutral, 126 park.
    from_ratio, to_ratio: input by output shaft speed before and after, None where not known.
    method: "flag" (SPN 574, shift in process) or "gear" (SPN 523, current gear changed).
    chatter: one-sample changes of the flag left out inside.
    silent_ns: how long its sender was not recorded from the last sample before the shift to its end:
    so much shorter the shift may have been, or longer if it began unrecorded.
    engine: torque and speed around it, None if the log has no EEC1 there.
    """

    start_ns: int
    end_ns: int
    from_gear: int | None
    to_gear: int | None
    source: int
    channel: str
    method: str
    chatter: int = 0
    from_ratio: float | None = None
    to_ratio: float | None = None
    silent_ns: int = 0
    engine: EngineFigures | None = None

    @property
    def duration_s(self) -> float:
        """From its first to its last instant."""
        return (self.end_ns - self.start_ns) / 1e9

    def as_dict(self) -> dict[str, Any]:
        """Return all of it as plain JSON values."""
        return asdict(self) | {"duration_s": self.duration_s}

    def __str__(self) -> str:
        sender = f"source {self.source:#04x}" + (f" on {self.channel}" if self.channel else "")
        when = f"{format_ns(self.start_ns)} s to {format_ns(self.end_ns)} s"
        silent = f", {self.silent_ns / 1e9:.3f} s of it not recorded" if self.silent_ns else ""
        ratio = ""
        if self.from_ratio is not None and self.to_ratio is not None:
            ratio = f", ratio {self.from_ratio:.2f} to {self.to_ratio:.2f}"
        engine = f", {self.engine}" if self.engine else ""
        return (
            f"{when} ({self.duration_s:.3f} s{silent}): {gear_name(self.from_gear)} to "
            f"{gear_name(self.to_gear)}{ratio}, {sender}, by {self.method}{engine}"
        )


def gear_name(gear: int | None) -> str:
    """Return a gear as a driver reads it: N, P, 4, R1; ? for an unknown one."""
    if gear is None:
        return "?"
    return _GEAR_NAMES.get(gear, f"{gear}" if gear > 0 else f"R{-gear}")


class ShiftFinder:
    """Finds the shifts in a log: `follow` each identifier, then `finish`.

    Senders (channel and source address) are followed apart, of engines the first on each channel.
    """

    def __init__(self) -> None:
        self._flags: dict[tuple[str, int], FlagTracker] = defaultdict(FlagTracker)
        self._gears: dict[tuple[str, int], GearHistory] = defaultdict(GearHistory)
        self._engines: dict[str, tuple[int, EngineTrace]] = {}
        self._short = 0
        self.unflagged: list[Shift] = []
        self.notes: list[str] = []

    def follow(self, channel: str, can_id: int) -> Callable[[LogFrame], None] | None:
        """Return what takes the data frames of an extended identifier, None if they show no shift."""
        _, pgn, source, _ = split_id(can_id)
        take: Callable[[int, bytes], bool | None]
        if pgn == PGN_ETC1:
            take = self._flags[channel, source].take
        elif pgn == PGN_ETC2:
            take = self._gears[channel, source].take
        elif pgn == PGN_EEC1:
            first, engine = self._engines.setdefault(channel, (source, EngineTrace()))
            if first != source:
                return None
            take = engine.take
        else:
            return None

        def take_frame(frame: LogFrame) -> None:
            data = frame[2]
            if len(data) < 8:
                self._short += 1
            elif take(frame[0], data) and channel in self._engines:
                self._engines[channel][1].keep(frame[0])

        return take_frame

    @property
    def chatter(self) -> int:
        """One-sample changes left out, of flags and gears."""
        flags = sum(tracker.chatter for tracker in self._flags.values())
        return flags + sum(history.chatter for history in self._gears.values())

    @property
    def unfinished(self) -> int:
        """Shifts without beginning or end."""
        return sum(tracker.unfinished for tracker in self._flags.values())

    @property
    def engines(self) -> dict[str, EngineTrace]:
        """Torque and speed around shifts, of the engine on each channel."""
        return {channel: trace for channel, (_, trace) in self._engines.items()}

    def finish(self) -> list[Shift]:
        """All shifts, by their start."""
        for trace in self.engines.values():
            trace.sort()
        found: list[Shift] = []
        for sender, tracker in self._flags.items():
            tracker.finish()
            if tracker.clock_steps:
                self.notes.append(
                    f"source {sender[1]:#04x}: the clock stepped back {tracker.clock_steps} times"
                )
            if silent := [shift for shift in tracker.shifts if shift.silent_ns]:
                self.notes.append(
                    f"source {sender[1]:#04x}: not recorded for over 1 s in {counted(len(silent), 'shift')}, "
                    "so no times in them are known better"
                )
            found += self._flagged(sender, tracker)
        flagged = found
        found = self._once(found)
        flagged_channels = {key[0] for key, tracker in self._flags.items() if tracker.shifts}
        for sender, history in self._gears.items():
            by_gear = self._by_gear(sender, history)
            alone = [s for s in by_gear if not _near_any(s, flagged)]
            if sender[0] in flagged_channels:
                self.unflagged += alone
            else:
                found += [s for s in alone if not _repeats(s, found)]
        if self._short:
            self.notes.append(f"{self._short} ETC1 or ETC2 frames of fewer than 8 bytes")
        if not found:
            self._explain()
        found = [replace(shift, engine=self._engine(shift)) for shift in found]
        return sorted(found, key=lambda shift: (shift.start_ns, shift.source, shift.channel))

    def _by_gear(self, sender: tuple[str, int], history: GearHistory) -> list[Shift]:
        """Return the changes of gear of a sender; one while it was silent has no shift time."""
        found = []
        for change in history.changes():
            shift = Shift(*change, sender[1], sender[0], "gear")
            silent_ns = history.silences.within(shift.start_ns + 1, shift.end_ns)
            if not silent_ns:
                found.append(shift)
            elif len(self.notes) < _MOST_NOTES:
                self.notes.append(
                    f"source {sender[1]:#04x} was silent for {silent_ns / 1e9:.3f} s at "
                    f"{format_ns(shift.start_ns)} s, then in {gear_name(shift.to_gear)} instead of "
                    f"{gear_name(shift.from_gear)}: the shift between has no known time"
                )
        return found

    def _engine(self, shift: Shift) -> EngineFigures | None:
        if shift.channel not in self._engines:
            return None
        return self._engines[shift.channel][1].figures(shift.start_ns, shift.end_ns)

    def _once(self, found: list[Shift]) -> list[Shift]:
        """One of each shift that a gateway or another unit repeats: a truck shifts one at a time.

        The one of the transmission's own address, and of the first channel, is returned.
        """
        found_once: list[Shift] = []
        for shift in sorted(found, key=lambda shift: shift.source != TRANSMISSION):
            twins = [
                other
                for other in found_once
                if (other.source, other.channel) != (shift.source, shift.channel)
                and abs(other.start_ns - shift.start_ns) < _GATEWAY_NS
                and abs(other.end_ns - shift.end_ns) < _GATEWAY_NS
            ]
            if twins:
                note = f"shifts on channel {shift.channel} repeat those on {twins[0].channel}"
                if shift.source != twins[0].source:
                    note = f"shifts of {shift.source:#04x} repeat those of {twins[0].source:#04x}"
                if note not in self.notes:
                    self.notes.append(note)
            else:
                found_once.append(shift)
        return found_once

    def _explain(self) -> None:
        """Say why there are no shifts."""
        if not self._flags and not self._gears:
            self.notes.append("no ETC1 (PGN 61442) and no ETC2 (PGN 61445) in the log")
        elif not any(tracker.flagged for tracker in self._flags.values()) and not any(
            run.current is not None for history in self._gears.values() for run in history.runs
        ):
            self.notes.append("neither shift in process nor a current gear is available")

    def _history(self, sender: tuple[str, int]) -> GearHistory | None:
        """Return the gears of the same sender, or of the only one on its channel."""
        own = self._gears.get(sender)
        if own is not None:
            return own
        others = [history for key, history in self._gears.items() if key[0] == sender[0]]
        return others[0] if len(others) == 1 else None

    def _flagged(self, sender: tuple[str, int], tracker: FlagTracker) -> list[Shift]:
        history = self._history(sender)
        channel, source = sender
        found: list[Shift] = []
        for index, flagged in enumerate(tracker.shifts):
            following = tracker.shifts[index + 1 : index + 2]
            until_ns = following[0].start_ns if following else flagged.end_ns + SETTLE_NS
            if until_ns < flagged.end_ns:
                until_ns = flagged.end_ns + SETTLE_NS
            before = history.gear_before(flagged.start_ns) if history else None
            after = history.gear_after(flagged.end_ns, until_ns) if history else None
            shift = Shift(flagged.start_ns, flagged.end_ns, before, after, source, channel, "flag")
            names = ("chatter", "from_ratio", "to_ratio", "silent_ns")
            found.append(replace(shift, **{name: getattr(flagged, name) for name in names}))
        return self._gears_by_ratio(found)

    def _gears_by_ratio(self, found: list[Shift]) -> list[Shift]:
        """Fill in gears that nothing reported, from speed ratios that are known for gears."""
        known: dict[int, float] = {}
        for shift in found:
            for gear, ratio in (
                (shift.from_gear, shift.from_ratio),
                (shift.to_gear, shift.to_ratio),
            ):
                if gear and ratio is not None:
                    known.setdefault(gear, ratio)
        return [
            replace(
                shift,
                from_gear=_by_ratio(shift.from_gear, shift.from_ratio, known),
                to_gear=_by_ratio(shift.to_gear, shift.to_ratio, known),
            )
            for shift in found
        ]


def _by_ratio(gear: int | None, ratio: float | None, known: Mapping[int, float]) -> int | None:
    if gear is not None or ratio is None or not known:
        return gear
    nearest = min(known, key=lambda candidate: abs(known[candidate] - ratio))
    close = abs(known[nearest] - ratio) <= RATIO_TOLERANCE * known[nearest]
    return nearest if close else None


def _near_any(shift: Shift, flagged: Iterable[Shift]) -> bool:
    """Return whether a change of gear belongs to one of the flagged shifts, of whichever channel."""
    return any(
        other.start_ns - SETTLE_NS <= shift.end_ns and shift.start_ns <= other.end_ns + SETTLE_NS
        for other in flagged
    )


def _repeats(shift: Shift, found: Iterable[Shift]) -> bool:
    """Return whether a change of gear is one that another sender reported, too."""
    return any(
        (other.source, other.channel) != (shift.source, shift.channel)
        and (other.from_gear, other.to_gear) == (shift.from_gear, shift.to_gear)
        and abs(other.end_ns - shift.end_ns) < SETTLE_NS
        for other in found
    )

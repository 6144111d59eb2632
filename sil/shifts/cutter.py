"""Cuts the gear shifts out of a log: those that a truck's transmission reports, and those commanded."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, replace
from itertools import zip_longest
from typing import Any, Final

from can_dbc.frame import split_id
from can_dbc.messages import GEAR_PARK
from sil.logs.frame import LogFrame
from sil.logs.times import format_ns
from sil.shifts.engine import PGN_EEC1, EngineFigures, EngineTrace
from sil.shifts.reported import PGN_ETC1, PGN_ETC2, SETTLE_NS, FlagTracker, GearHistory

TRANSMISSION: Final = 3
"""Source address of transmission #1 (SAE J1939-81)."""


@dataclass(frozen=True, slots=True)
class Shift:
    """A gear shift in a log.

    from_gear, to_gear: None if unknown; negative is reverse, 0 neutral, 126 park.
    from_ratio, to_ratio: input by output shaft speed before and after, None where not known.
    method: "flag" (SPN 574, shift in process) or "gear" (SPN 523, current gear changed).
    engine: torque and speed around it, None if the log has no EEC1 there.
    """

    start_ns: int
    end_ns: int
    from_gear: int | None
    to_gear: int | None
    source: int
    channel: str
    method: str
    from_ratio: float | None = None
    to_ratio: float | None = None
    engine: EngineFigures | None = None

    @property
    def duration_s(self) -> float:
        """From its first to its last instant."""
        return (self.end_ns - self.start_ns) / 1e9

    @property
    def gears(self) -> str:
        """Gear before and after, as a driver reads them: N to 4."""
        return f"{gear_name(self.from_gear)} to {gear_name(self.to_gear)}"

    def as_dict(self) -> dict[str, Any]:
        """Return all of it as plain JSON values."""
        return asdict(self) | {"duration_s": self.duration_s}

    def __str__(self) -> str:
        sender = f"source {self.source:#04x}" + (f" on {self.channel}" if self.channel else "")
        when = f"{format_ns(self.start_ns)} s to {format_ns(self.end_ns)} s"
        ratio = ""
        if self.from_ratio is not None and self.to_ratio is not None:
            ratio = f", ratio {self.from_ratio:.2f} to {self.to_ratio:.2f}"
        engine = f", {self.engine}" if self.engine else ""
        how = f"{ratio}, {sender}, by {self.method}{engine}"
        return f"{when} ({self.duration_s:.3f} s): {self.gears}{how}"


def gear_name(gear: int | None) -> str:
    """Return a gear as a driver reads it: N, P, 4, R1; ? for an unknown one."""
    if gear is None:
        return "?"
    return {0: "N", GEAR_PARK: "P"}.get(gear, f"{gear}" if gear > 0 else f"R{-gear}")


class ShiftFinder:
    """Finds the shifts in a log: `follow` each identifier, then `finish`.

    Senders (channel and source address) are followed apart, of engines the first on each channel.
    engines: torque and speed around shifts, by channel. chatter: one-sample changes left out, of flags
    and gears. unfinished: shifts without beginning or end.
    """

    def __init__(self) -> None:
        self._flags: dict[tuple[str, int], FlagTracker] = defaultdict(FlagTracker)
        self._gears: dict[tuple[str, int], GearHistory] = defaultdict(GearHistory)
        self._engine_sources: dict[str, int] = {}
        self._short = 0
        self.engines: dict[str, EngineTrace] = defaultdict(EngineTrace)
        self.unflagged: list[Shift] = []
        self.notes: list[str] = []
        self.chatter = self.unfinished = 0

    def follow(self, channel: str, can_id: int) -> Callable[[LogFrame], None] | None:
        """Return what takes the data frames of an extended identifier, None if they show no shift."""
        _, pgn, source, _ = split_id(can_id)
        take: Callable[[int, bytes], None]
        if pgn == PGN_ETC1:
            take = self._flags[channel, source].take
        elif pgn == PGN_ETC2:
            take = self._gears[channel, source].take
        elif pgn == PGN_EEC1 and self._engine_sources.setdefault(channel, source) == source:
            take = self.engines[channel].take
        else:
            return None

        def take_frame(frame: LogFrame) -> None:
            data = frame[2]
            if len(data) < 8:
                self._short += 1
            else:
                take(frame[0], data)

        return take_frame

    def finish(self) -> list[Shift]:
        """All shifts, by their start."""
        for trace in self.engines.values():
            trace.sort()
        flagged: list[Shift] = []
        for sender, tracker in self._flags.items():
            tracker.finish()
            source = f"source {sender[1]:#04x}"
            if tracker.clock_steps:
                self.notes.append(f"{source}: the clock stepped back {tracker.clock_steps} times")
            flagged += self._flagged(sender, tracker)
        shifts = self._once(flagged)
        flagged_channels = {shift.channel for shift in flagged}
        for sender, history in self._gears.items():
            by_gear = (Shift(*change, sender[1], sender[0], "gear") for change in history.changes())
            alone = [shift for shift in by_gear if not _near_any(shift, flagged)]
            if sender[0] in flagged_channels:
                self.unflagged += alone
            else:
                shifts += [s for s in alone if not _repeats(s, shifts)]
        self.chatter = sum(tracker.chatter for tracker in self._flags.values())
        self.chatter += sum(history.chatter for history in self._gears.values())
        self.unfinished = sum(tracker.unfinished for tracker in self._flags.values())
        if self._short:
            self.notes.append(f"{self._short} ETC1 or ETC2 frames of fewer than 8 bytes")
        if not shifts:
            self._explain()
        shifts = [replace(shift, engine=self._engine(shift)) for shift in shifts]
        return sorted(shifts, key=lambda shift: (shift.start_ns, shift.source, shift.channel))

    def _engine(self, shift: Shift) -> EngineFigures | None:
        if shift.channel not in self.engines:
            return None
        return self.engines[shift.channel].figures(shift.start_ns, shift.end_ns)

    def _once(self, shifts: list[Shift]) -> list[Shift]:
        """One of each shift that a gateway or another unit repeats: a truck shifts one at a time.

        The one of the transmission's own address, and of the first channel, is returned. A gateway
        forwards within 100 ms.
        """
        kept: list[Shift] = []
        for shift in sorted(shifts, key=lambda shift: shift.source != TRANSMISSION):
            twins = [
                other
                for other in kept
                if (other.source, other.channel) != (shift.source, shift.channel)
                and abs(other.start_ns - shift.start_ns) < 100_000_000
                and abs(other.end_ns - shift.end_ns) < 100_000_000
            ]
            if not twins:
                kept.append(shift)
                continue
            note = f"shifts on channel {shift.channel} repeat those on {twins[0].channel}"
            if shift.source != twins[0].source:
                note = f"shifts of {shift.source:#04x} repeat those of {twins[0].source:#04x}"
            if note not in self.notes:
                self.notes.append(note)
        return kept

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
        if sender in self._gears:
            return self._gears[sender]
        others = [history for key, history in self._gears.items() if key[0] == sender[0]]
        return others[0] if len(others) == 1 else None

    def _flagged(self, sender: tuple[str, int], tracker: FlagTracker) -> list[Shift]:
        history = self._history(sender)
        channel, source = sender
        shifts: list[Shift] = []
        for flagged, following in zip_longest(tracker.shifts, tracker.shifts[1:]):
            until_ns = flagged.end_ns + SETTLE_NS
            if following is not None and following.start_ns >= flagged.end_ns:
                until_ns = following.start_ns
            shift = Shift(
                **asdict(flagged),
                from_gear=history.gear_before(flagged.start_ns) if history else None,
                to_gear=history.gear_after(flagged.end_ns, until_ns) if history else None,
                source=source,
                channel=channel,
                method="flag",
            )
            shifts.append(shift)
        return shifts


def _near_any(shift: Shift, flagged: Iterable[Shift]) -> bool:
    """Return whether a change of gear belongs to one of the flagged shifts, of whichever channel."""
    return any(
        s.start_ns - SETTLE_NS <= shift.end_ns and shift.start_ns <= s.end_ns + SETTLE_NS
        for s in flagged
    )


def _repeats(shift: Shift, shifts: Iterable[Shift]) -> bool:
    """Return whether a change of gear is one that another sender reported, too."""
    return any(
        (other.source, other.channel) != (shift.source, shift.channel)
        and (other.from_gear, other.to_gear) == (shift.from_gear, shift.to_gear)
        and abs(other.end_ns - shift.end_ns) < SETTLE_NS
        for other in shifts
    )


class CommandedShifts:
    """Cuts by the commands of the valves: from the first one into vented chambers until all are vented.

    begin_ns: of the shift under way. skipped: shifts that cannot be used, by the reason.
    """

    _VENTED_NS = 270_000_000
    """Time after which the chambers of closed valves are at the atmosphere's pressure."""

    def __init__(self) -> None:
        self.begin_ns: int | None = None
        self.skipped: Counter[str] = Counter()
        self._energised = False
        self._off_ns = -1_000_000_000

    def command(self, at_ns: int, energised: bool, in_gear: Callable[[], bool]) -> int | None:
        """Take whether any valve is energised from now on; return the begin of a shift that this ends.

        A command out of an engaged gear ends the shift into it, before the chambers are vented.
        """
        ended: int | None = None
        if energised and not self._energised:
            vented = at_ns >= self._off_ns + self._VENTED_NS
            if self.begin_ns is not None and not vented and in_gear():
                ended, self.begin_ns = self.begin_ns, None
            if self.begin_ns is None and vented:
                self.begin_ns = at_ns
            elif self.begin_ns is None:
                self.skipped["begun before the chambers were vented"] += 1
        self._energised = energised
        if not energised:
            self._off_ns = at_ns
        return ended

    def pass_time(self, now_ns: int) -> int | None:
        """Return the begin of a shift that is over by now; one that does not end in 4 s is skipped."""
        begin_ns = self.begin_ns
        if begin_ns is not None and self._energised and now_ns - begin_ns > 4_000_000_000:
            self.skipped["energised for more than 4 s"] += 1
            self.begin_ns = None
        if self._energised or now_ns < self._off_ns + self._VENTED_NS:
            return None
        self.begin_ns = None
        return begin_ns

    def finish(self, last_ns: int) -> int | None:
        """Return the begin of the shift that the end of the log completes, `last_ns` its last pulse."""
        begin_ns, self.begin_ns = self.begin_ns, None
        if begin_ns is not None and (self._energised or last_ns < self._off_ns + 200_000_000):
            self.skipped["without its end in the log"] += 1
            return None
        return begin_ns

"""What J1939 traffic a log holds: parameter groups, senders, long messages and gear shifts."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from itertools import chain
from typing import Any

from can_dbc.frame import split_id
from sil.files.quantity import counted
from sil.j1939.transport import PGN_CONTROL, PGN_DATA, Assembler
from sil.logs.frame import LogFrame
from sil.shifts.cutter import Shift, ShiftFinder
from sil.shifts.engine import EngineTrace


@dataclass(slots=True)
class _Identifier:
    """How often an identifier came, and who takes its frames."""

    take: Callable[[LogFrame], object] | None
    frames: int = 0


@dataclass(slots=True)
class J1939Summary:
    """What J1939 traffic a log holds.

    groups: frames by parameter group and source. unflagged: changes of the reported gear with
    no flagged shift around them. chatter: flag changes of one sample left out.
    unfinished: shifts under way where the log (or its clock) begins or ends. first_ns: time of the log's
    first frame. transport: what became of long messages. engines: by channel.
    """

    frames: int
    j1939_frames: int
    groups: dict[tuple[int, int], int]
    shifts: list[Shift]
    unflagged: list[Shift]
    chatter: int
    unfinished: int
    notes: list[str]
    first_ns: int | None
    transport: Assembler
    engines: Mapping[str, EngineTrace]

    def as_dict(self) -> dict[str, Any]:
        """Return all of it as plain JSON values."""
        return {
            "frames": self.frames,
            "first_ns": self.first_ns,
            "j1939_frames": self.j1939_frames,
            "groups": [
                {"pgn": pgn, "source": source, "frames": count}
                for (pgn, source), count in sorted(self.groups.items())
            ],
            "shifts": [shift.as_dict() for shift in self.shifts],
            "unflagged_gear_changes": [shift.as_dict() for shift in self.unflagged],
            "chatter": self.chatter,
            "unfinished": self.unfinished,
            "long_messages": self.transport.assembled,
            "long_messages_lost": dict(self.transport.lost),
            "notes": list(self.notes),
        }

    def lines(self) -> list[str]:
        """Return the summary as text, shifts first."""
        lines = [f"{counted(len(self.shifts), 'shift')} in {counted(self.frames, 'frame')}"]
        for number, shift in enumerate(self.shifts, 1):
            after_s = (shift.start_ns - (self.first_ns or 0)) / 1e9
            lines.append(f"  {number}. +{after_s:.3f} s: {shift}")
        if self.unflagged:
            changes = counted(len(self.unflagged), "change")
            lines.append(f"{changes} of gear outside of flagged shifts")
            lines += [f"  {shift}" for shift in self.unflagged]
        if self.chatter:
            lines.append(f"{self.chatter} one-sample changes of the flag or gear left out")
        if self.unfinished:
            lines.append(f"{counted(self.unfinished, 'shift')} without beginning or end in the log")
        return lines + self.transport.lines() + self.notes


def summarize(log: Iterable[LogFrame]) -> J1939Summary:
    """Parameter groups, senders and shifts of a truck's log, in one pass."""
    finder = ShiftFinder()
    transport = Assembler()
    identifiers: dict[tuple[str, int], _Identifier] = {}
    others = 0
    frames = iter(log)
    first = next(frames, None)
    for frame in () if first is None else chain((first,), frames):
        if not frame[3] or frame[4] or frame[5]:  # standard, remote or error
            others += 1
            continue
        key = frame[9], frame[1]
        identifier = identifiers.get(key)
        if identifier is None:
            is_long = split_id(frame[1]).pgn in (PGN_CONTROL, PGN_DATA)
            identifier = _Identifier(transport.take if is_long else finder.follow(*key))
            if len(identifiers) < 20_000:
                identifiers[key] = identifier
            else:
                others += 1
        identifier.frames += 1
        if identifier.take is not None:
            identifier.take(frame)
    transport.finish()
    groups: Counter[tuple[int, int]] = Counter()
    for (_, can_id), identifier in identifiers.items():
        parts = split_id(can_id)
        groups[parts.pgn, parts.source] += identifier.frames
    shifts = finder.finish()
    names = "unflagged", "chatter", "unfinished", "notes", "engines"
    return J1939Summary(
        frames=groups.total() + others,
        j1939_frames=groups.total(),
        groups=dict(groups),
        shifts=shifts,
        first_ns=None if first is None else first.time_ns,
        transport=transport,
        **{name: getattr(finder, name) for name in names},
    )

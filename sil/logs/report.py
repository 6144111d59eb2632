"""What reading a log found: counts, and the locations of what is broken."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, Final, NoReturn

from can_dbc.errors import InputError
from sil.files.quantity import counted

MOST_LOCATIONS: Final = 10  # locations of each kind that a report holds; all of them are counted


_CUT: Final = "cut off at"


def printable(text: str) -> str:
    """Return text out of a file, read as Latin-1, fit for a message of one line; UTF-8 is shown as such."""
    text = re.sub(r"(?:[\x80-\xff]|\\x[89a-f][0-9a-f])+", _as_utf8, text)
    return "".join(character if character.isprintable() else "?" for character in text)


def _as_utf8(match: re.Match[str]) -> str:
    raw = re.sub(r"\\x(..)", lambda escape: chr(int(escape[1], 16)), match[0]).encode("latin-1")
    try:
        return raw.decode()
    except UnicodeDecodeError:
        return match[0]


@dataclass(frozen=True, slots=True)
class Location:
    """A line (from 1) or byte (from 0) of a file, after unpacking, and what is wrong there."""

    reason: str
    line: int | None = None
    byte: int | None = None

    def __str__(self) -> str:
        line = None if self.line is None else f"line {self.line}"
        byte = None if self.byte is None else f"byte {self.byte}"
        return ": ".join(filter(None, (line or byte, printable(self.reason))))


@dataclass(slots=True)
class LogReport:
    """Counts of one reading of a log; complete once the reader is exhausted.

    frames: all frames read; error, remote and fd are shares of it.
    other: things in the log that are no CAN frames, by name (status lines, LIN frames, ...).
    skipped: broken lines or records left out; backwards: steps of the clock to an earlier time;
    duplicates: frames that repeat one of the same instant in every field; places: the first of each of these.
    truncated: the log ends inside a line, record or block.
    lockstep: frames left out because they coordinated a lockstep run, by name.
    time_base: "absolute", "relative", "delta" (differences, summed up) or "none".
    files: of several files read as one log, when each begins and ends.
    """

    path: str
    format: str
    frames: int = 0
    error: int = 0
    remote: int = 0
    fd: int = 0
    skipped: int = 0
    backwards: int = 0
    duplicates: int = 0
    places: dict[str, list[str]] = field(
        default_factory=lambda: {"skipped": [], "backwards": [], "duplicates": []}
    )
    truncated: bool = False
    other: Counter[str] = field(default_factory=Counter)
    lockstep: Counter[str] = field(default_factory=Counter)
    notes: list[str] = field(default_factory=list)
    first_ns: int | None = None
    last_ns: int | None = None
    start_ns: int | None = None
    time_base: str = "absolute"
    strict: bool = False
    files: list[str] = field(default_factory=list)

    @classmethod
    def joined(cls, reports: Sequence[LogReport]) -> LogReport:
        """Return the report of several files; locations and notes begin with the name of theirs."""
        first, last = reports[0], reports[-1]
        joined = cls(
            "+".join(r.path for r in reports), "+".join(dict.fromkeys(r.format for r in reports))
        )
        joined.first_ns, joined.last_ns = first.first_ns, last.last_ns
        joined.time_base = first.time_base
        for report in reports:
            for name in ("frames", "error", "remote", "fd", "skipped", "backwards", "duplicates"):
                setattr(joined, name, getattr(joined, name) + getattr(report, name))
            joined.truncated |= report.truncated
            joined.other += report.other
            joined.notes += [f"{report.path}: {note}" for note in report.notes]
            for kind, places in report.places.items():
                joined.places[kind] += [f"{report.path}: {place}" for place in places]
        return joined

    def broken(self, kind: str, place: str, expected: str) -> None:
        """Count one that is "skipped", "backwards" or in "duplicates". Raises InputError if `strict`."""
        if self.strict:
            raise InputError(f"{self.path}: {place}; expected {expected}")
        setattr(self, kind, getattr(self, kind) + 1)
        if len(self.places[kind]) < MOST_LOCATIONS:
            self.places[kind].append(place)

    def skip(self, location: Location) -> None:
        """Count a broken line or record. Raises InputError if `strict`."""
        self.broken("skipped", str(location), f"a whole {self.format} log")

    def cut(self, location: Location) -> None:
        """Mark the log as cut off. Raises InputError if `strict`."""
        if not self.truncated:
            self.truncated = True
            self.note(f"{_CUT} {location}")
        if self.strict:
            raise InputError(f"{self.path}: {location}; expected a log that is not cut off")

    def refuse_second(self, location: Location) -> NoReturn:
        """Refuse a file in which logs were joined, with times of their own. Raises InputError."""
        location = replace(location, reason="a second measurement begins")
        raise InputError(f"{self.path}: {location}; expected a file for each")

    def note(self, text: str) -> None:
        """Add a remark, each only once."""
        if text not in self.notes and len(self.notes) < MOST_LOCATIONS:
            self.notes.append(text)

    @property
    def clean(self) -> bool:
        """Return whether nothing is skipped, stepping backwards, there twice or cut off."""
        return not (self.skipped or self.backwards or self.duplicates or self.truncated)

    @property
    def faults(self) -> str:
        """What is not whole, in one line; empty if it is `clean`."""
        parts = [note for note in self.notes if self.truncated and _CUT in note]
        parts += [
            f"{what}: {count}, the first {places[0]}" for what, count, places in self._kinds()
        ]
        return "; ".join(parts)

    def _kinds(self) -> Iterator[tuple[str, int, list[str]]]:
        """Yield the kinds of what is broken, with count and places."""
        titles = "broken and skipped", "clock steps backwards", "duplicates"
        for title, (kind, places) in zip(titles, self.places.items(), strict=True):
            if count := getattr(self, kind):
                yield title, count, places

    def lockstep_line(self) -> str:
        """Return what was left out of the capture of a lockstep run; empty if it is none."""
        if not self.lockstep:
            return ""
        counts = ", ".join(f"{name} ({count})" for name, count in sorted(self.lockstep.items()))
        return f"recorded during a lockstep run: times are simulated; left out: {counts}"

    def as_dict(self) -> dict[str, Any]:
        """Return all of it as plain JSON values."""
        left_out = "strict", "places"
        values = {f.name: getattr(self, f.name) for f in fields(self) if f.name not in left_out}
        return values | {f"{kind}_places": places for kind, places in self.places.items()}

    def lines(self) -> list[str]:
        """Return the report as text: one fact per line, only what is there."""
        lines = [
            f"{counted(self.frames, 'frame')} ({self.format}, {self.time_base} times)",
            *self.files,
        ]
        shares = {"error": self.error, "remote": self.remote, "fd": self.fd}
        lines += [f"  of them {name}: {count}" for name, count in shares.items() if count]
        lines += [f"not frames: {count} {name}" for name, count in sorted(self.other.items())]
        if left_out := self.lockstep_line():
            lines.append(left_out)
        for title, count, places in self._kinds():
            lines.append(f"{title}: {count}")
            lines += [f"  {place}" for place in places]
            if count > len(places):
                lines.append(f"  and {count - len(places)} more")
        return lines + self.notes

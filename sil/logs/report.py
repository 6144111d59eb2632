"""What reading a log found: counts, and where the bad places are."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import Any, Final

from can_dbc.errors import InputError

KEPT_PLACES: Final = 10
"""How many places of each kind a report remembers; all of them are counted."""


def printable(text: str) -> str:
    """Text out of a file, fit for a message of one line."""
    return "".join(character if character.isprintable() else "?" for character in text)


@dataclass(frozen=True, slots=True)
class Place:
    """A spot in a file, by line (from 1) in text or byte (from 0), and what is wrong there.

    In a compressed file both are counted in the unpacked text.
    """

    reason: str
    line: int | None = None
    byte: int | None = None

    def __str__(self) -> str:
        reason = printable(self.reason)
        if self.line is not None:
            return f"line {self.line}: {reason}"
        return reason if self.byte is None else f"byte {self.byte}: {reason}"


@dataclass(slots=True)
class LogReport:
    """Counts of one reading of a log; complete once the reader is exhausted.

    frames: all frames handed out; error, remote and fd are shares of it.
    other: things in the log that are no CAN frames, by name (status lines, LIN frames, ...).
    skipped: broken lines or records left out; backwards: steps of the clock to an earlier time;
    duplicates: frames that repeat one of the same instant in every field.
    truncated: the log ends inside a line, record or block.
    time_base: "absolute", "relative", "delta" (differences, summed up) or "none".

    Checked by: tests/unit/sil/logs/test_reader.py.
    """

    path: str
    format: str
    frames: int = 0
    error: int = 0
    remote: int = 0
    fd: int = 0
    skipped: int = 0
    skipped_places: list[Place] = field(default_factory=list)
    backwards: int = 0
    backwards_places: list[str] = field(default_factory=list)
    duplicates: int = 0
    duplicate_places: list[str] = field(default_factory=list)
    truncated: bool = False
    other: Counter[str] = field(default_factory=Counter)
    notes: list[str] = field(default_factory=list)
    first_ns: int | None = None
    last_ns: int | None = None
    start_ns: int | None = None
    time_base: str = "absolute"
    strict: bool = False

    def skip(self, place: Place) -> None:
        """Count a broken place, or refuse the log there when reading strictly.

        Raises: InputError when `strict`.
        """
        if self.strict:
            raise InputError(f"{self.path}: {place}; expected a whole {self.format} log")
        self.skipped += 1
        if len(self.skipped_places) < KEPT_PLACES:
            self.skipped_places.append(place)

    def cut(self, place: Place) -> None:
        """Mark the log as ending early, or refuse it when reading strictly.

        Raises: InputError when `strict`.
        """
        if not self.truncated:
            self.truncated = True
            self.note(f"cut off at {place}")
        if self.strict:
            raise InputError(f"{self.path}: {place}; expected a log that is not cut off")

    def note(self, text: str) -> None:
        """Keep a remark once."""
        if text not in self.notes and len(self.notes) < KEPT_PLACES:
            self.notes.append(text)

    @property
    def clean(self) -> bool:
        """Nothing skipped, no clock step backwards, no duplicate, not cut off."""
        return not (self.skipped or self.backwards or self.duplicates or self.truncated)

    def as_dict(self) -> dict[str, Any]:
        """All of it as plain JSON values."""
        return {
            "path": self.path,
            "format": self.format,
            "frames": self.frames,
            "error": self.error,
            "remote": self.remote,
            "fd": self.fd,
            "other": dict(sorted(self.other.items())),
            "skipped": self.skipped,
            "skipped_places": [str(place) for place in self.skipped_places],
            "backwards": self.backwards,
            "backwards_places": list(self.backwards_places),
            "duplicates": self.duplicates,
            "duplicate_places": list(self.duplicate_places),
            "truncated": self.truncated,
            "notes": list(self.notes),
            "first_ns": self.first_ns,
            "last_ns": self.last_ns,
            "start_ns": self.start_ns,
            "time_base": self.time_base,
        }

    def lines(self) -> list[str]:
        """The report for a reader: one fact per line, only what is there."""
        found = [f"{self.frames} frames ({self.format}, {self.time_base} times)"]
        for name in ("error", "remote", "fd"):
            count = getattr(self, name)
            if count:
                found.append(f"  of them {name}: {count}")
        found += [f"not frames: {count} {name}" for name, count in sorted(self.other.items())]
        for title, count, places in (
            ("broken and skipped", self.skipped, [str(p) for p in self.skipped_places]),
            ("clock steps backwards", self.backwards, self.backwards_places),
            ("duplicates", self.duplicates, self.duplicate_places),
        ):
            if count:
                found.append(f"{title}: {count}")
                found += [f"  {place}" for place in places]
                if count > len(places):
                    found.append(f"  and {count - len(places)} more")
        return found + self.notes

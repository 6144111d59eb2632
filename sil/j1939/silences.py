"""The times in which a sender in a log was not recorded."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

SILENCE_NS: Final = 1_000_000_000
"""A sender that is not recorded for longer was silent, or the recorder was."""

_MOST_SILENT: Final = 10
"""If more than one sample in so many follows a silence, the log is sampled slowly, and none counts."""


@dataclass(slots=True)
class Silences:
    """The times in which a sender was not recorded: `add` each, and count its samples."""

    samples: int = 0
    _found: list[tuple[int, int]] = field(default_factory=list)

    def add(self, last_ns: int, time_ns: int) -> None:
        """Take the times of two samples in a row that are farther apart than `SILENCE_NS`."""
        self._found.append((last_ns, time_ns))

    def within(self, begin_ns: int, end_ns: int) -> int:
        """Return for how many ns in all the sender was silent at some time in between or until `begin_ns`."""
        if _MOST_SILENT * len(self._found) > self.samples:
            return 0
        return sum(b - a for a, b in self._found if a < end_ns and b >= begin_ns)

"""One gear shift found in a truck's log."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Final

from sil.logs.times import format_ns

_GEAR_NAMES: Final = {0: "N", 126: "P"}


@dataclass(frozen=True, slots=True)
class Shift:
    """A gear shift in a log.

    from_gear, to_gear: None if unknown; negative is reverse, 0 neutral, 126 park.
    from_ratio, to_ratio: input by output shaft speed before and after, None where not known.
    method: "flag" (SPN 574, shift in process) or "gear" (SPN 523, current gear changed).
    chatter: one-sample changes of the flag left out inside.
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
        ratio = ""
        if None in (self.from_gear, self.to_gear) and None not in (self.from_ratio, self.to_ratio):
            ratio = f", ratio {self.from_ratio:.2f} to {self.to_ratio:.2f}"
        return (
            f"{when} ({self.duration_s:.3f} s): {_gear(self.from_gear)} to "
            f"{_gear(self.to_gear)}{ratio}, {sender}, by {self.method}"
        )


def _gear(gear: int | None) -> str:
    if gear is None:
        return "?"
    return _GEAR_NAMES.get(gear, f"{gear}" if gear > 0 else f"R{-gear}")

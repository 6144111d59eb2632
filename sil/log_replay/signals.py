"""What is compared: every field of every message of one side, with tolerances and an ignore list."""

from __future__ import annotations

import fnmatch
from collections import defaultdict
from dataclasses import dataclass, fields
from enum import IntEnum, IntFlag
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, Final

import msgspec
from msgspec import Meta

from can_dbc import typed_toml
from can_dbc.codec import decode
from can_dbc.errors import CodecError, InputError, unknown_name
from can_dbc.frame import Frame
from sil.log_replay.recorded_frames import ID_OF, KINDS, bare

NAMES: Final[dict[type, tuple[str, ...]]] = {
    kind: tuple(f"{kind.__name__}.{field.name}" for field in fields(kind)) for kind in KINDS
}
"""Names of the signals of a message, in the order of `values`."""


class Edges(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """window_s: an edge that moved farther than this is another edge."""

    window_s: Annotated[float, Meta(ge=0.0, le=10.0)] = 0.2


class Options(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What counts as a difference.

    ignore: signals, or patterns of them ("Etc1.*"), that are not compared. tolerance: largest
    difference of a signal, in its SI unit, that is none. time_s: a value is as recorded when it is
    so within this time, and an edge that moved by no more has not moved.
    """

    ignore: list[str] = []
    tolerance: dict[str, Annotated[float, Meta(ge=0.0)]] = {}
    time_s: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.0
    edges: Edges = Edges()


def load_options(path: str | Path) -> Options:
    """Read the options from a TOML file.

    Raises InputError for what is no option, and for signals that do not exist.
    """
    options = typed_toml.convert(typed_toml.read_toml(path), Options, str(path))
    names = [name for of_kind in NAMES.values() for name in of_kind]
    for key, patterns in (("ignore", options.ignore), ("tolerance", options.tolerance)):
        for name in patterns:
            if not (fnmatch.filter(names, name) if key == "ignore" else name in names):
                shown = typed_toml.one_line(name, 60)
                raise InputError(f"{path}: {key}: {shown}: {unknown_name(name, names)}")
    return options


@dataclass
class SignalCount:
    """How one signal compared."""

    compared: int = 0
    differing: int = 0
    largest: float | None = None
    first_ns: int | None = None

    def as_dict(self, base_ns: int) -> dict[str, Any]:
        """Return plain JSON values; the time on the log's clock."""
        first_s = None if self.first_ns is None else (self.first_ns + base_ns) / 1e9
        counts = {"compared": self.compared, "differing": self.differing}
        return counts | {"largest": self.largest, "first_s": first_s}


class SignalComparer:
    """Find the signals whose values differ under the options.

    counts: how each signal has compared so far.
    """

    def __init__(self, options: Options) -> None:
        self.counts: defaultdict[str, SignalCount] = defaultdict(SignalCount)
        self._compared: dict[type, tuple[tuple[int, str, float], ...]] = {
            kind: tuple(
                (index, name, options.tolerance.get(name, 0.0))
                for index, name in enumerate(names)
                if not any(fnmatch.fnmatchcase(name, pattern) for pattern in options.ignore)
            )
            for kind, names in NAMES.items()
        }

    def differing(
        self, kind: type, ours: tuple[Any, ...], theirs: tuple[Any, ...]
    ) -> list[tuple[int, str]]:
        """Return (index, name) of the signals that differ."""
        return [
            (index, name)
            for index, name, tolerance in self._compared[kind]
            if not same(ours[index], theirs[index], tolerance)
        ]

    def count(self, kind: type) -> None:
        """Count a message as compared."""
        for name in NAMES[kind]:
            self.counts[name].compared += 1

    def compare(
        self, time_ns: int, kind: type, ours: tuple[Any, ...], theirs: tuple[Any, ...] | None
    ) -> list[tuple[str, str, str]]:
        """Compare two messages, one of which may be missing, and count; return names and values that differ."""
        self.count(kind)
        if theirs is None:
            theirs = (None,) * len(ours)
        differing = self.differing(kind, ours, theirs)
        for index, name in differing:
            entry = self.counts[name]
            entry.differing += 1
            if entry.first_ns is None:
                entry.first_ns = time_ns
            a, b = ours[index], theirs[index]
            if isinstance(a, float) and isinstance(b, float):
                entry.largest = max(entry.largest or 0.0, abs(a - b))
        return [(name, value_text(ours[i]), value_text(theirs[i])) for i, name in differing]


def same(ours: Any, theirs: Any, tolerance: float) -> bool:
    """Whether two values are the same, numbers within a tolerance."""
    if ours == theirs:
        return True
    if not tolerance or not isinstance(ours, float) or not isinstance(theirs, float):
        return False
    # the values lie on the grid of the DBC: a step of exactly the tolerance is within it
    return abs(ours - theirs) <= tolerance * (1.0 + 1e-9)


def values(kind: type, data: bytes) -> tuple[Any, ...] | None:
    """Return the values of a message in SI units; None when they are not those of the contract."""
    return _decoded(kind, bare(kind, data))


@lru_cache(maxsize=65536)
def _decoded(kind: type, data: bytes) -> tuple[Any, ...] | None:
    try:
        message = decode(Frame(ID_OF[kind], data))
    except CodecError:
        return None
    return tuple(getattr(message, field.name) for field in fields(kind))


def value_text(value: Any) -> str:
    """Return a value as a reader wants it."""
    if value is None:
        return "not available"
    if isinstance(value, IntFlag):
        return "|".join(flag.name or "?" for flag in type(value) if flag in value) or "NONE"
    if isinstance(value, IntEnum):
        return value.name
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.6g}" if isinstance(value, float) else str(value)

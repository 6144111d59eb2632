"""Conversion between log formats, and of signal tables (traces) to and from MF4."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any, Unpack

from can_dbc.errors import InputError
from sil.files.quantity import counted
from sil.logs.merged import Reading, open_logs
from sil.logs.registry import open_writer
from sil.logs.report import LogReport

if TYPE_CHECKING:
    from sil.logs.traces import TraceReport


@dataclass(slots=True)
class ConvertReport:
    """What a conversion read and wrote.

    losses: what the target format could not hold, by name, counted.  Every frame read is written.
    signals: rows and names of a converted signal table, None for a log of frames.
    """

    source: str
    target: str
    read: LogReport | None = None
    format: str = ""
    written: int = 0
    losses: dict[str, int] = field(default_factory=dict)
    signals: TraceReport | None = None

    def as_dict(self) -> dict[str, Any]:
        """Return all of it as plain JSON values."""
        names = ("source", "target", "format", "written")
        return {name: getattr(self, name) for name in names} | {
            "losses": dict(sorted(self.losses.items())),
            "read": self.read and self.read.as_dict(),
            "signals": self.signals and asdict(self.signals),
        }

    def lines(self) -> list[str]:
        """Return the report as text, one fact per line."""
        if self.signals is not None:
            return [
                f"{self.target}: {counted(self.signals.rows, 'row')} of {counted(len(self.signals.names), 'signal')} "
                f"({', '.join(self.signals.names)})"
            ]
        lines = [f"{self.target}: {counted(self.written, 'frame')} ({self.format})"]
        lines += [f"lost: {name}: {count}" for name, count in sorted(self.losses.items())]
        if self.read is not None:
            lines.append(f"{self.source}:")
            lines += [f"  {line}" for line in self.read.lines()]
        return lines


def convert(
    src: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
    dst: str | os.PathLike[str],
    *,
    target_format: str | None = None,
    **how: Unpack[Reading],
) -> ConvertReport:
    """Read a log, or several as one, and write it in another format in constant memory.

    A table of signals (a CSV that begins with time_s) goes to MF4 with units, and an MF4 of such
    signals to CSV. Times that count from a date in the log's header become absolute. The target
    appears only when it is complete. `how`: the log is read.
    Raises InputError for what cannot be read (with `strict` also for anything broken) or written.
    """
    sources = [src] if isinstance(src, (str, os.PathLike)) else src
    names, target = [os.fspath(source) for source in sources], os.fspath(dst)
    for source in names:
        if os.path.exists(target) and os.path.exists(source) and os.path.samefile(source, target):
            raise InputError(f"{target}: is the source itself; expected another name")
    name = ", ".join(names)
    is_single = how.get("format") is None and len(names) == 1 and os.path.isfile(name)
    if is_single and (signals := _signals(name, target)):
        return ConvertReport(name, target, signals=signals, written=signals.rows)
    log = open_logs(names, **how)
    with open_writer(target, format=target_format) as writer:
        for frame in log:
            writer.write(frame)
    losses = dict(writer.losses)
    return ConvertReport(name, target, log.report, writer.format, writer.frames, losses)


def _signals(source: str, target: str) -> TraceReport | None:
    """Convert a table of signals if the source is one."""
    from sil.logs.traces import is_trace_csv, mf4_to_trace, trace_to_mf4

    plain = target.removesuffix(".gz").lower()
    if is_trace_csv(source):
        if not plain.endswith((".mf4", ".mdf")) or target != target.removesuffix(".gz"):
            raise InputError(
                f"{source}: holds signals, no CAN frames; expected a target .mf4 (the bus log of "
                "the same run holds the frames)"
            )
        return trace_to_mf4(source, target)
    return mf4_to_trace(source, target) if plain.endswith(".csv") else None

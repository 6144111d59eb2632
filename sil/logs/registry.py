"""The log formats, which of them a file is, and how logs are opened."""

from __future__ import annotations

import os
import re
from typing import Final

from can_dbc.errors import InputError
from sil.logs import asc, blf, candump, csv_log, mf4, trc
from sil.logs.format import Format
from sil.logs.reader import LogReader
from sil.logs.report import LogReport
from sil.logs.source import ByteSource, copy_of_stream
from sil.logs.writer import LogWriter

FORMATS: Final[dict[str, Format]] = {
    one.name: one
    for one in (
        Format("blf", (".blf",), blf.recognise, blf.BlfReader, blf.BlfWriter, "byte"),
        Format("mf4", (".mf4", ".mdf"), mf4.recognise, mf4.read, mf4.Mf4Writer, "frame"),
        Format("trc", (".trc",), trc.recognise, trc.TrcReader, trc.TrcWriter),
        Format("asc", (".asc",), asc.recognise, asc.AscReader, asc.AscWriter),
        Format("csv", (".csv",), csv_log.recognise, csv_log.CsvReader, csv_log.CsvWriter),
        Format(
            "candump",
            (".log", ".candump", ".txt"),
            candump.recognise,
            candump.CandumpReader,
            candump.CandumpWriter,
        ),
    )
}
"""In the order in which they are asked whether a file is theirs: the surest mark first."""

_SAVVYCAN: Final = "SavvyCAN (open it, then save it as GVRET CSV)"
_FOREIGN: Final = (
    (rb"\*\*\*BUSMASTER", "a BUSMASTER log", f"BUSMASTER (to ASC), or {_SAVVYCAN}"),
    (rb"(?i)vehicle spy|^\W*line,\s*abs time", "a Vehicle Spy log", _SAVVYCAN),
    (rb"(?m)^\d+\.\d+ \d?[RT](?:11|29) [0-9A-Fa-f]+", "a CRTD log", _SAVVYCAN),
    (rb"\A# Logger type: CL", "a CLX000 log", _SAVVYCAN),
    (rb"\A\s*ASCII Trace IXXAT", "an IXXAT trace", _SAVVYCAN),
    (rb"\ASQLite format 3\0", "a SQLite log", "can_logconvert of python-can (to .asc or .blf)"),
    (
        rb"(?i)\A\W*time[^\n]*[;,]\s*\"?(?:chn?|channel|can)\b[^\n]*[;,]\s*\"?id\b[^\n]*data",
        "a CSV export of CANalyzer, CANoe or Kvaser",
        "the tool that made it (export as ASC or BLF)",
    ),
)
"""Formats that are not read: how their files begin, what they are, and what converts them."""


def _format_named(name: str) -> Format:
    if name not in FORMATS:
        raise InputError(f"log format: {name!r} is unknown; expected one of {', '.join(FORMATS)}")
    return FORMATS[name]


def _format_of_name(path: str) -> Format | None:
    """Return the format that a file's name stands for, if any."""
    suffix = os.path.splitext(path.removesuffix(".gz"))[1].lower()
    return next((one for one in FORMATS.values() if suffix in one.suffixes), None)


def open_log(
    path: str | os.PathLike[str],
    *,
    format: str | None = None,
    strict: bool = False,
    times: str = "auto",
) -> LogReader:
    """Open a recorded CAN log for reading, plain or gzipped.

    format: one of `FORMATS`; None: the one that the file's content, else its name, stands for.
    strict: refuse what is otherwise skipped and counted. times: of candump logs, "delta" if they are
    differences from line to line, "recorded" if they are not; "auto" finds out.
    Raises InputError if the file cannot be opened or is no log.
    """
    name = os.fspath(path)
    if times not in ("auto", "delta", "recorded"):
        raise InputError(f"{name}: times {times!r}; expected auto, delta or recorded")
    log_format = None if format is None else _format_named(format)
    copy = copy_of_stream(name)
    source = ByteSource(name, LogReport(name, "unknown"), copy.name if copy else None)
    source.close()
    if not log_format:
        recognised = (one for one in FORMATS.values() if one.recognise(source.head))
        log_format = next(recognised, None)
    if not log_format:
        for pattern, foreign, converter in _FOREIGN:
            if re.search(pattern, source.head[:4096]):
                raise InputError(
                    f"{name}: is {foreign}, which is not read; expected one of {', '.join(FORMATS)}: "
                    f"convert it with {converter}"
                )
        log_format = _format_of_name(name)
    if not log_format:
        raise InputError(
            f"{name}: neither content nor name is that of a log; expected one of "
            f"{', '.join(FORMATS)}"
        )
    return LogReader(name, log_format, strict=strict, times=times, copy=copy)


def open_writer(path: str | os.PathLike[str], *, format: str | None = None) -> LogWriter:
    """Open a new log for writing, gzipped if its name ends in .gz; it appears when the writer is closed.

    format: one of `FORMATS`; None: the one of the name's suffix. Raises InputError if the suffix is
    unknown or the file cannot be written.
    """
    name = os.fspath(path)
    log_format = _format_of_name(name) if format is None else _format_named(format)
    if log_format is None and name == "-":
        raise InputError(f"-: of which format? expected --to, one of {', '.join(FORMATS)}")
    if log_format is None:
        suffixes = ", ".join(suffix for one in FORMATS.values() for suffix in one.suffixes)
        raise InputError(f"{name}: its suffix is of no log format; expected one of {suffixes}")
    return log_format.writer(name)

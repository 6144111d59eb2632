"""The formats, and which of them a file is."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Final

from can_dbc.errors import InputError
from sil.logs.backend import Backend, LogWriter
from sil.logs.byte_source import ByteSource
from sil.logs.reader import LogReader
from sil.logs.report import LogReport


def _candump() -> Backend:
    from sil.logs.candump import Candump

    return Candump()


def _asc() -> Backend:
    from sil.logs.asc import Asc

    return Asc()


def _blf() -> Backend:
    from sil.logs.blf import Blf

    return Blf()


def _trc() -> Backend:
    from sil.logs.trc import Trc

    return Trc()


def _mf4() -> Backend:
    from sil.logs.mf4 import Mf4

    return Mf4()


def _csv() -> Backend:
    from sil.logs.csv_log import CsvLog

    return CsvLog()


_LOADERS: Final[dict[str, Callable[[], Backend]]] = {
    "blf": _blf,
    "mf4": _mf4,
    "trc": _trc,
    "asc": _asc,
    "csv": _csv,
    "candump": _candump,
}
"""In the order in which they are asked whether a file is theirs: the surest mark first."""

FORMATS: Final = ("candump", "asc", "blf", "trc", "mf4", "csv")


def load_backend(name: str) -> Backend:
    """The format of a name.

    Raises: InputError for an unknown one.
    """
    loader = _LOADERS.get(name)
    if loader is None:
        raise InputError(f"log format: {name!r} is unknown; expected one of {', '.join(FORMATS)}")
    return loader()


def backend_of_name(path: str) -> Backend | None:
    """The format that a file's name stands for, if any."""
    suffix = os.path.splitext(path.removesuffix(".gz"))[1].lower()
    for name in FORMATS:
        backend = load_backend(name)
        if suffix in backend.suffixes:
            return backend
    return None


def backend_of_file(path: str) -> Backend:
    """The format of a file's content; for content that tells nothing, of its name.

    Raises: InputError when neither tells.
    """
    source = ByteSource(path, LogReport(path, "unknown"))
    source.close()
    head = source.head
    for name in _LOADERS:
        backend = load_backend(name)
        if backend.sniff(head):
            return backend
    named = backend_of_name(path)
    if named is None:
        raise InputError(
            f"{path}: neither content nor name is that of a log; "
            f"expected one of {', '.join(FORMATS)}"
        )
    return named


def open_log(
    path: str | os.PathLike[str],
    *,
    format: str | None = None,
    strict: bool = False,
    times: str = "auto",
) -> LogReader:
    """Open a recorded CAN log for reading.

    format: one of `FORMATS`; None asks the file's content, then its name.
    strict: refuse what is otherwise skipped and counted.
    times: candump logs only: "delta" when the times are differences from line to line, "recorded"
    when they are not; "auto" looks.
    Raises: InputError when the file cannot be opened or is no log.
    Checked by: tests/contracts/test_log_formats.py.
    """
    name = os.fspath(path)
    if times not in ("auto", "delta", "recorded"):
        raise InputError(f"{name}: times {times!r}; expected auto, delta or recorded")
    backend = load_backend(format) if format is not None else backend_of_file(name)
    if format is not None:
        ByteSource(name, LogReport(name, format)).close()
    return LogReader(name, backend, strict=strict, times=times)


def open_writer(path: str | os.PathLike[str], *, format: str | None = None) -> LogWriter:
    """Open a new log for writing; it gets its name when it is closed whole.

    format: one of `FORMATS`; None takes the name's suffix (.log, .candump, .txt, .asc, .blf,
    .trc, .mf4, .csv, each also with .gz after it).
    Raises: InputError for an unknown suffix or a place that cannot be written.
    Checked by: tests/contracts/test_log_formats.py.
    """
    name = os.fspath(path)
    backend = load_backend(format) if format is not None else backend_of_name(name)
    if backend is None:
        raise InputError(
            f"{name}: the name tells no log format; expected a suffix .log, .candump, .txt, .asc, "
            ".blf, .trc, .mf4 or .csv"
        )
    return backend.writer(name)

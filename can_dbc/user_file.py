"""Read a file that the user named: regular files only, and never more than a stated size; run its Python.

This module is in the lowest package because the DBC reader, the plant's models and sil read such
files.
"""

from __future__ import annotations

import contextlib
import os
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from can_dbc.errors import InputError

MOST_BYTES = 4 << 20
"""The largest settings file that is read."""


def read_user_file(
    path: str | os.PathLike[str], expected: str, most_bytes: int = MOST_BYTES
) -> bytes:
    """Return the content of a file; `expected` says in messages what it should be.

    Raises InputError for a file that is missing, is not a regular file (a folder, device or pipe),
    cannot be read, or is larger than `most_bytes`.
    """
    source = os.fspath(path)
    try:
        mode = os.stat(source).st_mode
        if stat.S_ISDIR(mode):
            raise InputError(f"{source}: is a folder; expected {expected}")
        if not stat.S_ISREG(mode):  # a pipe that nobody writes to would wait for ever
            raise InputError(f"{source}: is a device or pipe; expected {expected}")
        with open(source, "rb") as file:
            content = file.read(most_bytes + 1)
    except FileNotFoundError:
        raise InputError(f"{source}: no such file; expected {expected}") from None
    except OSError as error:
        raise InputError(f"{source}: {error.strerror}; expected {expected}") from None
    except InputError:
        raise
    except ValueError as error:
        why = "a null byte in the name" if "\0" in str(source) else error  # or one of no encoding
        raise InputError(f"{source!r}: {why}; expected {expected}") from None
    if len(content) > most_bytes:
        raise InputError(
            f"{source}: larger than {_size(most_bytes)}; expected {expected}, at most that large"
        )
    return content


def read_user_text(
    path: str | os.PathLike[str], expected: str, most_bytes: int = MOST_BYTES
) -> str:
    """Return the text of a UTF-8 file, without its byte order mark.

    Raises InputError as `read_user_file` does, and for bytes that are not UTF-8, with their line.
    """
    content = read_user_file(path, expected, most_bytes)
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        byte = content[error.start]
        raise InputError(
            f"{Path(path)}: line {line}: byte 0x{byte:02X} is not UTF-8; expected {expected}"
        ) from None


class ProcessExit(BaseException):
    """A user's code called os._exit."""


_LEAVE = os._exit


@contextlib.contextmanager
def exits_raise() -> Iterator[None]:
    """Let os._exit raise ProcessExit while a user's code runs; in a process that it forks it is the real one."""
    process = os.getpid()

    def exit_here(status: int) -> Any:
        if os.getpid() != process:
            return _LEAVE(status)  # pragma: no cover - ends the forked process, and its coverage
        raise ProcessExit(f"os._exit({status})")

    os._exit = exit_here
    try:
        yield
    finally:
        os._exit = _LEAVE


def _size(size: int) -> str:
    return f"{size >> 20} MiB" if size >= 1 << 20 else f"{size} bytes"

"""Read a file that the user named: regular files only, never more than a stated size; run its Python."""

from __future__ import annotations

import contextlib
import json
import os
import stat
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, BinaryIO

from can_dbc.errors import InputError


def read_user_file(path: str | os.PathLike[str], expected: str, most_bytes: int = 4 << 20) -> bytes:
    """Return the content of a file; `expected` says in messages what it should be.

    Raises InputError for a file that is missing, no regular one, unreadable, or larger than `most_bytes`.
    """
    source = os.fspath(path)
    with regular_file(source, expected) as file:
        content = file.read(most_bytes + 1)
    if len(content) > most_bytes:
        raise InputError(
            f"{source}: larger than {_size(most_bytes)}; expected {expected}, at most that large"
        )
    return content


@contextlib.contextmanager
def regular_file(path: str | os.PathLike[str], expected: str) -> Iterator[BinaryIO]:
    """Open a file that the user named; `expected` says in messages what it should be.

    Raises InputError for a file that is missing, is a folder, device or pipe, or cannot be read.
    """
    source = os.fspath(path)
    try:
        mode = os.stat(source).st_mode
        if stat.S_ISDIR(mode):
            raise InputError(f"{source}: is a folder; expected {expected}")
        if not stat.S_ISREG(mode):  # a pipe that nobody writes to would wait for ever
            raise InputError(f"{source}: is a device or pipe; expected {expected}")
        with open(source, "rb") as file:
            yield file
    except FileNotFoundError:
        raise InputError(f"{source}: no such file; expected {expected}") from None
    except OSError as error:
        raise InputError(f"{source}: {error.strerror}; expected {expected}") from None
    except InputError:
        raise
    except ValueError as error:
        why = "a null byte in the name" if "\0" in str(source) else error  # or one of no encoding
        raise InputError(f"{source!r}: {why}; expected {expected}") from None


def read_user_text(path: str | os.PathLike[str], expected: str, most_bytes: int = 4 << 20) -> str:
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


def resolved(path: str | os.PathLike[str]) -> Path:
    """Return the absolute path without links, those that lead in a circle as far as they can be followed."""
    return Path(os.path.realpath(path))


def parse_json(text: str | bytes) -> Any:
    """Return the value of a text in JSON. Raises ValueError, also if nested too deeply or with a lone surrogate."""
    try:
        value = json.loads(text)
        json.dumps(value, ensure_ascii=False).encode()  # no file or picture can hold a surrogate
    except RecursionError:
        raise ValueError("nested too deeply") from None
    return value


class ProcessExit(BaseException):
    """A user's code called os._exit."""


_LEAVE = os._exit

before_running: list[Callable[[str], None]] = []
"""What is called with the name of a user's file before its Python runs in this process."""

crash_places: list[Callable[[], str]] = []
"""What returns FILE:LINE of a user's Python that crashed a process forked from this one, or nothing."""


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


def error_text(path: Path, line: int, error: BaseException) -> str:
    """Return FILE:LINE: TYPE: TEXT; without a call of the user's code on the stack, the line given."""
    stack, file = traceback.extract_tb(error.__traceback__), str(path)
    calls = [f for f in stack if f.filename == file or path in Path(f.filename).parents]
    if calls:
        file, line = calls[-1].filename, calls[-1].lineno or line
    text = str(error)
    if isinstance(error, SyntaxError) and error.filename in (file, None):
        line, text = error.lineno or line, f"{error.msg}; expected valid Python"
    text = " ".join(text.split())
    return f"{file}:{line}: {type(error).__name__}" + (f": {text}" if text else "")


def _size(size: int) -> str:
    return f"{size >> 20} MiB" if size >= 1 << 20 else f"{size} bytes"

"""Write files atomically: readers see the old file or the complete new one, never a part."""

from __future__ import annotations

import contextlib
import os
import shutil
import sys
import tempfile
from collections.abc import Iterator
from itertools import count
from pathlib import Path
from typing import BinaryIO


class NewFile:
    """A new file that takes the name `path` by `keep`, and vanishes by `discard`.

    Until then it is `.NAME.PID.NUMBER.part` in the same folder, so that two writers never write
    into one file. A link called `path` is replaced, not followed. For "-", standard output, and for a
    FIFO it is a temporary file that `keep` copies there.
    """

    file: BinaryIO

    def __init__(self, path: Path) -> None:
        """Open the new file. Raises OSError naming `path`."""
        self._path = path
        self._part = path
        self._copied = str(path) == "-" or path.is_fifo()
        if self._copied:
            self.file = tempfile.TemporaryFile()  # noqa: SIM115 closed below
            return
        for number in count():
            self._part = path.with_name(f".{path.name}.{os.getpid()}.{number}.part")
            try:
                self.file = open(self._part, "x+b")  # noqa: SIM115 closed below
                return
            except FileExistsError:
                continue
            except OSError as error:
                raise OSError(error.errno, error.strerror, str(path)) from None

    def keep(self) -> None:
        """Close the file and give it its name. Raises OSError."""
        if self._copied:
            self.file.seek(0)
            if str(self._path) == "-":
                shutil.copyfileobj(self.file, sys.stdout.buffer, 1 << 20)
                sys.stdout.buffer.flush()
            else:
                with open(self._path, "wb") as fifo:
                    shutil.copyfileobj(self.file, fifo, 1 << 20)
        self.file.close()
        if not self._copied:
            os.replace(self._part, self._path)

    def discard(self) -> None:
        """Close and remove the file."""
        with contextlib.suppress(OSError):  # what is buffered may find no room
            self.file.close()
        with contextlib.suppress(OSError):
            if not self._copied:
                self._part.unlink(missing_ok=True)


@contextlib.contextmanager
def open_atomically(path: Path) -> Iterator[BinaryIO]:
    """Open a file that takes the name `path` when the block ends. Raises OSError naming `path`."""
    new = NewFile(path)
    try:
        yield new.file
        new.keep()
    except BaseException as error:
        new.discard()
        if isinstance(error, OSError) and error.filename in (None, str(new._part)):
            raise OSError(error.errno, error.strerror, str(path)) from None
        raise


def write_atomically(path: Path, content: str | bytes) -> None:
    """Write a file atomically, text as UTF-8.  Raises OSError naming `path`."""
    if isinstance(content, str):
        content = content.encode(errors="backslashreplace")
    with open_atomically(path) as file:
        file.write(content)

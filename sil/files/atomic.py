"""Write files atomically: readers see the old file or the complete new one, never a part."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO


@contextlib.contextmanager
def open_atomically(path: Path) -> Iterator[BinaryIO]:
    """Open a new file that takes the name `path` when the block ends, and vanishes if it fails.

    Until then it is `.NAME.PID.part` in the same folder, so that two processes never write into one
    file.  A link called `path` is replaced, not followed.  Raises OSError naming `path`.
    """
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        part.unlink(missing_ok=True)
        with open(part, "xb") as file:
            yield file
        os.replace(part, path)
    except BaseException as error:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)
        if isinstance(error, OSError) and error.filename in (None, str(part)):
            raise OSError(error.errno, error.strerror, str(path)) from None
        raise


def write_atomically(path: Path, content: str | bytes) -> None:
    """Write a file atomically, text as UTF-8.  Raises OSError naming `path`."""
    with open_atomically(path) as file:
        file.write(content.encode() if isinstance(content, str) else content)

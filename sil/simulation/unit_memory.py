"""The memory of the control unit in a scenario: a file to read, or its content."""

from __future__ import annotations

import base64
import binascii
from pathlib import Path

from can_dbc.errors import InputError, os_error_text

MOST_BYTES = 4096
CONTENT = "base64:"


def embedded(where: str, folder: Path, source: str) -> str:
    """Return the memory `where`, a file relative to a folder or a content, as its content.

    Raises InputError for a file that cannot be read, and for one that is too large.
    """
    if where.startswith(CONTENT):
        try:
            held = base64.b64decode(where.removeprefix(CONTENT), validate=True)
        except binascii.Error:
            raise InputError(f"{source}: memory: not base64; expected a file") from None
        name = source
    else:
        name = str(folder / where)
        try:
            with Path(name).open("rb") as file:
                held = file.read(MOST_BYTES + 1)
        except (OSError, ValueError) as error:
            why = os_error_text(error) if isinstance(error, OSError) else "no file name"
            raise InputError(f"{source}: memory: {why}; expected a file") from None
    if len(held) > MOST_BYTES:
        raise InputError(f"{name}: too long; expected a memory of at most {MOST_BYTES} bytes")
    return CONTENT + base64.b64encode(held).decode()


def content(memory: str) -> bytes:
    """Return the bytes of an embedded memory; none of an empty text."""
    return base64.b64decode(memory.removeprefix(CONTENT))

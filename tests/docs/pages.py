"""The pages of the documentation, and the files and commands in their code blocks."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from tests.conftest import ROOT

DOCS = ROOT / "docs"
PAGES = {
    path.relative_to(ROOT).as_posix(): path
    for path in (ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted(DOCS.rglob("*.md")))
}
_BLOCK = re.compile(r"```(\w+)\n(.*?)```", re.DOTALL)
_FILE = re.compile(r"(?:#|/\*) file: (\S+)")


class Block(NamedTuple):
    """A code block: its language, its text, and the file name that its first line states."""

    language: str
    text: str
    file: str | None


def blocks(path: Path) -> Iterator[Block]:
    """Yield the code blocks of a page in order."""
    for language, text in _BLOCK.findall(path.read_text(encoding="utf-8")):
        named = _FILE.match(text)
        yield Block(language, text, named[1] if named else None)


def commands(text: str) -> Iterator[tuple[list[str], int | None]]:
    """Yield the words of each command of a block and the exit code that its comment states."""
    for line in text.strip().splitlines():
        command, _, comment = line.removeprefix("$ ").partition("#")
        if command.strip():
            stated = re.search(r"exit (\d)", comment)
            yield command.split(), int(stated[1]) if stated else None


def prose(path: Path) -> str:
    """Return the text of a page without its code blocks."""
    return _BLOCK.sub("", path.read_text(encoding="utf-8"))

"""Lines of a text log in bounded memory, with their numbers and byte offsets."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final, NamedTuple, Protocol


class Readable(Protocol):
    """Anything that gives bytes, in order."""

    def read(self, size: int, /) -> bytes:
        """Up to `size` bytes, b"" at the end."""
        ...


CHUNK_BYTES: Final = 1 << 15
LONGEST_LINE: Final = 1 << 16
"""A longer "line" is no log line; its excess is dropped so that memory stays bounded."""


class Chunk(NamedTuple):
    """Whole lines of a log, some hundreds: what a processor's cache holds is read fastest.

    text: the lines, each ended by a newline (Latin-1, so that every byte has a character).
    line: number of the first one (1-based); byte: its offset.
    unterminated: the very last line of the file, and it had no newline of its own.
    """

    text: str
    line: int
    byte: int
    unterminated: bool


def chunks(stream: Readable) -> Iterator[Chunk]:
    """Split a stream into chunks of whole lines.

    A carriage return before the newline is kept; a lone carriage return ends no line.
    Checked by: tests/unit/sil/logs/test_text_lines.py.
    """
    line = 1
    offset = 0
    rest = b""
    while True:
        block = stream.read(CHUNK_BYTES)
        held = rest + block
        end = held.rfind(b"\n") + 1
        whole, rest = held[:end], held[end:]
        if whole:
            yield Chunk(whole.decode("latin-1"), line, offset, False)
            line += whole.count(b"\n")
            offset += len(whole)
        if not block:
            break
        if len(rest) > LONGEST_LINE:
            passed, after = _skip_to_newline(stream, len(rest))
            yield Chunk(rest_of_long_line(rest), line, offset, False)
            line += 1
            offset += passed
            rest = after
    if rest:
        yield Chunk(rest.decode("latin-1") + "\n", line, offset, True)


def rest_of_long_line(head: bytes) -> str:
    """What is kept of an overlong line: enough to be refused and named."""
    return head[:LONGEST_LINE].decode("latin-1") + "\n"


def _skip_to_newline(stream: Readable, passed: int) -> tuple[int, bytes]:
    """Read on to the next newline; return the bytes passed, and those after it already read."""
    while True:
        block = stream.read(CHUNK_BYTES)
        if not block:
            return passed, b""
        end = block.find(b"\n")
        if end >= 0:
            return passed + end + 1, block[end + 1 :]
        passed += len(block)


class Line(NamedTuple):
    """One line without its end, its number (1-based), byte offset, and whether it had an end."""

    text: str
    number: int
    byte: int
    unterminated: bool


def lines(stream: Readable) -> Iterator[Line]:
    """The lines of a stream, in bounded memory."""
    for chunk in chunks(stream):
        yield from chunk_lines(chunk)


def chunk_lines(chunk: Chunk) -> Iterator[Line]:
    """The lines of a chunk; only its last can be unterminated."""
    number, byte = chunk.line, chunk.byte
    for text in chunk.text[:-1].split("\n"):
        yield Line(text.removesuffix("\r"), number, byte, chunk.unterminated)
        number += 1
        byte += len(text) + 1


def line_at(chunk: Chunk, index: int) -> Line:
    """The line of a chunk at an index, counted from 0."""
    begin = 0
    for _ in range(index):
        begin = chunk.text.index("\n", begin) + 1
    end = chunk.text.index("\n", begin)
    text = chunk.text[begin:end].removesuffix("\r")
    return Line(text, chunk.line + index, chunk.byte + begin, chunk.unterminated)

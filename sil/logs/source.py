"""The bytes and lines of a log file, unpacked if gzipped, in bounded memory."""

from __future__ import annotations

import functools
import gzip
import os
import shutil
import stat
import sys
import tempfile
import zlib
from collections.abc import Callable, Iterator
from itertools import chain
from typing import BinaryIO, Final, NamedTuple

from can_dbc.errors import InputError
from sil.logs.report import Location, LogReport

LONGEST_LINE: Final = 1 << 16
"""A longer line is no line of a log; its excess is dropped so that memory stays bounded."""


class ByteSource:
    """The bytes of a file, unpacked; `head` holds the first of them, `packed` if it is gzipped."""

    most_unpacked_bytes = 16 << 30  # of a packed file: it bounds the time of reading

    def __init__(self, path: str, report: LogReport, copy: str | None = None) -> None:
        """Open a file; a gzip file that is cut off or damaged goes to the report.

        copy: the file that holds what came from standard input or a FIFO.
        Raises InputError if the file cannot be opened or is known to be no log.
        """
        self.path = path
        self._report = report
        self._unpacked = 0
        refuse_special(path, "a log file, or - for standard input")
        try:
            self.file: BinaryIO = open(copy or path, "rb")  # noqa: SIM115 closed by close()
            self.size = os.fstat(self.file.fileno()).st_size
        except OSError as error:
            raise self._unreadable(error) from None
        try:
            self._held = self.file.read(2)
            self.file.seek(0)
            self.packed = self._held == b"\x1f\x8b"
            # read1 gives what is unpacked so far before it fails on what is damaged.
            packed = gzip.GzipFile(fileobj=self.file)
            self._read: Callable[[int], bytes] = packed.read1 if self.packed else self.file.read
            self._held = b""
            self.head = self._held = self.read(1 << 14).removeprefix(b"\xef\xbb\xbf")
            others = {
                b"PK\x03\x04": "a zip archive",
                b"BZh": "a bzip2 archive",
                b"\xfd7zXZ\x00": "an xz archive",
                b"\x28\xb5\x2f\xfd": "a zstd archive",
                b"\xff\xfe": "UTF-16 text",
                b"\n\r\r\n": "a pcapng capture",
                b"\xd4\xc3\xb2\xa1": "a pcap capture",
            }
            for mark, name in others.items():
                hint = " (SavvyCAN converts it to GVRET CSV)" if "capture" in name else ""
                if self.head.startswith(mark):
                    raise InputError(f"{path}: is {name}; expected a log, plain or gzipped{hint}")
        except BaseException as error:
            self.file.close()
            raise self._unreadable(error) if isinstance(error, OSError) else error from None

    def read(self, size: int, /) -> bytes:
        """Return up to `size` bytes, b"" at the end. Raises InputError if reading fails."""
        if self._held:
            block, self._held = self._held[:size], self._held[size:]
            return block
        try:
            block = self._read(size)
        except EOFError:
            self._report.cut(Location("the gzip file ends too early", byte=self.file.tell()))
            return b""
        except (zlib.error, gzip.BadGzipFile) as error:
            self._report.skip(Location(f"damaged gzip block ({error})", byte=self.file.tell()))
            return b""
        except OSError as error:
            raise self._unreadable(error) from None
        self._unpacked += len(block)
        if self.packed and self._unpacked > self.most_unpacked_bytes:
            raise InputError(
                f"{self.path}: unpacks to over {self.most_unpacked_bytes >> 30} GiB; expected less, or the file "
                "unpacked"
            )
        return block

    def _unreadable(self, error: OSError) -> InputError:
        return InputError(f"{self.path}: {error.strerror}; expected a readable log file")

    @property
    def passed_bytes(self) -> int:
        """How many bytes of the file were read so far."""
        return self.file.tell()

    def close(self) -> None:
        """Close the file."""
        self.file.close()


def refuse_special(path: str, expected: str) -> None:
    """Refuse a folder or a device; files and FIFOs may be read and written. Raises InputError."""
    try:
        mode = os.stat(path).st_mode
    except (OSError, ValueError):  # opening it names what is wrong
        return
    if not stat.S_ISREG(mode) and not stat.S_ISFIFO(mode):
        kind = "a folder" if stat.S_ISDIR(mode) else "a device"
        raise InputError(f"{path}: is {kind}; expected {expected}")


@functools.cache
def _standard_input() -> tempfile._TemporaryFileWrapper[bytes]:
    return _copy(sys.stdin.buffer)


def copy_of_stream(path: str) -> tempfile._TemporaryFileWrapper[bytes] | None:
    """Return a file with what standard input or a FIFO gave: logs are read more than once; else None."""
    if path == "-":
        return _standard_input()
    if not os.path.exists(path) or not stat.S_ISFIFO(os.stat(path).st_mode):
        return None
    with open(path, "rb") as fifo:
        return _copy(fifo)


def _copy(stream: BinaryIO) -> tempfile._TemporaryFileWrapper[bytes]:
    copy = tempfile.NamedTemporaryFile(prefix="opc4-")  # noqa: SIM115 deleted with its last user
    shutil.copyfileobj(stream, copy, 1 << 20)
    copy.flush()
    return copy


class Chunk(NamedTuple):
    """Whole lines of a log, some hundreds: what a processor's cache holds is read fastest.

    text: the lines, each ended by a newline (Latin-1, so that every byte has a character).
    line: number of the first one (1-based); byte: its offset.
    unterminated: this is the very last line of the file, and it has no newline of its own.
    """

    text: str
    line: int
    byte: int
    unterminated: bool


class Line(NamedTuple):
    """One line without its end, its number (1-based), byte offset, and whether it has no end."""

    text: str
    number: int
    byte: int
    unterminated: bool


def chunks(stream: ByteSource | BinaryIO) -> Iterator[Chunk]:
    """Split a stream into chunks of whole lines; a carriage return alone ends no line."""
    line = 1
    offset = 0
    rest = b""
    while True:
        block = stream.read(1 << 15)
        content = rest + block
        end = content.rfind(b"\n") + 1
        whole, rest = content[:end], content[end:]
        if whole:
            yield Chunk(whole.decode("latin-1"), line, offset, False)
            line += whole.count(b"\n")
            offset += len(whole)
        if not block:
            break
        if len(rest) > LONGEST_LINE:
            passed, after = _skip_to_newline(stream, len(rest))
            yield Chunk(rest[:LONGEST_LINE].decode("latin-1") + "\n", line, offset, False)
            line += 1
            offset += passed
            rest = after
    if rest:
        yield Chunk(rest.decode("latin-1") + "\n", line, offset, True)


def _skip_to_newline(stream: ByteSource | BinaryIO, passed: int) -> tuple[int, bytes]:
    """Read on to the next newline; return the bytes passed, and those after it already read."""
    while block := stream.read(1 << 15):
        end = block.find(b"\n")
        if end >= 0:
            return passed + end + 1, block[end + 1 :]
        passed += len(block)
    return passed, b""


def chunk_lines(chunk: Chunk) -> Iterator[Line]:
    """Yield the lines of a chunk."""
    number, byte = chunk.line, chunk.byte
    for text in chunk.text[:-1].split("\n"):
        yield Line(text.removesuffix("\r"), number, byte, chunk.unterminated)
        number += 1
        byte += len(text) + 1


def lines(stream: ByteSource | BinaryIO) -> Iterator[Line]:
    """Yield the lines of a stream."""
    return chain.from_iterable(map(chunk_lines, chunks(stream)))

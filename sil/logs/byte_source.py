"""Bytes of a log file, unpacked on the way when it is gzipped, in bounded memory."""

from __future__ import annotations

import errno
import os
import zlib
from collections.abc import Callable
from typing import BinaryIO, Final, Protocol

from can_dbc.errors import InputError
from sil.logs.report import LogReport, Place

HEAD_BYTES: Final = 1 << 14
_PACKED_BLOCK: Final = 1 << 16
_PLAUSIBLE_RATIO: Final = 100
"""Logs, whose times never repeat, pack to a tenth; beyond this it is a bomb ..."""
_HARMLESS_BYTES: Final = 1 << 20
"""... unless it is this small."""
_REFUSED_MAGIC: Final = (
    (b"PK\x03\x04", "a zip archive"),
    (b"BZh", "a bzip2 archive"),
    (b"\xfd7zXZ\x00", "an xz archive"),
    (b"\x28\xb5\x2f\xfd", "a zstd archive"),
    (b"7z\xbc\xaf\x27\x1c", "a 7-zip archive"),
    (b"Rar!", "a rar archive"),
    (b"\xff\xfe", "UTF-16 text"),
    (b"\xfe\xff", "UTF-16 text"),
    (b"\n\r\r\n", "a pcapng capture"),
    (b"\xd4\xc3\xb2\xa1", "a pcap capture"),
    (b"SQLite format 3", "an SQLite database"),
)


class _Inflate(Protocol):
    def decompress(self, data: bytes, max_length: int = 0, /) -> bytes: ...


class Gunzip:
    """The unpacked bytes of a gzip file; a cut or damaged one ends early and is reported.

    `read` raises OSError for one that unpacks to far more than a log would.
    Checked by: tests/unit/sil/logs/test_byte_source.py.
    """

    def __init__(self, packed: BinaryIO, report: LogReport) -> None:
        self._packed = packed
        self._report = report
        self._inflate = zlib.decompressobj(wbits=31)
        self._held = b""
        self._ended = False
        self._members = 0
        self._unpacked = 0

    def read(self, size: int) -> bytes:
        """Up to `size` unpacked bytes; b"" at the end."""
        out: list[bytes] = []
        missing = size
        while missing > 0 and not self._ended:
            piece = self._step(missing)
            out.append(piece)
            missing -= len(piece)
            self._unpacked += len(piece)
        packed = self._packed.tell()
        if self._unpacked > max(_HARMLESS_BYTES, _PLAUSIBLE_RATIO * packed):
            raise OSError(
                errno.EFBIG, f"unpacks to over {_PLAUSIBLE_RATIO} times its size, as no log does"
            )
        return b"".join(out)

    def _step(self, size: int) -> bytes:
        if self._inflate.eof:
            self._held = self._inflate.unused_data or self._held
            self._members += 1
            self._inflate = zlib.decompressobj(wbits=31)
            self._held = (self._held or self._packed.read(_PACKED_BLOCK)).lstrip(b"\x00")
            if not self._held:
                self._ended = True
                return b""
        if not self._held:
            self._held = self._packed.read(_PACKED_BLOCK)
            if not self._held:
                self._ended = True
                self._report.cut(Place("the gzip file ends too early", byte=self._packed.tell()))
                return b""
        before = self._inflate.copy()
        try:
            piece = self._inflate.decompress(self._held, size)
        except zlib.error as error:
            self._ended = True
            self._report.skip(Place(f"damaged gzip block ({error})", byte=self._packed.tell()))
            return self._up_to_damage(before)
        self._held = self._inflate.unconsumed_tail
        return piece

    def _up_to_damage(self, inflate: _Inflate) -> bytes:
        """What the last block gives before its damaged byte."""
        out = bytearray()
        for index in range(len(self._held)):
            try:
                out += inflate.decompress(self._held[index : index + 1])
            except zlib.error:
                break
            if len(out) > HEAD_BYTES << 6:
                break
        return bytes(out)


class ByteSource:
    """A readable, once: the file's bytes, unpacked, with a look at the first of them."""

    def __init__(self, path: str, report: LogReport) -> None:
        """Open `path`.

        Raises: InputError when it cannot be opened or holds something that is named and refused.
        """
        self.path = path
        try:
            if os.path.isdir(path):
                raise InputError(f"{path}: is a folder; expected a log file")
            if os.path.exists(path) and not os.path.isfile(path):
                raise InputError(f"{path}: is a pipe or device; expected a log file")
            self.file: BinaryIO = open(path, "rb")  # noqa: SIM115 closed by close()
        except OSError as error:
            raise InputError(f"{path}: {error.strerror}; expected a readable log file") from None
        try:
            self._open_packing(report)
        except BaseException:
            self.file.close()
            raise

    def _open_packing(self, report: LogReport) -> None:
        first = _guarded(self.path, lambda: self.file.read(HEAD_BYTES))
        self.packed = first[:2] == b"\x1f\x8b"
        self._held = first
        self._read: Callable[[int], bytes] = self.file.read
        if self.packed:
            self.file.seek(0)
            self._read = Gunzip(self.file, report).read
            self._held = self._read(HEAD_BYTES)
        for magic, name in _REFUSED_MAGIC:
            if self._held.startswith(magic):
                raise InputError(
                    f"{self.path}: is {name}; expected a candump, ASC, BLF, TRC, MF4 or CSV log, "
                    "plain or gzipped"
                )
        if self._held.startswith(b"\xef\xbb\xbf"):
            self._held = self._held[3:]
        self.head = self._held

    def read(self, size: int, /) -> bytes:
        """Up to `size` bytes, fewer only at the end."""
        if not self._held:
            return _guarded(self.path, lambda: self._read(size))
        held, self._held = self._held[:size], self._held[size:]
        if len(held) < size:
            held += _guarded(self.path, lambda: self._read(size - len(held)))
        return held

    def close(self) -> None:
        """Close the file."""
        self.file.close()


def _guarded(path: str, read: Callable[[], bytes]) -> bytes:
    try:
        return read()
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}; expected a readable log file") from None

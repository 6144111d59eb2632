"""The block structure of an MF4 file, checked before asammdf follows it.

asammdf trusts the links and sizes in a file: a damaged one can make it loop, crash or fill the
memory. Damaged or missing blocks of records are replaced by zeros, so that it reads the others.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Iterator
from typing import BinaryIO, Final

from can_dbc.errors import InputError
from sil.logs.mf4_writer import packed_block
from sil.logs.report import printable

VARIABLE_LENGTH: Final = 1
"""Type of a channel whose values are stored apart, at the offsets that its records give."""

LARGEST_RECORD: Final = 1 << 16
_LARGEST_BLOCK: Final = 1 << 26
_MOST_BLOCKS: Final = 200_000
_MOST_LINKS: Final = 1 << 16
_HEADER: Final = struct.Struct("<4sIQQ")
_RECORDS: Final = ("DT", "DV", "SD", "DZ")
_DATA: Final = (*_RECORDS, "DL", "HL")
_LINK_COUNTS: Final = {"HD": (6,), "DG": (4,), "CG": (6, 7), "CN": range(8, 1000)}

Link = tuple[int, tuple[str, ...], int]
"""Where a link leads, the kinds of blocks that may be there, and what the block has to fit to: the
bytes of a record number (CG) or of a record (CN), or of what is stated to be in a data block (0: not
stated; `_MIXED`: records of several groups, of which none can be replaced)."""

_MIXED: Final = -1


class Blocks:
    """The blocks of a file that asammdf follows: links, sizes, and where the file is cut off.

    record_bytes: bytes in all blocks of records.
    cut_at: the byte of the first one that is longer than the file, or is missing.
    lost: address and bytes of each packed block of records that is damaged or missing.
    patches: address and content of what has to be written over the file to read the rest of it.
    """

    def __init__(self, path: str, file: BinaryIO, open_end: bool) -> None:
        """Follow the links from the header. Raises InputError at the first fault."""
        self._path = path
        self._file = file
        self._size = file.seek(0, os.SEEK_END)
        self._open_end = open_end
        self.record_bytes = 0
        self.cut_at: int | None = None
        self.lost: list[tuple[int, int]] = []
        self.patches: list[tuple[int, bytes]] = []
        self._lists: dict[int, int] = {}
        """Of each block of a list, the address of the link that leads there."""

        pending: list[Link] = [(64, ("HD",), 0)]
        known = set()
        while pending:
            address, kinds, context = pending.pop()
            if not address:
                continue
            try:
                kind, length, count = self._head(address)
                if kind not in kinds:
                    wanted = "data" if kinds is _DATA else f"a {kinds[0]} block"
                    raise self._broken(address, f"a {kind} block where {wanted} is expected")
            except InputError:
                if not self._replaced(address, kinds, context):
                    raise
                continue
            if address in known:
                raise self._broken(address, f"the {kind} block is linked twice")
            known.add(address)
            if len(known) > _MOST_BLOCKS:
                raise self._broken(address, f"more than {_MOST_BLOCKS} blocks")
            if kind in _RECORDS:
                self._records(address, kind, length, context)
                continue
            links, body = self._content(address, kind, length, count)
            try:
                pending += self._links(address, kind, links, body, context)
            except (struct.error, IndexError):
                raise self._broken(address, f"{kind} block of {length} bytes is short") from None

    def _broken(self, byte: int, reason: str) -> InputError:
        return InputError(f"{self._path}: byte {byte}: {reason}; expected a whole MF4")

    def _head(self, address: int) -> tuple[str, int, int]:
        """Return kind, length and number of links of the block at `address`."""
        if not 64 <= address <= self._size - _HEADER.size:
            raise self._broken(min(address, self._size), "a link leads out of the file")
        self._file.seek(address)
        mark, _, length, links = _HEADER.unpack(self._file.read(_HEADER.size))
        if mark[:2] != b"##":
            raise self._broken(address, "no block where a link leads")
        return printable(mark[2:].decode("latin-1")), length, links

    def _content(
        self, address: int, kind: str, length: int, count: int
    ) -> tuple[tuple[int, ...], bytes]:
        """Return the links of a block and its bytes after them."""
        sound = count in _LINK_COUNTS.get(kind, range(_MOST_LINKS))
        if not sound or not _HEADER.size + 8 * count <= length <= _LARGEST_BLOCK:
            raise self._broken(address, f"{kind} block of {length} bytes with {count} links")
        content = self._file.read(length - _HEADER.size)
        if len(content) < length - _HEADER.size:
            raise self._broken(address, f"the file ends inside a {kind} block")
        return struct.unpack_from(f"<{count}Q", content), content[8 * count :]

    def _links(
        self, address: int, kind: str, links: tuple[int, ...], body: bytes, context: int
    ) -> Iterator[Link]:
        """Check the fields of a block and yield the links in it that are followed."""
        if kind in ("FH", "AT", "EV", "DL", "DG", "CG", "CN"):
            yield links[0], (kind,), context
        if kind == "HD":
            yield links[0], ("DG",), 0
            yield links[1], ("FH",), 0
            yield links[3], ("AT",), 0
            yield links[4], ("EV",), 0
            yield links[5], ("MD", "TX"), 0
        elif kind == "DG":
            self._lists[links[0]] = address + _HEADER.size
            (id_size,) = struct.unpack_from("<B", body)
            if id_size not in (0, 1, 2, 4, 8):
                raise self._broken(address, f"record numbers of {id_size} bytes")
            yield links[1], ("CG",), id_size
            yield links[2], _DATA, _MIXED if id_size else 0
        elif kind == "CG":
            if links[0] and not context:
                raise self._broken(address, "record numbers of 0 bytes")
            _, _, flags, _, _, size, invalid = struct.unpack_from("<QQHHIII", body)
            values_only = flags & 1 and not links[1]  # values of variable length
            if size + invalid > LARGEST_RECORD and not values_only:
                raise self._broken(address, f"records of {size + invalid} bytes")
            yield links[1], ("CN",), size
        elif kind == "CN":
            channel, _, _, bit, byte, bits = struct.unpack_from("<BBBBII", body)
            outside = byte + (bit + bits + 7) // 8 > context
            if outside and channel not in (3, 6):  # virtual channels have no bytes
                raise self._broken(address, "a channel is outside of its record")
            if links[1] and self._head(links[1])[0] == "CN":
                yield links[1], ("CN",), context
            if channel == VARIABLE_LENGTH and links[5] and self._head(links[5])[0] != "CG":
                yield links[5], _DATA, 0
        elif kind == "HL":
            self._lists[links[0]] = address + _HEADER.size
            yield links[0], ("DL",), context
        elif kind == "DL":
            equal, size = struct.unpack_from("<B7xQ", body)
            self._lists[links[0]] = address + _HEADER.size
            stated = size if equal & 1 and size <= _LARGEST_BLOCK else 0
            yield from ((link, _DATA, context or stated) for link in links[1:])

    def _replaced(self, address: int, kinds: tuple[str, ...], context: int) -> bool:
        """Return whether what a link should lead to can be done without."""
        if kinds in (("DL",), ("DG",)) and address in self._lists:
            self.patches.append((self._lists[address], bytes(8)))
        elif kinds is _DATA and context > 0:
            self._lose(address, context)
        else:
            return False
        if self.cut_at is None and (address >= self._size - _HEADER.size or kinds is not _DATA):
            self.cut_at = min(address, self._size)
        return True

    def _lose(self, address: int, size: int) -> None:
        self.lost.append((address, size))
        self.patches.append((address, packed_block(bytes(size))))

    def _check_packed(self, address: int, size: int, packed: int, context: int) -> None:
        """Replace a packed block of records that is damaged or cut off by zeros."""
        if context == _MIXED:
            return
        self._file.seek(address + 48)
        content = self._file.read(packed)
        inflate = zlib.decompressobj()
        try:
            sound = len(inflate.decompress(content, size + 1)) == size and inflate.eof
        except zlib.error:
            sound = False
        if not sound:
            self._lose(address, context if context > 0 else size)

    def _records(self, address: int, kind: str, length: int, context: int) -> None:
        """Check a block of records, or of values of variable length."""
        available = self._size - address
        if kind == "DZ" and length > available and context != _MIXED:
            self.cut_at = address if self.cut_at is None else self.cut_at
        elif length > available or (self._open_end and length <= _HEADER.size):
            if length > available and self.cut_at is None:
                self.cut_at = address
            # longer than the file, or of a length that an unfinished file does not state yet
            self.patches.append((address + 8, available.to_bytes(8, "little")))
            length = available
        of_kind, size = kind.encode(), max(length - _HEADER.size, 0)
        if kind == "DZ":
            fields = self._file.read(24)
            if len(fields) < 24:
                raise self._broken(address, "the file ends inside a DZ block")
            of_kind, method, _, columns, size, packed = struct.unpack("<2sBBIQQ", fields)
            problem = ""
            if method > 1 or (method == 1 and not columns):
                problem = f"packing method {method}, which is not deflate"
            elif max(size, packed) > _LARGEST_BLOCK or (
                packed > length - 48 and self.cut_at is None
            ):
                problem = f"DZ block of {size} bytes, {packed} packed"
            if problem and context <= 0:
                raise self._broken(address, problem)
            if problem:
                size = context
                self._lose(address, size)
            else:
                self._check_packed(address, size, packed, context)
        if of_kind != b"SD":
            self.record_bytes += size

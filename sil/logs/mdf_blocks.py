"""The blocks of an MDF 4 file, read with every address and size checked.

Source: ASAM MDF 4.1 (public overview) as the files of CSS Electronics and asammdf show it.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from typing import BinaryIO, Final, NamedTuple

from sil.logs.report import printable

HEADER: Final = struct.Struct("<4sIQQ")
LARGEST_BLOCK: Final = 1 << 24
LARGEST_PACKED: Final = 1 << 26
PIECE: Final = 1 << 18
MOST_BLOCKS: Final = 200_000


class MdfError(ValueError):
    """The file's structure is broken at a byte; the message says how."""

    def __init__(self, byte: int, reason: str) -> None:
        super().__init__(reason)
        self.byte = byte
        self.reason = reason


class Block(NamedTuple):
    """A block: its kind without ##, links, and what follows them."""

    kind: str
    address: int
    links: tuple[int, ...]
    body: bytes

    def link(self, index: int) -> int:
        """The link at `index`, 0 when the block has none there."""
        return self.links[index] if index < len(self.links) else 0

    def unpack(self, layout: struct.Struct, offset: int = 0) -> tuple[int, ...]:
        """Fields of the body.

        Raises: MdfError when the body is too short.
        """
        if len(self.body) < offset + layout.size:
            raise MdfError(self.address, f"{self.kind} block of {len(self.body)} bytes is short")
        return layout.unpack_from(self.body, offset)


class Piece(NamedTuple):
    """A run of records' bytes and where in the file it comes from."""

    byte: int
    content: bytes


class MdfFile:
    """Access to the blocks of an open file.

    Checked by: tests/unit/sil/logs/test_mf4.py.
    """

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self.size = file.seek(0, 2)
        self._blocks = 0
        self._data_used: set[int] = set()
        self.cut_at: int | None = None
        """Where the data ends before it should, if it does."""

    def at(self, address: int, size: int) -> bytes:
        """Up to `size` bytes at `address`."""
        self._file.seek(address)
        return self._file.read(size)

    def _head(self, address: int) -> tuple[str, int, int]:
        """Kind, length and number of links of the block at `address`."""
        if not 64 <= address <= self.size - HEADER.size:
            raise MdfError(address, "a link leads out of the file")
        self._blocks += 1
        if self._blocks > MOST_BLOCKS:
            raise MdfError(address, f"more than {MOST_BLOCKS} blocks")
        mark, _, length, links = HEADER.unpack(self.at(address, HEADER.size))
        if mark[:2] != b"##":
            raise MdfError(address, "no block where a link leads")
        return printable(mark[2:].decode("latin-1")), length, links

    def block(self, address: int, *kinds: str) -> Block:
        """The block at `address`, which has to be of one of the kinds.

        Raises: MdfError when it is not, or is broken.
        """
        kind, length, count = self._head(address)
        if kind not in kinds:
            raise MdfError(address, f"a {kind} block where a {' or '.join(kinds)} is expected")
        if not HEADER.size + 8 * count <= length <= LARGEST_BLOCK:
            raise MdfError(address, f"{kind} block of {length} bytes with {count} links")
        content = self.at(address + HEADER.size, length - HEADER.size)
        if len(content) < length - HEADER.size:
            raise MdfError(address, f"the file ends inside a {kind} block")
        links = struct.unpack_from(f"<{count}Q", content)
        return Block(kind, address, links, content[8 * count :])

    def chain(self, address: int, kind: str) -> Iterator[Block]:
        """Blocks linked one to the next by their first link.

        Raises: MdfError also for a chain that bites its tail.
        """
        seen = set()
        while address:
            if address in seen:
                raise MdfError(address, f"the {kind} blocks are linked in a circle")
            seen.add(address)
            block = self.block(address, kind)
            yield block
            address = block.link(0)

    def text(self, address: int) -> str:
        """The text of a TX or MD block, "" for no link."""
        if not address:
            return ""
        text = self.block(address, "TX", "MD").body.split(b"\x00")[0].decode("utf-8", "replace")
        return printable(text)

    def data(self, address: int, kind: str, open_end: bool) -> Iterator[Piece]:
        """The bytes under a data link, in pieces, unpacked.

        kind: "DT" for records, "SD" for signal data. open_end: the file was not finished, the
        last block may be longer than it says.
        Raises: MdfError.
        """
        if not address:
            return
        found = self._head(address)[0]
        if found == "HL":
            address = self.block(address, "HL").link(0)
            found = self._head(address)[0] if address else ""
        if found == "DL":
            for block in self.chain(address, "DL"):
                for link in block.links[1:]:
                    if link:
                        yield from self._data_block(link, kind, open_end)
        elif address:
            yield from self._data_block(address, kind, open_end)

    def _data_block(self, address: int, kind: str, open_end: bool) -> Iterator[Piece]:
        if address in self._data_used:
            raise MdfError(address, "a data block is linked twice")
        self._data_used.add(address)
        found, length, _ = self._head(address)
        if found == "DZ":
            yield Piece(address, self._unpack(address, length, kind))
            return
        if found != kind:
            raise MdfError(address, f"a {found} block where a {kind} is expected")
        begin, end = address + HEADER.size, address + length
        if end > self.size or (open_end and length <= HEADER.size):
            if not open_end:
                self.cut_at = self.size
            end = self.size
        while begin < end:
            content = self.at(begin, min(PIECE, end - begin))
            if not content:
                break
            yield Piece(begin, content)
            begin += len(content)

    def _unpack(self, address: int, length: int, kind: str) -> bytes:
        """The content of a DZ block."""
        if length > LARGEST_PACKED:
            raise MdfError(address, f"DZ block of {length} bytes")
        body = self.at(address + HEADER.size, length - HEADER.size)
        if len(body) < 24:
            raise MdfError(address, "the file ends inside a DZ block")
        inner, method, _, columns, size, packed_size = struct.unpack_from("<2sBBIQQ", body)
        if inner.decode("latin-1") != kind:
            raise MdfError(address, f"packed {inner!r} where {kind} is expected")
        if method not in (0, 1):
            raise MdfError(
                address, f"packing method {method} is not known here (deflate is); repack the file"
            )
        if size > LARGEST_PACKED or packed_size > len(body) - 24:
            if packed_size > len(body) - 24:
                self.cut_at = address
            raise MdfError(address, f"DZ block of {size} unpacked bytes is cut or too large")
        inflate = zlib.decompressobj()
        try:
            content = inflate.decompress(body[24 : 24 + packed_size], size + 1)
        except zlib.error as error:
            raise MdfError(address, f"damaged DZ block ({error})") from None
        if len(content) != size or not inflate.eof:
            raise MdfError(address, "damaged DZ block (its size is another)")
        if method == 1 and columns > 1:
            content = _transposed(content, columns)
        return content


def _transposed(content: bytes, columns: int) -> bytes:
    """Undo the byte transposition of a packed block: rows of `columns` bytes, then a rest."""
    rows = len(content) // columns
    if not rows:
        return content
    whole = bytearray(rows * columns)
    for column in range(columns):
        whole[column::columns] = content[column * rows : (column + 1) * rows]
    return bytes(whole) + content[rows * columns :]

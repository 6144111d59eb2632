"""Channels of an MDF 4 group: how a field is taken out of a record."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from typing import Final, NamedTuple

from sil.logs.mdf_blocks import Block, MdfError, MdfFile

_CHANNEL: Final = struct.Struct("<BBBBIIII")
_CONVERSION: Final = struct.Struct("<BBHHHdd")
_ARRAY: Final = struct.Struct("<BBHIiI")

FIXED, VLSD, MASTER, VIRTUAL_MASTER, MLSD, VIRTUAL = 0, 1, 2, 3, 5, 6
UNSIGNED_LE, UNSIGNED_BE, SIGNED_LE, SIGNED_BE, FLOAT_LE, FLOAT_BE = range(6)
BYTE_ARRAY: Final = 10
_TEXTS: Final = (6, 7, 8, 9)

Value = int | float | bytes | str
Take = Callable[[bytes, int], Value]
"""Record and its number to the value of a field.  Raises ValueError for what cannot be."""


class Channel(NamedTuple):
    """A channel: where its bits are, and what they mean."""

    name: str
    kind: int
    sync: int
    data_type: int
    bit_offset: int
    byte_offset: int
    bit_count: int
    data_link: int
    conversion: Block | None
    array_bytes: int
    unit_link: int

    @property
    def byte_count(self) -> int:
        """Bytes that the field touches."""
        return self.array_bytes or (self.bit_offset + self.bit_count + 7) // 8


def read_channels(file: MdfFile, address: int, depth: int = 0) -> list[Channel]:
    """All channels of a group, those inside structures after the structure."""
    found: list[Channel] = []
    for block in file.chain(address, "CN"):
        kind, sync, data_type, bit, byte, bits, _flags, _ = block.unpack(_CHANNEL)
        composition = block.link(1)
        inner, array_bytes = "", 0
        if composition and depth < 4:
            inner = file.block(composition, "CN", "CA").kind
            if inner == "CA":
                array_bytes = _array_size(file.block(composition, "CA"), bits)
        conversion = file.block(block.link(4), "CC") if block.link(4) else None
        found.append(
            Channel(
                file.text(block.link(2)),
                kind,
                sync,
                data_type,
                bit,
                byte,
                bits,
                block.link(5),
                conversion,
                array_bytes,
                block.link(6),
            )
        )
        if inner == "CN":
            found += read_channels(file, composition, depth + 1)
    return found


def _array_size(block: Block, bits: int) -> int:
    """Bytes of a plain array of elements of so many bits."""
    _, _, dimensions, *_ = block.unpack(_ARRAY)
    if not 1 <= dimensions <= 4:
        raise MdfError(block.address, f"an array of {dimensions} dimensions")
    sizes = block.unpack(struct.Struct(f"<{dimensions}Q"), _ARRAY.size)
    return math.prod(sizes) * ((bits + 7) // 8)


def field(file: MdfFile, channel: Channel, record_size: int) -> Take:
    """How to take a channel's value, converted, out of a record.

    Raises: MdfError when the field does not lie inside the record.
    """
    raw = _raw(channel, record_size)
    if channel.conversion is None:
        return raw
    return _converted(file, channel.conversion, raw)


def _raw(channel: Channel, record_size: int) -> Take:
    begin, end = channel.byte_offset, channel.byte_offset + channel.byte_count
    if channel.kind in (VIRTUAL, VIRTUAL_MASTER):
        return lambda record, number: number
    if end > record_size or end - begin > 4096:
        raise MdfError(0, f"channel {channel.name[:40]} lies outside of its record")
    kind = channel.data_type
    if kind in (FLOAT_LE, FLOAT_BE):
        sizes = {32: "f", 64: "d"}
        if channel.bit_count not in sizes or channel.bit_offset:
            raise MdfError(0, f"channel {channel.name[:40]}: a float of {channel.bit_count} bits")
        unpack = struct.Struct("<>"[kind - FLOAT_LE] + sizes[channel.bit_count]).unpack_from
        return lambda record, number: unpack(record, begin)[0]
    if channel.array_bytes or kind == BYTE_ARRAY:
        return lambda record, number: record[begin:end]
    if kind in _TEXTS:
        return lambda record, number: record[begin:end].split(b"\x00")[0].decode("latin-1")
    if kind > SIGNED_BE:
        raise MdfError(0, f"channel {channel.name[:40]}: data type {kind}")
    order = "little" if kind in (UNSIGNED_LE, SIGNED_LE) else "big"
    return _integer(begin, end, channel.bit_offset, channel.bit_count, order, kind >= SIGNED_LE)


def _integer(begin: int, end: int, shift: int, bits: int, order: str, signed: bool) -> Take:
    mask = (1 << bits) - 1
    sign = 1 << bits >> 1 if signed else 0

    def take_little(record: bytes, number: int) -> Value:
        value = int.from_bytes(record[begin:end], "little") >> shift & mask
        return value - (mask + 1) if value & sign else value

    def take_big(record: bytes, number: int) -> Value:
        value = int.from_bytes(record[begin:end], "big") >> shift & mask
        return value - (mask + 1) if value & sign else value

    return take_little if order == "little" else take_big


def conversion_kind(channel: Channel) -> int:
    """The kind of a channel's conversion, 0 for none (1 is linear)."""
    return 0 if channel.conversion is None else channel.conversion.unpack(_CONVERSION)[0]


def _number(value: Value) -> float:
    if isinstance(value, (bytes, str)):
        raise ValueError("text where a number is expected")
    return value


def _converted(file: MdfFile, block: Block, raw: Take) -> Take:
    """The raw value under a conversion that bus logs use: linear, or a table."""
    kind, _, _, refs, count, _, _ = block.unpack(_CONVERSION)
    if len(block.body) < _CONVERSION.size + 8 * count:
        raise MdfError(block.address, "a conversion without its values")
    values = struct.unpack_from(f"<{count}d", block.body, _CONVERSION.size)
    if kind == 1 and count >= 2:
        offset, factor = values[0], values[1]
        if factor == 1.0 and offset == 0.0:
            return raw
        return lambda record, number: offset + factor * _number(raw(record, number))
    if kind in (4, 5) and count >= 2:
        table = dict(zip(values[0::2], values[1::2], strict=False))

        def look_up(record: bytes, number: int) -> Value:
            key = _number(raw(record, number))
            if key not in table:
                raise ValueError(f"{key} is not in its conversion table")
            return table[key]

        return look_up
    if kind == 7:
        links = block.links[4 : 4 + refs]
        texts = {key: file.text(link) for key, link in zip(values, links, strict=False) if link}
        return lambda record, number: texts.get(_number(raw(record, number)), raw(record, number))
    return raw


def time_field(channel: Channel, record_size: int) -> Callable[[bytes, int], int]:
    """How to take the time of a record, as nanoseconds from the file's start.

    A factor that is a decimal fraction of a second, as all loggers have, is applied exactly.
    Raises: MdfError; the function raises ValueError for a time that is none.
    """
    offset, factor = 0.0, 1.0
    if channel.conversion is not None:
        kind, _, _, _, count, _, _ = channel.conversion.unpack(_CONVERSION)
        if kind == 1 and count >= 2:
            offset, factor = struct.unpack_from("<2d", channel.conversion.body, _CONVERSION.size)
        elif kind:
            raise MdfError(channel.conversion.address, f"a time under conversion {kind}")
    raw = _raw(channel, record_size)
    ticks_ns = factor * 1e9
    if not (math.isfinite(ticks_ns) and math.isfinite(offset) and ticks_ns > 0):
        raise MdfError(0, "a time that does not run")
    exact = round(ticks_ns)
    offset_ns = round(offset * 1e9)
    if exact and abs(ticks_ns - exact) < 1e-9 * exact:

        def take(record: bytes, number: int) -> int:
            value = _number(raw(record, number))
            if isinstance(value, int):
                return offset_ns + value * exact
            return offset_ns + _rounded(value * exact)

        return take
    return lambda record, number: offset_ns + _rounded(_number(raw(record, number)) * ticks_ns)


def _rounded(value: float) -> int:
    if not abs(value) < 2**63:
        raise ValueError("a time that is no number")
    return round(value)

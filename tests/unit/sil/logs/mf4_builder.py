"""A builder of small MF4 files as loggers leave them: unsorted, unfinished, any block broken."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import NamedTuple


class Field(NamedTuple):
    """A channel of a record: name, first byte, first bit, bits, MDF data and channel type."""

    name: str
    byte: int
    bit: int
    bits: int
    data_type: int = 0
    kind: int = 0
    conversion: tuple[int, tuple[float, ...]] | None = None


class Mf4Builder:
    """Collects blocks and hands out their addresses; links are filled in as they become known."""

    def __init__(self, *, finished: bool) -> None:
        mark = b"MDF     " if finished else b"UnFinMF "
        flags = 0 if finished else 0b100101
        self.blob = bytearray(mark + b"4.11    tests   ".ljust(20, b"\x00"))
        self.blob += struct.pack("<H", 411).ljust(60 - len(self.blob), b"\x00")
        self.blob += struct.pack("<HH", flags, 0)
        assert len(self.blob) == 64

    def block(self, kind: bytes, links: Sequence[int], body: bytes = b"") -> int:
        """Append a block and return its address."""
        self.blob += bytes(-len(self.blob) % 8)
        address = len(self.blob)
        length = 24 + 8 * len(links) + len(body)
        self.blob += struct.pack("<4sIQQ", b"##" + kind, 0, length, len(links))
        self.blob += struct.pack(f"<{len(links)}Q", *links) + body
        return address

    def link(self, address: int, index: int, target: int) -> None:
        """Set a link of a block."""
        struct.pack_into("<Q", self.blob, address + 24 + 8 * index, target)

    def channels(self, fields: Sequence[Field], data_link: int = 0) -> int:
        """A chain of channels; fields named `X.y` go into the structure X before them."""
        first = 0
        last: dict[str, tuple[int, int]] = {}
        for field in fields:
            conversion = 0
            if field.conversion is not None:
                kind, values = field.conversion
                body = struct.pack("<BBHHHdd", kind, 0, 0, 0, len(values), 0, 0)
                body += struct.pack(f"<{len(values)}d", *values)
                conversion = self.block(b"CC", [0, 0, 0, 0], body)
            data = data_link if field.kind == 1 else 0
            links = [
                0,
                0,
                self.block(b"TX", [], field.name.encode() + b"\0"),
                0,
                conversion,
                data,
                0,
                0,
            ]
            sync = 1 if field.kind in (2, 3) else 0
            body = struct.pack(
                "<BBBBIIIIBBHdddddd",
                *(field.kind, sync, field.data_type, field.bit, field.byte, field.bits),
                *(0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0),
            )
            address = self.block(b"CN", links, body)
            parent = field.name.rpartition(".")[0]
            previous, index = last.get(parent, (0, 0))
            if previous:
                self.link(previous, index, address)
            last[parent] = address, 0
            last.setdefault(field.name, (address, 1))
            first = first or address
        return first

    def group(
        self, record_id: int, first_channel: int, size: int, cycles: int = 0, flags: int = 6
    ) -> int:
        """A CG block."""
        body = struct.pack("<QQHHIII", record_id, cycles, flags, 0, 0, size, 0)
        return self.block(b"CG", [0, first_channel, 0, 0, 0, 0], body)

    def data_group(self, first_group: int, data: int, id_size: int) -> int:
        """A DG block."""
        return self.block(b"DG", [0, first_group, data, 0], struct.pack("<B7x", id_size))


DATA_FRAME = (
    Field("Timestamp", 0, 0, 64, 4, 2, (1, (0.0, 1e-9))),
    Field("CAN_DataFrame", 8, 0, 112, 10),
    Field("CAN_DataFrame.BusChannel", 8, 1, 2),
    Field("CAN_DataFrame.ID", 8, 3, 29),
    Field("CAN_DataFrame.IDE", 8, 0, 1),
    Field("CAN_DataFrame.DLC", 13, 4, 4),
    Field("CAN_DataFrame.DataLength", 12, 1, 7),
    Field("CAN_DataFrame.DataBytes", 14, 0, 64, 10, 1),
    Field("CAN_DataFrame.Dir", 12, 0, 1),
    Field("CAN_DataFrame.EDL", 13, 0, 1),
)
ERROR_FRAME = (
    DATA_FRAME[0],
    Field("CAN_ErrorFrame", 8, 0, 8, 10),
    Field("CAN_ErrorFrame.BusChannel", 8, 0, 2),
)


def logger_file(
    frames: Sequence[tuple[int, int, bytes]], start_ns: int, *, error_at: Sequence[int] = ()
) -> bytes:
    """An unsorted, unfinished file: numbered records, data in a group of its own, as CANedge does.

    frames: nanoseconds from the start, identifier, data. error_at: times of error frames.
    """
    build = Mf4Builder(finished=False)
    header = build.block(
        b"HD", [0] * 6, struct.pack("<QhhBBBB", start_ns, 0, 0, 0, 0, 0, 0) + bytes(16)
    )
    assert header == 64
    values = build.group(2, 0, 0, flags=1)
    data = build.group(1, build.channels(DATA_FRAME, values), 22)
    error = build.group(3, build.channels(ERROR_FRAME), 9)
    build.link(data, 0, values)
    build.link(values, 0, error)
    data_group = build.data_group(data, 0, 1)
    build.link(64, 0, data_group)
    records = bytearray()
    offset = 0
    events = [(t, i, d) for t, i, d in frames] + [(t, None, b"") for t in error_at]
    for time_ns, can_id, payload in sorted(events, key=lambda event: event[0]):
        if can_id is None:
            records += b"\x03" + struct.pack("<dB", float(time_ns), 1)
            continue
        word, size = can_id << 3 | 0b011, len(payload)  # channel 1, extended; received
        records += b"\x01" + struct.pack("<dIBBQ", time_ns, word, size << 1, size << 4, offset)
        records += b"\x02" + struct.pack("<I", len(payload)) + payload
        offset += 4 + len(payload)
    build.link(data_group, 2, build.block(b"DT", []))
    build.blob += records
    return bytes(build.blob)


def signal_file() -> bytes:
    """A finished file with one group of a decoded signal and no frames."""
    build = Mf4Builder(finished=True)
    build.block(b"HD", [0] * 6, bytes(32))
    fields = (Field("time", 0, 0, 64, 4, 2), Field("engine_speed", 8, 0, 64, 4))
    group = build.group(0, build.channels(fields), 16, cycles=2, flags=0)
    data = build.block(b"DT", [], struct.pack("<4d", 0.0, 1.0, 0.1, 2.0))
    build.link(64, 0, build.data_group(group, data, 0))
    return bytes(build.blob)

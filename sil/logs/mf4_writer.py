"""Writing MF4 logs of CAN frames in the ASAM bus logging layout (ASAM MDF 4.1, bus logging 1.0).

The description of a group comes before its data, and each small block of data is linked from the one
before it: what a cut or a damaged byte leaves is still readable.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

from sil.logs.frame import LogFrame
from sil.logs.writer import LogWriter

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

_TOOL: Final = b"opc4-sil"
_BLOCK_BYTES: Final = 1 << 16
"""Of records in a block, unpacked: what a damaged byte costs."""

_EXACT_SPAN_NS: Final = 4_000_000 * 10**9
"""Times are stored as seconds in a double; up to here (46 days) these are exact to the ns."""

_LINK: Final = struct.Struct("<Q")
_FIRST_GROUP_AT: Final = 64 + 24
_CYCLES_AT: Final = 24 + 6 * 8 + 8
_TIME_BYTES: Final = 8
_BUS_EVENT, _PLAIN_BUS_EVENT, _CHANNEL_BUS_EVENT = 2, 4, 1 << 10
_SOURCE_BUS, _BUS_CAN = 2, 2
_MASTER, _TIME, _UNSIGNED, _FLOAT, _BYTES = 2, 1, 0, 4, 10

_LAYOUT: Final = {
    "data": ("CAN_DataFrame", 8),
    "fd": ("CAN_DataFrame", 64),
    "error": ("CAN_ErrorFrame", 64),
    "remote": ("CAN_RemoteFrame", 0),
}
"""Name of each group and the bytes of data in its records."""

_FLAGS: Final = ("IDE", "DLC", "Dir", "EDL", "BRS", "ESI")


@dataclass
class _Group:
    """A channel group: its records not yet written, and the addresses of what is set later."""

    address: int
    cycles_at: int
    link_at: int
    list_at: int
    record: np.dtype[Any]
    held: list[bytes] = field(default_factory=list)
    held_bytes: int = 0
    count: int = 0
    begun: bool = False


def block(kind: bytes, links: tuple[int, ...], body: bytes) -> bytes:
    """Return a block of an MDF file, filled up to a multiple of eight bytes."""
    content = struct.pack(f"<{len(links)}Q", *links) + body
    head = struct.pack("<4sIQQ", b"##" + kind, 0, 24 + len(content), len(links))
    return head + content + bytes(-len(content) % 8)


def packed_block(content: bytes) -> bytes:
    """Return a DZ block of records."""
    packed = zlib.compress(content)
    return block(
        b"DZ", (), struct.pack("<2sBBIQQ", b"DT", 0, 0, 0, len(content), len(packed)) + packed
    )


def _columns(name: str, data_bytes: int) -> np.dtype[Any]:
    """Return the layout of a record: time in s, then the parts of a frame."""
    import numpy as np

    fields: list[Any] = [("time", "<f8"), (f"{name}.BusChannel", "<u1"), (f"{name}.ID", "<u4")]
    fields += [(f"{name}.{part}", "<u1") for part in _FLAGS]
    if data_bytes:
        fields += [(f"{name}.DataLength", "<u1"), (f"{name}.DataBytes", "<u1", (data_bytes,))]
    return np.dtype([*fields, (f"{name}.Order", "<u4")])


class Mf4Writer(LogWriter):
    """Writes groups of data, CAN FD, error and remote frames; `Order` keeps their common order."""

    format = "mf4"
    batch = 1 << 14
    patched = True

    def __init__(self, path: str) -> None:
        super().__init__(path)
        self._groups: dict[str, _Group] = {}
        self._next_group_at = _FIRST_GROUP_AT

    def _begin(self, frames: list[LogFrame]) -> None:
        mark = struct.pack("<8s8s8s4xH30xHH", b"MDF     ", b"4.10    ", _TOOL, 410, 0, 0)
        self._out.write(mark)
        history_at = 64 + 104
        start = struct.pack("<Qhh", self.start_ns, 0, 0)
        self._put(b"HD", (0, history_at, 0, 0, 0, 0), start + bytes(20))
        note = (
            b"<FHcomment><TX>written</TX><tool_id>%s</tool_id><tool_vendor>%s</tool_vendor>"
            b"<tool_version>1</tool_version></FHcomment>" % (_TOOL, _TOOL)
        )
        self._put(b"FH", (0, history_at + 56), start + bytes(4))
        self._put(b"MD", (), note + b"\x00")

    def _put(self, kind: bytes, links: tuple[int, ...], body: bytes) -> int:
        """Write a block at the end; return its address."""
        address = self._out.tell()
        self._out.write(block(kind, links, body))
        return address

    def _set(self, address: int, value: int) -> None:
        """Set a link or a count in what is written already."""
        end = self._out.tell()
        self._out.seek(address)
        self._out.write(_LINK.pack(value))
        self._out.seek(end)

    def _text(self, text: str) -> int:
        return self._put(b"TX", (), text.encode("ascii") + b"\x00")

    def _channel(
        self,
        name: str,
        following: int,
        part: int,
        unit: int,
        kinds: tuple[int, int, int],
        span: tuple[int, int],
    ) -> int:
        """Write a channel; kinds: of channel, synchronisation and data; span: byte and bytes."""
        links = (following, part, self._text(name), 0, 0, 0, unit, 0)
        flags = 0 if kinds[0] == _MASTER else _CHANNEL_BUS_EVENT
        body = struct.pack("<BBBBIIIIBBH", *kinds, 0, span[0], 8 * span[1], flags, 0, 0, 0, 0)
        return self._put(b"CN", links, body + bytes(48))

    def _group(self, kind: str) -> _Group:
        """Return the group of a kind of frames, described in the file when its first one comes."""
        if kind in self._groups:
            return self._groups[kind]
        name, data_bytes = _LAYOUT[kind]
        record = _columns(name, data_bytes)
        title = self._text(name)
        source_name = self._text("CAN")
        bus = struct.pack("<BBB5x", _SOURCE_BUS, _BUS_CAN, 0)
        source = self._put(b"SI", (source_name, source_name, 0), bus)
        following = 0
        for part in reversed(record.names[1:] if record.names else ()):
            span = record.fields[part][1], record.fields[part][0].itemsize  # type: ignore[index]
            data = _BYTES if part.endswith("DataBytes") else _UNSIGNED
            following = self._channel(part, following, 0, 0, (0, 0, data), span)
        rest = record.itemsize - _TIME_BYTES
        whole = self._channel(name, 0, following, 0, (0, 0, _BYTES), (_TIME_BYTES, rest))
        seconds = self._text("s")
        time = self._channel("time", whole, 0, seconds, (_MASTER, _TIME, _FLOAT), (0, _TIME_BYTES))
        flags = _BUS_EVENT | _PLAIN_BUS_EVENT
        body = struct.pack("<QQHHIII", 0, 0, flags, 0, 0, record.itemsize, 0)
        group = self._put(b"CG", (0, time, title, source, 0, 0), body)
        lists = self._put(b"HL", (0,), struct.pack("<HB5x", 1, 0))
        address = self._put(b"DG", (0, group, 0, 0), bytes(8))
        self._set(self._next_group_at, address)
        self._next_group_at = address + 24
        made = _Group(address, group + _CYCLES_AT, lists + 24, lists, record)
        self._groups[kind] = made
        return made

    def _write_batch(self, frames: list[LogFrame]) -> None:
        import numpy as np

        kinds: dict[str, list[int]] = {}
        for index, frame in enumerate(frames):
            kind = "error" if frame.error else "remote" if frame.remote else "data"
            kinds.setdefault("fd" if kind == "data" and frame.fd else kind, []).append(index)
        groups = [self._group(kind) for kind in kinds]  # described before any of their data
        for group, (kind, share) in zip(groups, kinds.items(), strict=True):
            chosen = frames if len(share) == len(frames) else [frames[index] for index in share]
            self._hold(group, self._records(kind, group, chosen, np.array(share) + self._written))
            self._count_losses(chosen)

    def _records(
        self, kind: str, group: _Group, frames: list[LogFrame], order: NDArray[np.int64]
    ) -> NDArray[Any]:
        """Return the records [n] of frames of one kind; order: [n], their numbers in the log."""
        import numpy as np

        name, data_bytes = _LAYOUT[kind]
        times_ns, ids, data, extended, _, _, fd, brs, esi, channels, ways, _ = zip(
            *frames, strict=True
        )
        offsets_ns = np.array([time_ns - self.start_ns for time_ns in times_ns], dtype=np.int64)
        rows = np.zeros(len(frames), dtype=group.record)
        # Integer seconds and the rest apart: one rounding, to the double nearest to the decimal.
        rows["time"] = offsets_ns // 10**9 + (offsets_ns % 10**9) / 1e9
        parts: dict[str, Any] = {
            "BusChannel": [self.channel_number(channel, 0) for channel in channels],
            "DLC": [frame.dlc for frame in frames],
            "Dir": [way == "Tx" for way in ways],
            "ID": ids,
            "IDE": extended,
            "EDL": fd,
            "BRS": brs,
            "ESI": esi,
            "Order": order,
        }
        if data_bytes:
            padded = b"".join([content.ljust(data_bytes, b"\x00") for content in data])
            parts["DataBytes"] = np.frombuffer(padded, np.uint8).reshape(-1, data_bytes)
            parts["DataLength"] = list(map(len, data))
        for part, values in parts.items():
            rows[f"{name}.{part}"] = values
        return rows

    def _hold(self, group: _Group, rows: NDArray[Any]) -> None:
        """Add records to a group, and write its blocks that are full."""
        group.count += len(rows)
        step = _BLOCK_BYTES // group.record.itemsize
        for begin in range(0, len(rows), step):
            part = rows[begin : begin + step].tobytes()
            if group.held_bytes + len(part) > step * group.record.itemsize:
                self._write_held(group)
            group.held.append(part)
            group.held_bytes += len(part)

    def _write_held(self, group: _Group) -> None:
        """Write the records of a group that are held, linked from the block before."""
        content = b"".join(group.held)
        group.held, group.held_bytes = [], 0
        if not content:
            return
        address = self._out.tell()
        size_of_list = 24 + 2 * 8 + 16
        body = struct.pack("<B3xIQ", 1, 1, len(content))
        self._put(b"DL", (0, address + size_of_list), body)
        self._out.write(packed_block(content))
        self._set(group.link_at, address)
        if not group.begun:
            self._set(group.address + 24 + 2 * 8, group.list_at)
            group.begun = True
        group.link_at = address + 24

    def _count_losses(self, frames: list[LogFrame]) -> None:
        for frame in frames:
            if not frame.direction:
                self.losses["direction not recorded, written as Rx"] += 1
            if abs(frame.time_ns - self.start_ns) > _EXACT_SPAN_NS:
                self.losses["times more than 46 days from the start, rounded"] += 1
            if frame.error and frame.remote:
                self.losses["remote flag of an error frame"] += 1

    def _finish(self) -> None:
        if not self._groups:
            self._group("data")
        for group in self._groups.values():
            self._write_held(group)
            self._set(group.cycles_at, group.count)

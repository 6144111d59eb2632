"""MF4 logs (ASAM MDF 4 bus logging): frames read by our own reader, written through asammdf.

python-can's reader needs asammdf and the whole sorted file, yields nothing, silently, for a file
of decoded signals, and carries times as floats. Ours reads finished and unfinished, sorted and
unsorted, packed and plain files in bounded memory without any library, and names what it refuses.
"""

from __future__ import annotations

import heapq
import struct
import tempfile
from collections.abc import Iterator
from typing import Final, NamedTuple

from can_dbc.errors import InputError
from sil.logs.backend import Batch, LogWriter, ReadOptions
from sil.logs.byte_source import ByteSource
from sil.logs.frame import LogFrame
from sil.logs.mdf_blocks import Block, MdfError, MdfFile
from sil.logs.mdf_channels import Channel, read_channels
from sil.logs.mdf_frames import FrameGroup, frame_group, frame_kind
from sil.logs.mdf_records import Group, LocatedFrame, Records, sorted_records, unsorted_records
from sil.logs.mdf_signals import GROUP
from sil.logs.report import LogReport, Place
from sil.logs.times import RELATIVE_BELOW_NS

_START: Final = struct.Struct("<QhhBB")
_VLSD_GROUP: Final = 1
_LOCAL_TIME: Final = 1
_BATCH: Final = 2048


class _DataGroup(NamedTuple):
    """A data group with CAN frames in it."""

    data_link: int
    id_size: int
    groups: list[Group]


def _time(located: LocatedFrame) -> int:
    return located.frame.time_ns


class Mf4Reader:
    """State of one reading."""

    def __init__(self, report: LogReport) -> None:
        self._report = report
        self._signals: list[str] = []
        self._signal_groups = 0
        self._frame_groups = 0

    def read(self, source: ByteSource) -> Iterator[Batch]:
        """Frames in batches, those of all groups merged by time."""
        if not source.packed:
            yield from self._read(MdfFile(source.file))
            return
        with tempfile.TemporaryFile() as unpacked:
            while block := source.read(1 << 20):
                unpacked.write(block)
            yield from self._read(MdfFile(unpacked))

    def _read(self, file: MdfFile) -> Iterator[Batch]:
        report = self._report
        mark, version = file.at(0, 8), file.at(8, 8)
        open_end = mark == b"UnFinMF "
        if mark not in (b"MDF     ", b"UnFinMF ") or not version.startswith(b"4."):
            text = version.decode("latin-1").strip("\x00 ")
            raise InputError(f"{report.path}: MDF version {text!r}; expected MDF 4")
        if open_end:
            report.note("the logger did not finish this file; read as far as it goes")
        streams: list[Iterator[LocatedFrame]] = []
        try:
            header = file.block(64, "HD")
            start_ns, _, _, time_flags, _ = header.unpack(_START)
            if time_flags & _LOCAL_TIME:
                report.note("the start is a local time of an unknown zone, taken as UTC")
            if start_ns >= 2**63:
                raise MdfError(64, "a start time out of range")
            report.start_ns = start_ns or None
            absolute = start_ns >= RELATIVE_BELOW_NS
            report.time_base = "absolute" if absolute else "relative"
            for data_group in self._data_groups(file, header.link(0), start_ns):
                streams += self._streams(file, data_group, open_end)
        except MdfError as error:
            report.skip(Place(error.reason, byte=error.byte))
        self._refuse_signals()
        yield from self._batches(heapq.merge(*streams, key=_time))
        if file.cut_at is not None:
            report.cut(Place("the data ends before its block does", byte=file.cut_at))

    def _batches(self, located: Iterator[LocatedFrame]) -> Iterator[Batch]:
        frames: list[LogFrame] = []
        places: list[int] = []
        for frame, place in located:
            frames.append(frame)
            places.append(place)
            if len(frames) >= _BATCH:
                yield Batch(frames, places)
                frames, places = [], []
        if frames:
            yield Batch(frames, places)

    def _data_groups(self, file: MdfFile, address: int, start_ns: int) -> Iterator[_DataGroup]:
        for block in file.chain(address, "DG"):
            id_size = block.unpack(struct.Struct("<B"))[0]
            if id_size not in (0, 1, 2, 4, 8):
                raise MdfError(block.address, f"record numbers of {id_size} bytes")
            groups = [
                self._group(file, group, start_ns) for group in file.chain(block.link(1), "CG")
            ]
            if any(group.frames is not None for group in groups):
                yield _DataGroup(block.link(2), id_size, groups)

    def _group(self, file: MdfFile, block: Block, start_ns: int) -> Group:
        """What a channel group holds."""
        record_id, cycles, flags, _, _, data_bytes, invalid_bytes = block.unpack(GROUP)
        size = data_bytes + invalid_bytes
        if flags & _VLSD_GROUP:
            return Group(block.address, record_id, cycles, 0, None, "", True)
        frames: FrameGroup | None = None
        name = "record of a group that cannot be read"
        try:
            channels = read_channels(file, block.link(1)) if block.link(1) else []
            kind = frame_kind(channels)
            if kind is None:
                name = self._other_name(channels, cycles)
            else:
                self._frame_groups += 1
                frames = frame_group(file, channels, data_bytes, start_ns)
                name = kind
        except MdfError as error:
            self._report.skip(Place(error.reason, byte=error.byte or block.address))
        return Group(block.address, record_id, cycles, size, frames, name, False)

    def _other_name(self, channels: list[Channel], cycles: int) -> str:
        """What the records of a group without CAN frames are."""
        for channel in channels:
            bus = channel.name.split("_")[0].split(".")[0].upper()
            if bus in ("LIN", "FLEXRAY", "ETH", "MOST", "K-LINE", "CAN"):
                return channel.name.split(".")[0].replace("_", " ")
        signals = [channel.name for channel in channels if channel.kind != 2]
        if signals and cycles:
            self._signal_groups += 1
            self._signals += signals[: 4 - len(self._signals)] if len(self._signals) < 4 else []
            self._report.other["record of decoded signals"] += cycles
        return "record of decoded signals"

    def _refuse_signals(self) -> None:
        report = self._report
        if self._frame_groups:
            return
        if self._signal_groups:
            names = ", ".join(self._signals)
            raise InputError(
                f"{report.path}: holds decoded signals only ({names}, ...; groups: "
                f"{self._signal_groups}), no CAN frames; expected a log of CAN_DataFrame groups"
            )
        report.note("no CAN frame groups in it")

    def _streams(
        self, file: MdfFile, data_group: _DataGroup, open_end: bool
    ) -> list[Iterator[LocatedFrame]]:
        records = Records(file, self._report, open_end)
        groups = data_group.groups
        if len(groups) == 1:
            return [sorted_records(records, groups[0], data_group.data_link, data_group.id_size)]
        if not data_group.id_size:
            raise MdfError(groups[0].address, "several groups without record numbers")
        return [unsorted_records(records, groups, data_group.data_link, data_group.id_size)]


class Mf4:
    """The MF4 format."""

    name = "mf4"
    suffixes: tuple[str, ...] = (".mf4", ".mdf")
    place_word = "byte"

    def sniff(self, head: bytes) -> bool:
        """Whether the file has the MDF signature, finished or not."""
        return head.startswith((b"MDF     ", b"UnFinMF "))

    def batches(
        self, source: ByteSource, report: LogReport, options: ReadOptions
    ) -> Iterator[Batch]:
        """The frames of an MF4 log."""
        return Mf4Reader(report).read(source)

    def writer(self, path: str) -> LogWriter:
        """A writer of a new MF4 log.

        Raises: InputError when asammdf is not installed.
        """
        from sil.logs.mf4_writer import Mf4Writer

        return Mf4Writer(path)

"""Decoded signals of an MF4 file, row by row, for files that are one table."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import Final, NamedTuple

from can_dbc.errors import InputError
from sil.logs.byte_source import ByteSource
from sil.logs.mdf_blocks import Block, MdfError, MdfFile
from sil.logs.mdf_channels import (
    FLOAT_BE,
    MASTER,
    UNSIGNED_LE,
    Channel,
    Take,
    conversion_kind,
    field,
    read_channels,
)
from sil.logs.mdf_frames import frame_kind
from sil.logs.mdf_records import LARGEST_RECORD, Records
from sil.logs.report import LogReport

GROUP: Final = struct.Struct("<QQHHIII")
"""Of a channel group: record number, cycles, flags, separator, -, data and invalidation bytes."""

_LINEAR_KINDS: Final = (0, 1)


class SignalGroup(NamedTuple):
    """A group of decoded signals that has samples."""

    data_group: Block
    group: Block
    channels: list[Channel]


def signal_groups(file: MdfFile) -> list[SignalGroup]:
    """The groups of decoded signals with samples; none when there are CAN frames in the file.

    Raises: MdfError for a broken file.
    """
    found: list[SignalGroup] = []
    for data_group in file.chain(file.block(64, "HD").link(0), "DG"):
        for group in file.chain(data_group.link(1), "CG"):
            channels = read_channels(file, group.link(1)) if group.link(1) else []
            if frame_kind(channels) is not None:
                return []
            if channels and group.unpack(GROUP)[1]:
                found.append(SignalGroup(data_group, group, channels))
    return found


def holds_signals_only(path: str) -> bool:
    """Whether a file is an MF4 with decoded signals and without CAN frames.

    A broken file is none: whoever reads it names what is wrong.
    """
    source = ByteSource(path, LogReport(path, "mf4"))
    try:
        if source.packed or not source.head.startswith((b"MDF     4.", b"UnFinMF 4.")):
            return False
        return bool(signal_groups(MdfFile(source.file)))
    except MdfError:
        return False
    finally:
        source.close()


class SignalTable:
    """The one table of signals in an MF4 file; `rows` gives time in s and values.

    Raises: InputError for several tables, and for signals that are no plain numbers.
    Checked by: tests/unit/sil/logs/test_traces.py.
    """

    def __init__(self, path: str) -> None:
        self._path = path
        self._source = ByteSource(path, LogReport(path, "mf4", strict=True))
        try:
            self._open(MdfFile(self._source.file))
        except MdfError as error:
            self.close()
            raise self._broken(error) from None
        except BaseException:
            self.close()
            raise

    def _broken(self, error: MdfError) -> InputError:
        return InputError(f"{self._path}: byte {error.byte}: {error.reason}; expected a whole MF4")

    def _open(self, file: MdfFile) -> None:
        groups = signal_groups(file)
        if len(groups) != 1:
            raise InputError(
                f"{self._path}: signals in {len(groups)} groups with times of their own; expected "
                "one group, which is one table"
            )
        data_group, group, channels = groups[0]
        _, self._cycles, _, _, _, size, invalid = group.unpack(GROUP)
        id_size = data_group.unpack(struct.Struct("<B"))[0]
        self._size = size + invalid + id_size
        if not 0 < self._size <= LARGEST_RECORD or id_size > 8:
            raise MdfError(group.address, f"records of {self._size} bytes")
        if invalid:
            raise MdfError(group.address, "samples that can be marked invalid are not read here")
        masters = [channel for channel in channels if channel.kind == MASTER]
        if len(masters) != 1:
            raise MdfError(group.address, f"{len(masters)} times in one group")
        signals = [channel for channel in channels if channel.kind != MASTER]
        self.names = tuple(channel.name for channel in signals)
        for name in self.names:
            if "," in name or '"' in name:
                raise InputError(
                    f"{self._path}: signal {name[:60]}: a comma or quote in its name; expected a "
                    "name that a CSV can hold"
                )
        self.units = tuple(file.text(channel.unit_link) for channel in signals)
        self._takes = [self._numeric(file, channel, size) for channel in (masters[0], *signals)]
        self._id_size = id_size
        self._records = Records(file, LogReport(self._path, "mf4", strict=True), False)
        self._link = data_group.link(2)

    def _numeric(self, file: MdfFile, channel: Channel, size: int) -> Take:
        """How to take a plain number."""
        plain = channel.kind in (0, MASTER) and UNSIGNED_LE <= channel.data_type <= FLOAT_BE
        if not plain or channel.array_bytes or conversion_kind(channel) not in _LINEAR_KINDS:
            raise InputError(
                f"{self._path}: signal {channel.name[:60]}: no plain numbers; expected a table of "
                "them"
            )
        return field(file, channel, size)

    def rows(self) -> Iterator[tuple[float, ...]]:
        """Time and values of each sample.

        Raises: InputError when samples are missing or the file is broken there.
        """
        try:
            self._records.open(self._link)
            for number in range(self._cycles):
                record = self._records.take(self._size)
                if record is None:
                    raise MdfError(self._records.byte, f"sample {number + 1} is missing")
                record = record[self._id_size :]
                yield tuple(take(record, number) for take in self._takes)  # type: ignore[misc]
        except MdfError as error:
            raise self._broken(error) from None

    def close(self) -> None:
        """Close the file."""
        self._source.close()

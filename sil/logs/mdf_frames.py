"""CAN frames of one MDF 4 channel group, as the ASAM bus logging standard lays them out."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final, NamedTuple

from sil.logs.frame import DLC_LENGTHS, LogFrame, frame_problem
from sil.logs.mdf_blocks import MdfError, MdfFile
from sil.logs.mdf_channels import (
    MASTER,
    VIRTUAL_MASTER,
    VLSD,
    Channel,
    Take,
    Value,
    field,
    time_field,
)

FRAME_NAMES: Final = ("CAN_DataFrame", "CAN_ErrorFrame", "CAN_RemoteFrame")
_TEXT_FLAGS: Final = {"rx": 0, "tx": 1, "false": 0, "true": 1, "no": 0, "yes": 1}
_TIME_SYNC: Final = 1


class FrameGroup(NamedTuple):
    """How the records of a group become frames.

    decode: record, its number, and the variable-length data it refers to (None when there is
    none) to a frame.  Raises ValueError for a record that is none.
    data_at: where the record says its variable-length data is, None for groups without.
    data_link: the link to that data.
    """

    name: str
    decode: Callable[[bytes, int, bytes | None], LogFrame]
    data_at: Callable[[bytes, int], int] | None
    data_link: int


def frame_kind(channels: list[Channel]) -> str | None:
    """Which kind of frames a group holds, None for none."""
    names = {channel.name.split(".")[0] for channel in channels}
    return next((name for name in FRAME_NAMES if name in names), None)


def frame_group(
    file: MdfFile, channels: list[Channel], record_size: int, start_ns: int
) -> FrameGroup:
    """Prepare the decoding of a group.

    Raises: MdfError when a field that is needed is missing or lies outside of the record.
    """
    name = frame_kind(channels)
    if name is None:
        raise MdfError(0, "no CAN frames in the group")
    parts = {
        channel.name.rpartition(".")[2]: channel
        for channel in channels
        if channel.name.startswith(name + ".")
    }
    masters = [
        c for c in channels if c.kind in (MASTER, VIRTUAL_MASTER) and c.sync in (0, _TIME_SYNC)
    ]
    if not masters:
        raise MdfError(0, f"{name} without a time")
    take_time = time_field(masters[0], record_size)
    takes: dict[str, Take] = {}
    data_at: Callable[[bytes, int], int] | None = None
    data_link = 0
    for part, channel in parts.items():
        if part == "DataBytes" and channel.kind == VLSD:
            data_at = _whole(field(file, channel._replace(data_type=0), record_size))
            data_link = channel.data_link
        else:
            takes[part] = field(file, channel, record_size)
    if "ID" not in takes and name != "CAN_ErrorFrame":
        raise MdfError(0, f"{name} without an ID")
    decode = _decoder(name, takes, take_time, start_ns, data_at is not None)
    return FrameGroup(name, decode, data_at, data_link)


def _whole(take: Take) -> Callable[[bytes, int], int]:
    return lambda record, number: _integer(take(record, number))


def _integer(value: Value) -> int:
    if isinstance(value, str):
        number = _TEXT_FLAGS.get(value.strip().lower())
        if number is None:
            raise ValueError(f"{value[:20]!r} is no flag")
        return number
    if isinstance(value, bytes):
        return int.from_bytes(value, "little")
    if value != value or abs(value) > 2**63:
        raise ValueError("a field that is no number")
    return int(value)


def _decoder(
    name: str,
    takes: dict[str, Take],
    take_time: Callable[[bytes, int], int],
    start_ns: int,
    variable: bool,
) -> Callable[[bytes, int, bytes | None], LogFrame]:
    """Compose the decoding of one record."""
    error, remote = name == "CAN_ErrorFrame", name == "CAN_RemoteFrame"
    take_bytes = takes.pop("DataBytes", None)

    def number_of(part: str, record: bytes, number: int, default: int = 0) -> int:
        take = takes.get(part)
        return default if take is None else _integer(take(record, number))

    has_length, has_channel, has_way = (
        part in takes for part in ("DataLength", "BusChannel", "Dir")
    )

    def decode(record: bytes, number: int, stored: bytes | None) -> LogFrame:
        word = number_of("ID", record, number)
        can_id = word & 0x1FFFFFFF
        extended = bool(number_of("IDE", record, number, word >> 31 or can_id > 0x7FF))
        fd = bool(number_of("EDL", record, number))
        dlc = number_of("DLC", record, number) & 0xF
        told = DLC_LENGTHS[dlc] if fd else min(dlc, 8)
        length = number_of("DataLength", record, number, told) if has_length else told
        data = b""
        if remote:
            length = 0
        elif variable:
            data = stored or b""
        elif take_bytes is not None:
            value = take_bytes(record, number)
            data = value if isinstance(value, bytes) else b""
        if len(data) < length:
            if not error:
                raise ValueError(f"{len(data)} bytes of data where {length} are told")
            length = len(data)
        way = ""
        if has_way:
            way = "Tx" if number_of("Dir", record, number) else "Rx"
        frame = LogFrame(
            start_ns + take_time(record, number),
            can_id,
            data[:length],
            extended,
            remote,
            error,
            fd,
            bool(number_of("BRS", record, number)),
            bool(number_of("ESI", record, number)),
            str(number_of("BusChannel", record, number)) if has_channel else "",
            way,
            dlc if remote or (not fd and dlc > 8 and length == 8) else 0,
        )
        problem = frame_problem(frame)
        if problem is not None:
            raise ValueError(problem)
        return frame

    return decode

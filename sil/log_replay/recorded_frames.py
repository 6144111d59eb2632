"""The frames of a log by what they are to the control unit: its inputs, its answers, the others'."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple

from can_dbc.codec import can_id_of, spec_of
from can_dbc.e2e import PROTECTED, with_counter
from can_dbc.errors import InputError
from can_dbc.frame import Frame
from can_dbc.messages import SIGNALS, TRUCK
from sil.logs import LogFrame

_UNIT, _PLANT = {"Opc4"}, {"ValveDriver", "PositionSensor", "Driveline"}
KINDS: Final = tuple(kind for kind in SIGNALS if kind not in TRUCK)
INPUTS: Final = tuple(kind for kind in KINDS if _UNIT & spec_of(kind).receivers)
OUTPUTS: Final = tuple(kind for kind in KINDS if _UNIT.intersection(spec_of(kind).senders))
FROM_PLANT: Final = tuple(kind for kind in KINDS if _PLANT.intersection(spec_of(kind).senders))
"""Messages of the contract by the nodes that receive and send them."""

OWN_IDS: Final[dict[int, type]] = {can_id_of(kind): kind for kind in KINDS}
ID_OF: Final[dict[type, int]] = {kind: can_id for can_id, kind in OWN_IDS.items()}


class Arrival(NamedTuple):
    """A data frame of the log; `kind` is its message type, None for a foreign one."""

    time_ns: int
    kind: type | None
    frame: Frame


@dataclass
class RecordedFrames:
    """Sorts the frames of a log and counts every one of them.

    `channel`: None for all, else only frames of that channel count as ours. `ids`: identifier to
    message type, where the log has others than the contract. `skew`: from a time on the
    recorder's clock runs faster by that share, and times are given in the control unit's own.
    Raises InputError when the clock steps back by more than 50 ms.
    """

    log: Iterable[LogFrame]
    channel: str | None = None
    ids: Mapping[int, type] = field(default_factory=lambda: OWN_IDS)
    path: str = "log"
    skew: tuple[int, float] = (0, 0.0)
    total: int = 0
    counts: Counter[str] = field(default_factory=Counter)
    """Frames that are not passed on, by the reason."""
    kinds: Counter[type] = field(default_factory=Counter)
    reordered: int = 0
    last_ns: int | None = None

    def __iter__(self) -> Iterator[Arrival]:
        ids, channel = self.ids, self.channel
        last_ns: int | None = None
        instant: list[LogFrame] = []
        begin_ns, share = self.skew
        for entry in self.log:
            self.total += 1
            time_ns = entry.time_ns
            if share:
                time_ns = begin_ns + round((time_ns - begin_ns) / (1.0 + share))
            if last_ns is not None and time_ns < last_ns:
                time_ns = self._clamped(time_ns, last_ns)
            if time_ns != last_ns:
                instant.clear()
            elif entry in instant:  # no bus carries a frame twice at once: two recordings in one
                self.counts["frames that are there twice"] += 1
                continue
            if len(instant) < 16:
                instant.append(entry)
            last_ns = self.last_ns = time_ns
            if entry.error or entry.remote or entry.fd or not entry.extended:
                self.counts[_reason(entry)] += 1
                continue
            kind = ids.get(entry.can_id)
            if channel is not None and entry.channel != channel:
                self.counts["on another channel"] += 1
                continue
            if kind is not None:
                self.kinds[kind] += 1
            can_id = entry.can_id if kind is None else ID_OF[kind]
            yield Arrival(time_ns, kind, Frame(can_id, entry.data))

    def _clamped(self, time_ns: int, last_ns: int) -> int:
        if last_ns - time_ns > 50_000_000:
            raise InputError(
                f"{self.path}: frame {self.total}: the clock steps back by "
                f"{(last_ns - time_ns) / 1e9:.3f} s; expected one recording, cut the log there"
            )
        self.reordered += 1
        return last_ns


def _reason(entry: LogFrame) -> str:
    if entry.error:
        return "error frames"
    if entry.remote:
        return "remote frames"
    return "CAN FD frames" if entry.fd else "frames with an 11-bit identifier"


def counter_of(frame: Frame) -> int:
    """Return the end-to-end counter of a protected frame."""
    return frame.data[1] & 0x0F


def is_intact(kind: type, frame: Frame) -> bool:
    """Whether length and, where the message has one, checksum of a frame are right."""
    if len(frame.data) != spec_of(kind).length:
        return False
    if kind not in PROTECTED:
        return True
    return with_counter(kind, frame, counter_of(frame)) == frame


def bare(kind: type, data: bytes) -> bytes:
    """Return the data without counter and checksum, which differ where nothing else does."""
    if kind not in PROTECTED or len(data) < 2:
        return data
    return bytes((0, data[1] & 0xF0)) + data[2:]


def ids_of_database(path: str) -> dict[int, type]:
    """Return identifier to message type of another DBC file.

    Messages are found by their names; layout and scaling have to be those of the contract.
    Raises InputError for a message that is laid out differently, or when none is there.
    """
    from can_dbc.dbc import load_dbc

    database = load_dbc(path)
    by_name = {kind.__name__: kind for kind in KINDS}
    ids: dict[int, type] = {}
    for message in database.messages:
        if (kind := by_name.get(message.name)) is not None:
            _require_layout(path, kind, message)
            ids[message.frame_id] = kind
    if not ids:
        raise InputError(
            f"{path}: no message of the control unit in it; expected {', '.join(sorted(by_name))}"
        )
    taken = {message.frame_id for message in database.messages}
    for can_id, kind in OWN_IDS.items():
        if kind not in ids.values() and can_id not in taken:
            ids[can_id] = kind
    return ids


def _require_layout(path: str, kind: type, message: Any) -> None:
    spec = spec_of(kind)
    theirs = {signal.name: signal for signal in message.signals}
    if not message.is_extended_frame:
        raise InputError(f"{path}: {message.name}: an 11-bit identifier; expected 29 bits")
    if message.length != spec.length:
        raise InputError(
            f"{path}: {message.name}: {message.length} bytes; expected {spec.length} as in opc4.dbc"
        )
    for ours in spec.signals:
        where, there = f"{path}: {message.name}.{ours.name}", theirs.get(ours.name)
        if there is None:
            raise InputError(f"{where}: missing; expected as in opc4.dbc")
        stated = (there.start, there.length, there.is_signed, there.byte_order)
        wanted = (ours.start, ours.length, ours.signed, "little_endian")
        scaled = (float(there.scale), float(there.offset))
        if stated != wanted or scaled != (float(ours.factor), float(ours.offset)):
            raise InputError(
                f"{where}: bits {there.start}|{there.length}, factor "
                f"{there.scale}; expected {ours.start}|{ours.length}, {ours.factor} as in opc4.dbc"
            )

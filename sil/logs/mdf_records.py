"""Records of MDF 4 data groups, sorted (one group) and unsorted (numbered records), as frames."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from typing import Final, NamedTuple

from sil.logs.frame import LogFrame
from sil.logs.mdf_blocks import MdfError, MdfFile
from sil.logs.mdf_frames import FrameGroup
from sil.logs.report import LogReport, Place

LARGEST_RECORD: Final = 1 << 16
LARGEST_VALUE: Final = 1 << 24
_MOST_WAITING: Final = 10_000
_MERGED_OVER: Final = 1 << 14


class Group(NamedTuple):
    """A channel group: record number and size, and its frames if it has any.

    variable: its records are values of variable length that other records refer to.
    """

    address: int
    record_id: int
    cycles: int
    size: int
    frames: FrameGroup | None
    name: str
    variable: bool


class LocatedFrame(NamedTuple):
    """A frame and the byte in the file where its record is."""

    frame: LogFrame
    byte: int


class Records:
    """A stream of bytes under a data link, taken apart piece by piece."""

    def __init__(self, file: MdfFile, report: LogReport, open_end: bool) -> None:
        self.file = file
        self.report = report
        self.open_end = open_end
        self._pieces: Iterator[tuple[int, bytes]] = iter(())
        self._held = b""
        self._pos = 0
        self._piece_byte = 0

    def open(self, link: int, kind: str = "DT") -> None:
        """Begin with the data under a link."""
        self._pieces = iter(self.file.data(link, kind, self.open_end))
        self._held, self._pos = b"", 0

    @property
    def byte(self) -> int:
        """About where in the file the next bytes are."""
        return self._piece_byte + self._pos

    def take(self, size: int) -> bytes | None:
        """The next `size` bytes, None when there are fewer."""
        while len(self._held) - self._pos < size:
            piece = next(self._pieces, None)
            if piece is None:
                return None
            rest = self._held[self._pos :]
            self._held, self._pos = rest + piece[1], 0
            self._piece_byte = piece[0] - len(rest)
        begin = self._pos
        self._pos += size
        return self._held[begin : begin + size]

    @property
    def rest(self) -> int:
        """Bytes left over after the last whole record."""
        return len(self._held) - self._pos


class _StoredValues:
    """Values of variable length in SD blocks: length and bytes, found by their offset."""

    def __init__(self, records: Records, link: int) -> None:
        self._link = link
        self._records = Records(records.file, records.report, records.open_end)
        self._records.open(link, "SD")
        self._offset = 0

    def at(self, offset: int) -> bytes:
        """The value at an offset; offsets grow from record to record.

        Raises: ValueError when there is none.
        """
        if offset < self._offset:
            raise ValueError(f"its data at {offset} lies before that of the record before it")
        while self._offset < offset:
            step = min(offset - self._offset, LARGEST_RECORD)
            if self._records.take(step) is None:
                raise ValueError(f"no data at {offset}")
            self._offset += step
        head = self._records.take(4)
        if head is None:
            raise ValueError(f"no data at {offset}")
        length = int.from_bytes(head, "little")
        self._offset += 4
        if length > LARGEST_RECORD:
            raise ValueError(f"data of {length} bytes")
        value = self._records.take(length)
        if value is None:
            raise ValueError(f"data of {length} bytes is cut off")
        self._offset += length
        return value


def sorted_records(
    records: Records, group: Group, link: int, id_size: int
) -> Iterator[LocatedFrame]:
    """The frames of a data group with one channel group."""
    report = records.report
    frames = group.frames
    if frames is None or (not group.cycles and not records.open_end):
        return
    try:
        yield from _sorted(records, group, frames, link, id_size)
    except MdfError as error:
        report.skip(Place(error.reason, byte=error.byte))


def _sorted(
    records: Records, group: Group, frames: FrameGroup, link: int, id_size: int
) -> Iterator[LocatedFrame]:
    report = records.report
    size = group.size + id_size
    if not 0 < size <= LARGEST_RECORD:
        raise MdfError(group.address, f"records of {size} bytes")
    stored = None
    if frames.data_at is not None:
        stored = _StoredValues(records, frames.data_link)
    records.open(link)
    number = 0
    while records.open_end or number < group.cycles:
        record = records.take(size)
        if record is None:
            if records.rest or not records.open_end:
                report.cut(
                    Place(f"{frames.name} record {number + 1} is missing", byte=records.byte)
                )
            return
        place = records.byte - size
        record = record[id_size:]
        try:
            value = None
            if frames.data_at is not None and stored is not None:
                value = stored.at(frames.data_at(record, number))
            frame = frames.decode(record, number, value)
        except MdfError:
            raise
        except ValueError as error:
            report.skip(Place(f"{frames.name} record: {error}", byte=place))
        else:
            yield LocatedFrame(frame, place)
        number += 1


class _Waiting(NamedTuple):
    """A record whose variable-length data has not come yet."""

    group: Group
    record: bytes
    number: int
    place: int
    values_of: int
    offset: int


def unsorted_records(
    records: Records, groups: list[Group], link: int, id_size: int
) -> Iterator[LocatedFrame]:
    """The frames of a data group with numbered records of several channel groups."""
    yield from merged(_unsorted(records, groups, link, id_size))


def _unsorted(
    records: Records, groups: list[Group], link: int, id_size: int
) -> Iterator[tuple[int, LocatedFrame]]:
    try:
        yield from _Unsorted(records, groups, id_size).read(link)
    except MdfError as error:
        records.report.skip(Place(error.reason, byte=error.byte))


def merged(found: Iterator[tuple[int, LocatedFrame]]) -> Iterator[LocatedFrame]:
    """Frames of several groups in the order of their times, each group's own order kept.

    Loggers write the groups in turns, each some records late; the order is restored over the
    last 16,384 frames, so in bounded memory.
    Checked by: tests/unit/sil/logs/test_mf4.py.
    """
    queues: dict[int, deque[LocatedFrame]] = {}
    held = 0
    for record_id, located in found:
        queues.setdefault(record_id, deque()).append(located)
        held += 1
        if held > _MERGED_OVER:
            yield _earliest(queues)
            held -= 1
    while queues:
        yield _earliest(queues)


def _earliest(queues: dict[int, deque[LocatedFrame]]) -> LocatedFrame:
    """Take the frame with the earliest time off the queues' heads."""
    first = min(queues, key=lambda record_id: queues[record_id][0].frame.time_ns)
    queue = queues[first]
    located = queue.popleft()
    if not queue:
        del queues[first]
    return located


class _Unsorted:
    """State of reading numbered records; records wait for data that comes after them."""

    def __init__(self, records: Records, groups: list[Group], id_size: int) -> None:
        self._records = records
        self._report = records.report
        self._id_size = id_size
        self._groups = {group.record_id: group for group in groups}
        self._counts = dict.fromkeys(self._groups, 0)
        self._by_address = {group.address: group for group in groups}
        self._written = dict.fromkeys(self._groups, 0)
        self._values: dict[tuple[int, int], bytes] = {}
        self._waiting: deque[_Waiting] = deque()
        for group in groups:
            if not group.variable and group.size > LARGEST_RECORD:
                raise MdfError(group.address, f"records of {group.size} bytes")

    def read(self, link: int) -> Iterator[tuple[int, LocatedFrame]]:
        """Record numbers and frames, in the order of the file."""
        records, report = self._records, self._report
        records.open(link)
        while True:
            place = records.byte
            head = records.take(self._id_size)
            if head is None:
                break
            group = self._groups.get(int.from_bytes(head, "little"))
            if group is None:
                if not head.strip(b"\x00"):
                    report.note("zero bytes after the last record")
                    return
                report.cut(
                    Place(f"record number {int.from_bytes(head, 'little')} is unknown", byte=place)
                )
                break
            if not self._take(group, place):
                break
            yield from self._ready()
        if records.rest:
            report.cut(Place("the data ends inside a record", byte=records.byte))
        for waiting in self._waiting:
            yield from self._finish(waiting)

    def _take(self, group: Group, place: int) -> bool:
        """Take one record; False when the data ends inside it."""
        records = self._records
        if group.variable:
            head = records.take(4)
            if head is None:
                return self._short(place)
            length = int.from_bytes(head, "little")
            if length > LARGEST_VALUE:
                self._report.cut(Place(f"a value of {length} bytes", byte=place))
                return False
            value = records.take(length)
            if value is None:
                return self._short(place)
            offset = self._written[group.record_id]
            self._written[group.record_id] = offset + 4 + length
            if length <= LARGEST_RECORD and len(self._values) < _MOST_WAITING:
                self._values[group.record_id, offset] = value
            return True
        record = records.take(group.size)
        if record is None:
            return self._short(place)
        number = self._counts[group.record_id]
        self._counts[group.record_id] = number + 1
        if group.frames is None:
            self._report.other[group.name] += 1
            return True
        source, offset = -1, 0
        if group.frames.data_at is not None:
            values_of = self._by_address.get(group.frames.data_link)
            if values_of is None:
                raise MdfError(group.address, "variable-length data that is not in this group")
            source = values_of.record_id
            try:
                offset = group.frames.data_at(record, number)
            except ValueError as error:
                self._report.skip(Place(str(error), byte=place))
                return True
        self._waiting.append(_Waiting(group, record, number, place, source, offset))
        return True

    def _short(self, place: int) -> bool:
        self._report.cut(Place("the data ends inside a record", byte=place))
        return False

    def _ready(self) -> Iterator[tuple[int, LocatedFrame]]:
        """Hand out, in order, the records that have all their data."""
        waiting = self._waiting
        while waiting:
            first = waiting[0]
            complete = first.values_of < 0 or (first.values_of, first.offset) in self._values
            late = self._written.get(first.values_of, 0) > first.offset
            if not complete and not late and len(waiting) < _MOST_WAITING:
                return
            yield from self._finish(waiting.popleft())

    def _finish(self, waiting: _Waiting) -> Iterator[tuple[int, LocatedFrame]]:
        frames = waiting.group.frames
        if frames is None:
            return
        value = None
        try:
            if waiting.values_of >= 0:
                value = self._values.pop((waiting.values_of, waiting.offset), None)
                if value is None:
                    raise ValueError(f"no data at {waiting.offset}")
            frame = frames.decode(waiting.record, waiting.number, value)
        except MdfError:
            raise
        except ValueError as error:
            self._report.skip(Place(f"{frames.name} record: {error}", byte=waiting.place))
        else:
            yield waiting.group.record_id, LocatedFrame(frame, waiting.place)

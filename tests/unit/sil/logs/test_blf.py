"""BLF: objects of every kind, containers whole and damaged, times exact."""

from __future__ import annotations

import io
import struct
import zlib
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from can_dbc.errors import InputError
from sil.logs import LogFrame, blf, open_log
from sil.logs.blf import FRAME_LAYOUTS as LAYOUTS
from sil.logs.blf import BlfReader, ObjectType
from sil.logs.report import LogReport

START_NS = 1_700_000_000_123 * 10**6


def as_object(kind: int, body: bytes, ticks: int = 5, *, flags: int = 2, version: int = 1) -> bytes:
    """An object with its header and padding."""
    if version == 1:
        times = blf.TIMES_V1.pack(flags, 0, 0, ticks)
    else:
        times = struct.pack("<LBxHQQ", flags, 0, 0, ticks, 0)
    header_size = blf.OBJECT.size + len(times)
    size = header_size + len(body)
    header = blf.OBJECT.pack(b"LOBJ", header_size, version, size, kind)
    return header + times + body + bytes(size % 4)


def container(content: bytes, *, method: int = 2) -> bytes:
    """A log container."""
    packed = zlib.compress(content) if method == 2 else content
    size = blf.OBJECT.size + blf.CONTAINER.size + len(packed)
    header = blf.OBJECT.pack(b"LOBJ", blf.OBJECT.size, 1, size, ObjectType.CONTAINER)
    return header + blf.CONTAINER.pack(method, len(content)) + packed + bytes(size % 4)


def file_of(*parts: bytes, start_ns: int = START_NS, stated_size: int = 0) -> bytes:
    """A BLF file."""
    start = blf.write_systemtime(start_ns)
    header = blf.FILE_HEADER.pack(
        b"LOGG", 144, 0, 0, 0, 0, 2, 6, 8, 1, stated_size, 0, 0, 0, *start, *start
    )
    return header.ljust(144, b"\x00") + b"".join(parts)


def can(number: int, *, flags: int = 0, dlc: int = 8, channel: int = 1) -> bytes:
    body = LAYOUTS[ObjectType.CAN].pack(
        channel, flags, dlc, 0x100 + number, bytes([number % 256]) * 8
    )
    return as_object(ObjectType.CAN, body, number * 1000)


def read(blob: bytes, tmp_path: Path, *, strict: bool = False):  # type: ignore[no-untyped-def]
    path = tmp_path / "log.blf"
    path.write_bytes(blob)
    reader = open_log(path, strict=strict)
    return list(reader), reader.report


def objects(data: bytes) -> tuple[list[LogFrame], LogReport]:
    """The frames in data as they are in a file, and the report of them."""
    report = LogReport("log.blf", "blf")
    source: Any = io.BytesIO(file_of(data))
    return [frame for batch in BlfReader(source, report, "auto") for frame in batch.frames], report


def one(body: bytes, kind: int, **header: int) -> LogFrame | None:
    found, _ = objects(as_object(kind, body, **header))
    return found[0] if found else None


CLASSIC = LogFrame(START_NS + 5, 0x123, b"\x01\x02\x03", False, channel="2", direction="Rx")


def test_objects_of_every_kind() -> None:
    data = b"\x01\x02\x03"
    assert one(LAYOUTS[ObjectType.CAN].pack(2, 0, 3, 0x123, data), ObjectType.CAN) == CLASSIC
    assert one(
        LAYOUTS[ObjectType.CAN].pack(2, 1, 3, 0x123, data), ObjectType.CAN_2
    ) == CLASSIC._replace(direction="Tx")
    assert one(
        LAYOUTS[ObjectType.CAN].pack(2, 0x80, 3, 0x80000123, b""), ObjectType.CAN
    ) == CLASSIC._replace(data=b"", extended=True, remote=True, raw_dlc=3)
    assert one(
        LAYOUTS[ObjectType.CAN].pack(2, 0, 12, 0x123, bytes(8)), ObjectType.CAN
    ) == CLASSIC._replace(data=bytes(8), raw_dlc=12)
    fd = LAYOUTS[ObjectType.CAN_FD].pack(2, 0, 9, 0x123, 0, 0, 7, 12, bytes(range(12)))
    long = CLASSIC._replace(data=bytes(range(12)), fd=True, brs=True, esi=True)
    assert one(fd, ObjectType.CAN_FD) == long
    fd_64 = LAYOUTS[ObjectType.CAN_FD_64].pack(
        2, 9, 12, 0, 0x123, 0, 0x7000, 0, 0, 0, 0, 0, 0, 0, 0
    )
    assert one(fd_64 + bytes(range(12)), ObjectType.CAN_FD_64) == long
    error = LAYOUTS[ObjectType.CAN_ERROR_EXT].pack(2, 0, 0, 0, 0, 3, 0, 0x123, 0, data)
    assert one(error, ObjectType.CAN_ERROR_EXT) == CLASSIC._replace(error=True, direction="")
    assert one(LAYOUTS[ObjectType.CAN_ERROR].pack(2, 0), ObjectType.CAN_ERROR) == LogFrame(
        START_NS + 5, 0, b"", False, error=True, channel="2"
    )
    assert one(bytes([2]) + bytes(60), ObjectType.CAN_FD_ERROR_64) == LogFrame(
        START_NS + 5, 0, b"", False, error=True, fd=True, channel="2"
    )
    for kind, name in ((65, "text"), (12, "LIN event"), (4711, "BLF object of type 4711")):
        assert objects(as_object(kind, bytes(20)))[1].other == {name: 1}


def test_trailing_zero_bytes_that_vector_leaves_out() -> None:
    """CANoe stores fewer bytes than the length states; the missing ones are zero."""
    body = LAYOUTS[ObjectType.CAN_FD_64].pack(
        1, 15, 64, 0, 0x123, 0, 0x1000, 0, 0, 0, 0, 0, 0, 0, 0
    )
    found = one(body + b"\x01\x02", ObjectType.CAN_FD_64)
    assert isinstance(found, LogFrame)
    assert found.data == b"\x01\x02" + bytes(62)


def test_times_in_both_units_and_header_versions() -> None:
    body = LAYOUTS[ObjectType.CAN].pack(2, 0, 3, 0x123, b"\x01\x02\x03")
    assert one(body, ObjectType.CAN, flags=1) == CLASSIC._replace(time_ns=START_NS + 50_000)
    assert one(body, ObjectType.CAN, version=2) == CLASSIC
    found, report = objects(as_object(ObjectType.CAN, body, flags=0))
    assert not found and report.places["skipped"][0].startswith("byte 144: time flag 0, 48 ")


@given(
    st.lists(
        st.tuples(
            st.integers(0, 2**62),
            st.sampled_from((0, 1, 2, 0x80)),
            st.integers(0, 15),
            st.integers(0, 0x7FF) | st.integers(0x80000000, 0x9FFFFFFF),
            st.sampled_from((ObjectType.CAN, ObjectType.CAN_2, ObjectType.CAN_ERROR)),
            st.sampled_from((1, 2)),
        ),
        max_size=8,
    )
)
@settings(deadline=None)
def test_runs_of_plain_frames_are_read_as_each_by_itself(
    rows: list[tuple[int, int, int, int, int, int]],
) -> None:
    blobs = []
    for ticks, flags, dlc, word, kind, unit in rows:
        body = LAYOUTS[ObjectType.CAN].pack(7, flags, dlc, word, bytes(range(8)))
        blobs.append(as_object(kind, body, ticks % 2**40, flags=unit))
    found, report = objects(b"".join(blobs))
    alone = [objects(blob) for blob in blobs]
    assert found == [frame for frames, _ in alone for frame in frames]
    assert report.skipped == sum(each.skipped for _, each in alone)


def test_objects_may_go_on_in_the_next_container(tmp_path: Path) -> None:
    content = b"".join(can(i) for i in range(50))
    pieces = [content[i : i + 70] for i in range(0, len(content), 70)]
    frames, report = read(file_of(*(container(piece) for piece in pieces)), tmp_path)
    assert [frame.can_id for frame in frames] == [0x100 + i for i in range(50)]
    assert [frame.time_ns - START_NS for frame in frames] == [i * 1000 for i in range(50)]
    assert report.clean
    assert report.start_ns == START_NS


def test_containers_unpacked_and_objects_without_any(tmp_path: Path) -> None:
    blob = file_of(container(can(0) + can(1), method=0), can(2), can(3))
    frames, report = read(blob, tmp_path)
    assert [frame.can_id for frame in frames] == [0x100, 0x101, 0x102, 0x103]
    assert report.clean


def test_a_damaged_container_is_left_out_whole(tmp_path: Path) -> None:
    parts = [container(b"".join(can(10 * k + i) for i in range(10))) for k in range(3)]
    damaged = bytearray(parts[1])
    damaged[50] ^= 0x55
    frames, report = read(file_of(parts[0], bytes(damaged), parts[2]), tmp_path)
    assert [frame.can_id - 0x100 for frame in frames] == [*range(10), *range(20, 30)]
    assert report.skipped == 1
    assert report.places["skipped"][0].startswith(f"byte {144 + len(parts[0])}: ")
    with pytest.raises(InputError, match=r"byte \d+: damaged container"):
        read(file_of(parts[0], bytes(damaged), parts[2]), tmp_path, strict=True)


@pytest.mark.parametrize("rubbish", [b"\xff" * 100, b"LOBJ" * 20, b"x", b"LOBJ\xff\xff"])
def test_rubbish_between_objects_is_passed_over(rubbish: bytes, tmp_path: Path) -> None:
    frames, report = read(file_of(container(can(0)), rubbish, container(can(1))), tmp_path)
    assert [frame.can_id for frame in frames] == [0x100, 0x101]
    assert report.skipped >= 1 or len(rubbish) < 4


def test_rubbish_inside_a_container(tmp_path: Path) -> None:
    content = can(0) + b"?" * 33 + can(1) + blf.OBJECT.pack(b"LOBJ", 32, 1, 2**31, 1) + can(2)
    frames, report = read(file_of(container(content)), tmp_path)
    assert [frame.can_id for frame in frames] == [0x100, 0x101, 0x102]
    assert report.skipped == 2
    assert "33 bytes left out" in report.places["skipped"][0]


def test_a_cut_log_gives_what_there_is(tmp_path: Path) -> None:
    import random

    rng = random.Random(1)
    body = b"".join(
        as_object(1, LAYOUTS[ObjectType.CAN].pack(1, 0, 8, i, rng.randbytes(8)), i)
        for i in range(2000)
    )
    blob = file_of(container(body))
    frames, report = read(blob[: len(blob) // 2], tmp_path)
    assert 100 < len(frames) < 2000
    assert [frame.can_id for frame in frames] == list(range(len(frames)))
    assert report.truncated
    with pytest.raises(InputError, match="not cut off"):
        read(blob[: len(blob) // 2], tmp_path, strict=True)


def test_a_log_shorter_than_its_header_states(tmp_path: Path) -> None:
    frames, report = read(file_of(container(can(0)), stated_size=10_000), tmp_path)
    assert len(frames) == 1
    assert report.truncated


@pytest.mark.parametrize("method", [1, 3, 255])
def test_unknown_packing_is_named(method: int, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=f"packed by method {method}"):
        read(file_of(container(can(0), method=method)), tmp_path)


def test_a_bomb_is_no_memory(tmp_path: Path) -> None:
    packed = zlib.compress(bytes(20 << 20), 1)
    size = 32 + len(packed)
    head = blf.OBJECT.pack(b"LOBJ", 16, 1, size, 10) + blf.CONTAINER.pack(2, 1000)
    frames, report = read(file_of(head + packed + bytes(size % 4), container(can(1))), tmp_path)
    assert [frame.can_id for frame in frames] == [0x101]
    assert report.skipped == 1


def test_unfinished_is_named() -> None:
    found, report = objects(can(0) + can(1)[:20])
    assert len(found) == 1
    assert report.notes[-1] == "cut off at byte 192: the log ends inside an object"

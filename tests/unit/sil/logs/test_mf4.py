"""MF4: files as loggers and asammdf leave them, and every block broken."""

from __future__ import annotations

import random
import struct
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from can_dbc.errors import InputError
from sil.logs import LogFrame, open_log, open_writer
from sil.logs.traces import holds_signals_only
from tests.unit.sil.logs.mf4_builder import DATA_FRAME, Field, Mf4Builder, logger_file, signal_file

START_NS = 1_700_000_000 * 10**9
Events = Sequence[tuple[int, int, bytes]]
EVENTS = [(0, 0x18FEF100, bytes(range(8))), (250_000, 0x7FF, b""), (251_001, 0x123, b"\x01\x02")]


def read(blob: bytes, tmp_path: Path, *, strict: bool = False) -> tuple[list[LogFrame], Any]:
    path = tmp_path / "log.mf4"
    path.write_bytes(blob)
    reader = open_log(path, strict=strict)
    return list(reader), reader.report


def expected(events: Events) -> list[LogFrame]:
    return [
        LogFrame(START_NS + t, can_id, data, channel="1", direction="Rx")
        for t, can_id, data in events
    ]


def test_a_logger_file(tmp_path: Path) -> None:
    frames, report = read(logger_file(EVENTS, START_NS, error_at=[100]), tmp_path)
    error = LogFrame(START_NS + 100, 0, b"", False, error=True, channel="1")
    wanted = expected(EVENTS)
    assert frames == [wanted[0], error, *wanted[1:]]
    assert report.clean
    assert report.start_ns == START_NS
    assert any("did not finish" in note for note in report.notes)


def test_signals_only_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"holds decoded signals only \(engine_speed, .*no CAN"):
        read(signal_file(), tmp_path)
    assert holds_signals_only(str(tmp_path / "log.mf4"))
    (tmp_path / "log.mf4").write_bytes(logger_file(EVENTS, START_NS))
    assert not holds_signals_only(str(tmp_path / "log.mf4"))


@pytest.mark.parametrize("version", [b"3.30    ", b"5.00    "])
def test_other_versions_are_named(version: bytes, tmp_path: Path) -> None:
    blob = bytearray(signal_file())
    blob[8:16] = version
    with pytest.raises(InputError, match=r"MDF version '\d.*; expected MDF 4"):
        read(bytes(blob), tmp_path)


def test_a_file_without_header_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="byte 0: no MDF header; expected MDF 4"):
        read(b"", tmp_path)


def other_layout(fields: Sequence[Field], records: bytes, size: int, *, cycles: int = 0) -> bytes:
    """A finished file with records of another layout."""
    build = Mf4Builder(finished=True)
    build.block(b"HD", [0] * 6, bytes(32))
    group = build.group(0, build.channels(fields), size, cycles=cycles or len(records) // size)
    build.link(64, 0, build.data_group(group, build.block(b"DT", [], records), 0))
    return bytes(build.blob)


@pytest.mark.parametrize("size", [0, 2**31])
def test_records_of_impossible_sizes(size: int, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"outside of its record|records of"):
        read(other_layout(DATA_FRAME, bytes(66), size, cycles=3), tmp_path)


def test_times_as_whole_numbers_of_microseconds(tmp_path: Path) -> None:
    """As loggers with 48-bit stamps write: exact, whatever the factor's double is."""
    fields = (
        Field("t", 0, 0, 48, 0, 2, (1, (0.0, 1e-6))),
        Field("CAN_DataFrame", 6, 0, 56, 10),
        Field("CAN_DataFrame.ID", 6, 0, 32),
        Field("CAN_DataFrame.BusChannel", 0, 0, 0, 0, 6, (1, (9.0, 0.0))),
        Field("CAN_DataFrame.DataLength", 10, 0, 4, 0, 0, (5, (0.0, 0.0, 1.0, 2.0))),
        Field("CAN_DataFrame.DataBytes", 11, 0, 16, 10),
    )
    stamp = 3_607_123_457
    records = b"".join(
        stamp.to_bytes(6, "little") + struct.pack("<IB", can_id, code) + b"\xaa\xbb"
        for can_id, code in ((0x123, 1), (0x9ABCDEF0, 0))
    )
    frames, _ = read(other_layout(fields, records, 13), tmp_path)
    assert [(f.time_ns, f.can_id, f.extended, f.data, f.channel) for f in frames] == [
        (stamp * 1000, 0x123, False, b"\xaa\xbb", "9"),
        (stamp * 1000, 0x1ABCDEF0, True, b"", "9"),
    ]


def test_big_endian_and_signed_fields(tmp_path: Path) -> None:
    fields = (
        Field("t", 0, 0, 64, 5, 2),
        Field("CAN_DataFrame", 8, 0, 96, 10),
        Field("CAN_DataFrame.ID", 8, 0, 32, 1),
        Field("CAN_DataFrame.IDE", 12, 0, 1),
        Field("CAN_DataFrame.DLC", 13, 0, 8, 3),
        Field("CAN_DataFrame.DataBytes", 14, 0, 32, 10),
        Field("CAN_DataFrame.Dir", 18, 0, 16, 6),
    )
    record = struct.pack(">dIBB4s2s", 1.25, 0x18FEF100, 1, 4, b"\x01\x02\x03\x04", b"Tx")
    frames, _ = read(other_layout(fields, record, 20), tmp_path)
    assert frames == [LogFrame(1_250_000_000, 0x18FEF100, b"\x01\x02\x03\x04", direction="Tx")]


def test_times_beyond_the_exact_span_are_counted(tmp_path: Path) -> None:
    path = tmp_path / "log.mf4"
    with open_writer(path) as writer:
        writer.write(LogFrame(0, 1, b"", channel="1", direction="Rx"))
        writer.write(LogFrame(4_000_001 * 10**9, 1, b"", channel="1", direction="Rx"))
    assert writer.losses == {"times more than 46 days from the start, rounded": 1}


def test_without_asammdf_the_install_command_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "log.mf4"
    path.write_bytes(logger_file(EVENTS, START_NS))
    monkeypatch.setitem(sys.modules, "asammdf", None)
    missing = r"MF4 needs asammdf, which is not installed; expected it after: .*\[mdf\]'$"
    with pytest.raises(InputError, match=missing):
        list(open_log(path))
    with pytest.raises(InputError, match=missing):
        open_writer(tmp_path / "other.mf4")
    assert list(tmp_path.iterdir()) == [path]


@pytest.fixture(scope="module")
def large(tmp_path_factory: pytest.TempPathFactory) -> tuple[list[LogFrame], bytes]:
    """Frames of all kinds, and the MF4 log that we write of them."""
    rng, frames = random.Random(5), []
    for number in range(12_000):
        frame = LogFrame(START_NS + number // 4 * 1000, rng.randrange(1 << 29), rng.randbytes(8))
        if number % 7 == 0:
            frame = frame._replace(fd=True, data=rng.randbytes(16))
        elif number % 11 == 0:
            frame = frame._replace(remote=True, data=b"")
        frames.append(frame._replace(channel="1", direction="Rx"))
    path = tmp_path_factory.mktemp("large") / "log.mf4"
    with open_writer(path) as writer:
        for frame in frames:
            writer.write(frame)
    return frames, path.read_bytes()


def test_frames_of_different_kinds_at_one_instant_keep_their_order(
    large: tuple[list[LogFrame], bytes], tmp_path: Path
) -> None:
    frames, content = large
    found, report = read(content, tmp_path, strict=True)
    assert found == frames
    assert report.clean

"""MF4: logs as loggers and asammdf leave them, every block broken; tables of signals."""

from __future__ import annotations

import gzip
import importlib
import random
import struct
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from can_dbc.errors import InputError
from sil.logs import LogFrame, convert, open_log, open_writer
from tests.support.golden_logs import write


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
            name = self.block(b"TX", [], field.name.encode() + b"\0")
            links = [0, 0, name, 0, conversion, data, 0, 0]
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
    """An unsorted, unfinished file, as CANedge's; frames: ns from the start, identifier, data; error_at: times of errors."""
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
    write(path, frames)
    return frames, path.read_bytes()


def test_frames_of_different_kinds_at_one_instant_keep_their_order(
    large: tuple[list[LogFrame], bytes], tmp_path: Path
) -> None:
    frames, content = large
    found, report = read(content, tmp_path, strict=True)
    assert found == frames
    assert report.clean


DATA = Path(__file__).resolve().parents[3] / "data" / "logs"


def test_a_trace_becomes_mf4_with_units(tmp_path: Path) -> None:
    asammdf = importlib.import_module("asammdf")
    target = tmp_path / "trace.mf4"
    report = convert(DATA / "signals.csv", target)
    assert report.signals is not None
    assert report.signals.rows == report.written == 2
    assert report.signals.names == ("position_m", "pressure_B_pa", "cmd_B")
    assert report.lines()[0].startswith(f"{target}: 2 rows of 3 signals")
    with asammdf.MDF(target) as measurement:
        pressure = measurement.get("pressure_B_pa")
        assert list(pressure.samples) == [101325.0, 101400.0]
        assert list(pressure.timestamps) == [0.0, 0.001]
        assert pressure.unit == "Pa"
        assert measurement.get("position_m").unit == "m"
        assert measurement.header.abs_time == 0


def test_a_long_trace_comes_back_bit_by_bit(tmp_path: Path) -> None:
    source, middle, target = (tmp_path / f"{n}" for n in ("a.csv", "b.mf4", "c.csv"))
    rows = [(i * 1e-4, i / 3.0, -(i**0.5)) for i in range(40_000)]
    text = "time_s,position_m,impulse_n_s\n" + "".join(
        ",".join(repr(float(value)) for value in row) + "\n" for row in rows
    )
    source.write_text(text)
    convert(source, middle)
    report = convert(middle, target)
    assert target.read_text() == text
    assert report.signals is not None
    assert report.signals.units == ("m", "N·s")


def test_signals_of_others_become_a_table(tmp_path: Path) -> None:
    source, target = tmp_path / "log.mf4", tmp_path / "log.csv"
    source.write_bytes(signal_file())
    convert(source, target)
    assert target.read_text() == "time_s,engine_speed\n0.0,1.0\n0.1,2.0\n"
    convert(source, tmp_path / "log.csv.gz")
    assert gzip.decompress((tmp_path / "log.csv.gz").read_bytes()) == target.read_bytes()
    with pytest.raises(InputError, match="decoded signals only"):
        convert(source, tmp_path / "log.blf")


def test_signals_that_are_no_table_are_refused(tmp_path: Path) -> None:
    build = Mf4Builder(finished=True)
    build.block(b"HD", [0] * 6, bytes(32))
    groups = []
    for fields in (
        (Field("time", 0, 0, 64, 4, 2), Field("text", 8, 0, 64, 6)),
        (Field("time", 0, 0, 64, 4, 2), Field("a", 8, 0, 64, 4)),
    ):
        group = build.group(0, build.channels(fields), 16, cycles=1, flags=0)
        groups.append(build.data_group(group, build.block(b"DT", [], bytes(16)), 0))
    path = tmp_path / "log.mf4"
    build.link(64, 0, groups[0])
    path.write_bytes(build.blob)
    with pytest.raises(InputError, match="signal text: no plain numbers"):
        convert(path, tmp_path / "log.csv")
    build.link(groups[0], 0, groups[1])
    path.write_bytes(build.blob)
    with pytest.raises(InputError, match="signals in 2 groups"):
        convert(path, tmp_path / "log.csv")
    assert [entry.name for entry in tmp_path.iterdir()] == ["log.mf4"]


@pytest.mark.parametrize(
    ("rows", "reason"),
    [
        ("0.0,1.0\n", r"line 2: 2 columns; expected 3"),
        ("0.0,1.0,x\n", r"line 2: .* is not numbers"),
        ("0.1,1,2\n0.0,1,2\n", r"line 3: time 0.0 s after 0.1 s"),
        ("", r"no rows under the header"),
        ("nan,1,2\n", r"line 2: time nan"),
    ],
)
def test_torn_traces_are_refused(rows: str, reason: str, tmp_path: Path) -> None:
    source = tmp_path / "trace.csv"
    source.write_text(f"time_s,position_m,force_n\n{rows}")
    with pytest.raises(InputError, match=reason):
        convert(source, tmp_path / "trace.mf4")
    assert [path.name for path in tmp_path.iterdir()] == ["trace.csv"]


@pytest.mark.parametrize("header", ["time_s,a,a", "time_s,a b", "time_s,"])
def test_odd_headers_are_refused(header: str, tmp_path: Path) -> None:
    source = tmp_path / "trace.csv"
    source.write_text(f"{header}\n0.0,1.0,2.0\n")
    with pytest.raises(InputError, match="expected distinct names"):
        convert(source, tmp_path / "trace.mf4")

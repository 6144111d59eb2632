"""Files, plain and gzipped, whole and damaged; what is no log is named."""

from __future__ import annotations

import gzip
import io
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from can_dbc.errors import InputError
from sil.logs import open_log
from sil.logs.byte_source import ByteSource, Gunzip
from sil.logs.report import LogReport

LINE = b"(1.000000) can0 123#11\n"


def everything(source: ByteSource) -> bytes:
    blob = b""
    while block := source.read(7):
        blob += block
    source.close()
    return blob


@pytest.mark.parametrize("packed", [False, True])
def test_all_bytes_come_once(packed: bool, tmp_path: Path) -> None:
    blob = bytes(range(256)) * 300
    path = tmp_path / "file"
    path.write_bytes(gzip.compress(blob) if packed else blob)
    source = ByteSource(str(path), LogReport(str(path), "test"))
    assert source.packed is packed
    assert blob.startswith(source.head)
    assert everything(source) == blob


@settings(deadline=None)
@given(st.binary(max_size=300), st.binary(max_size=300), st.integers(1, 50))
def test_gunzip_is_gzip(first: bytes, second: bytes, step: int) -> None:
    """Also for files of several members, and with zero bytes after them."""
    blob = gzip.compress(first) + gzip.compress(second) + bytes(17)
    report = LogReport("x", "test")
    gunzip = Gunzip(io.BytesIO(blob), report)
    found = b""
    while block := gunzip.read(step):
        found += block
    assert found == first + second
    assert report.clean


def test_a_cut_gzip_gives_what_there_is(tmp_path: Path) -> None:
    lines = b"".join(b"(%d.000000) can0 123#%02X\n" % (i, i % 256) for i in range(20_000))
    path = tmp_path / "log.gz"
    path.write_bytes(gzip.compress(lines)[:20_000])
    reader = open_log(path)
    frames = list(reader)
    assert 1000 < len(frames) < 20_000
    assert [frame.time_ns for frame in frames] == [i * 10**9 for i in range(len(frames))]
    assert reader.report.truncated
    with pytest.raises(InputError, match="gzip file ends too early"):
        list(open_log(path, strict=True))


def test_damage_in_a_gzip_is_reported(tmp_path: Path) -> None:
    blob = bytearray(gzip.compress(LINE * 100))
    blob[-6] ^= 0xFF
    path = tmp_path / "log.gz"
    path.write_bytes(blob)
    reader = open_log(path)
    assert list(reader)
    assert any("damaged gzip" in str(place) for place in reader.report.skipped_places)
    with pytest.raises(InputError, match="damaged gzip"):
        list(open_log(path, strict=True))


def test_a_byte_order_mark_is_no_garbage(tmp_path: Path) -> None:
    path = tmp_path / "log.log"
    path.write_bytes(b"\xef\xbb\xbf" + LINE)
    reader = open_log(path)
    assert len(list(reader)) == 1
    assert reader.report.clean


@pytest.mark.parametrize(
    ("magic", "name"),
    [
        (b"PK\x03\x04", "zip"),
        (b"BZh9", "bzip2"),
        (b"\xfd7zXZ\x00", "xz"),
        (b"\x28\xb5\x2f\xfd", "zstd"),
        (b"\xff\xfe(\x00", "UTF-16"),
        (b"SQLite format 3\x00", "SQLite"),
        (b"\xd4\xc3\xb2\xa1", "pcap"),
    ],
)
def test_what_is_no_log_is_named(magic: bytes, name: str, tmp_path: Path) -> None:
    path = tmp_path / "some.log"
    path.write_bytes(magic + bytes(100))
    with pytest.raises(InputError, match=f"is an? .*{name}|is {name}"):
        open_log(path)


def test_no_file_no_folder(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="No such file"):
        open_log(tmp_path / "missing.log")
    with pytest.raises(InputError, match="is a folder"):
        open_log(tmp_path)
    with pytest.raises(InputError, match="No such file"):
        open_log(tmp_path / "missing.log", format="candump")


def test_a_bomb_is_refused_before_it_is_read(tmp_path: Path) -> None:
    path = tmp_path / "bomb.log.gz"
    path.write_bytes(gzip.compress(b"\n" * 20_000_000))
    source = ByteSource(str(path), LogReport(str(path), "test"))
    read = 0
    with pytest.raises(InputError, match=r"bomb\.log\.gz: unpacks to over 100 times its size"):
        while block := source.read(1 << 16):
            read += len(block)
    assert 1 << 20 <= read < 20_000_000
    source.close()


def test_a_log_that_packs_well_is_no_bomb(tmp_path: Path) -> None:
    blob = b"".join(b"(%.6f) can0 123#1122334455667788\n" % (0.01 * k) for k in range(100_000))
    path = tmp_path / "long.log.gz"
    path.write_bytes(gzip.compress(blob, 9))
    assert len(blob) > 8 * path.stat().st_size
    source = ByteSource(str(path), LogReport(str(path), "test"))
    count = 0
    while block := source.read(1 << 16):
        count += len(block)
    source.close()
    assert count == len(blob)

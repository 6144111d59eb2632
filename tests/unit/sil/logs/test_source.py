"""Bytes of files, lines of any stream, what is no log; times exact, never through a float."""

from __future__ import annotations

import gzip
import io
from decimal import ROUND_HALF_UP, Decimal, localcontext
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from can_dbc.errors import InputError
from sil.logs import open_log, source
from sil.logs.report import LogReport
from sil.logs.source import LONGEST_LINE, ByteSource, chunks, lines
from sil.logs.times import (
    enough_decimals,
    format_ns,
    parse_date,
    parse_decimal_ns,
    utc_ns,
    write_date,
)
from tests.support.golden_logs import log_of

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


def test_gzip_files_of_several_members(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_bytes(gzip.compress(b"one\n") + gzip.compress(b"two\n") + bytes(17))
    report = LogReport(str(path), "test")
    assert everything(ByteSource(str(path), report)) == b"one\ntwo\n"
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
    assert any("damaged gzip" in place for place in reader.report.places["skipped"])
    with pytest.raises(InputError, match="damaged gzip"):
        list(open_log(path, strict=True))


def test_a_byte_order_mark_is_no_garbage(tmp_path: Path) -> None:
    reader = log_of(tmp_path / "log.log", b"\xef\xbb\xbf" + LINE)
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


def test_what_unpacks_to_more_than_the_limit_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "same.log.gz"
    path.write_bytes(gzip.compress(b"(000.000100) can0 123#11\n" * 200_000))  # 300 times its size
    assert len(list(open_log(path))) == 200_000
    monkeypatch.setattr(source.ByteSource, "most_unpacked_bytes", 1 << 20)
    with pytest.raises(InputError, match=r"same\.log\.gz: unpacks to over 0 GiB; expected less"):
        list(open_log(path))


class Dripping:
    """A stream that gives a few bytes at a time."""

    def __init__(self, blob: bytes, sizes: list[int]) -> None:
        self._stream = io.BytesIO(blob)
        self._sizes = sizes

    def read(self, size: int, /) -> bytes:
        drip = self._sizes[self._stream.tell() % len(self._sizes)]
        return self._stream.read(min(size, drip))


@settings(deadline=None)
@given(
    st.lists(st.binary(max_size=12).map(lambda b: b.replace(b"\n", b"x")), max_size=20),
    st.booleans(),
    st.lists(st.integers(1, 9), min_size=1, max_size=5),
)
def test_lines_are_those_of_the_text(parts: list[bytes], ended: bool, sizes: list[int]) -> None:
    blob = b"\n".join(parts) + (b"\n" if ended and parts else b"")
    found = list(lines(Dripping(blob, sizes)))
    expected = blob.split(b"\n")
    if expected[-1] == b"":
        expected.pop()
    assert [line.text.encode("latin-1") for line in found] == [
        part.removesuffix(b"\r") for part in expected
    ]
    assert [line.number for line in found] == list(range(1, len(found) + 1))
    for line, part in zip(found, expected, strict=True):
        assert blob[line.byte :].startswith(part)
    assert [line.unterminated for line in found[:-1]] == [False] * (len(found) - 1)
    if found:
        assert found[-1].unterminated is not blob.endswith(b"\n")


def test_a_line_without_end_takes_bounded_memory() -> None:
    class Endless:
        def __init__(self) -> None:
            self.given = 0

        def read(self, size: int, /) -> bytes:
            if self.given >= 200 << 20:
                return b""
            self.given += 1 << 20
            return b"\x00" * (1 << 20)

    assert max(len(chunk.text) for chunk in chunks(Endless())) <= LONGEST_LINE + 1


def test_lines_after_an_overlong_one_keep_their_numbers() -> None:
    blob = b"one\n" + b"x" * 300_000 + b"\nthree\n"
    found = list(lines(io.BytesIO(blob)))
    assert [(line.number, line.text[:5]) for line in found] == [
        (1, "one"),
        (2, "xxxxx"),
        (3, "three"),
    ]
    assert found[2].byte == blob.index(b"three")


@settings(deadline=None)
@given(st.integers(-(2**62), 2**62))
def test_nanoseconds_survive_as_text(time_ns: int) -> None:
    assert parse_decimal_ns(format_ns(time_ns, 9)) == time_ns
    assert parse_decimal_ns(format_ns(time_ns)) == time_ns


@settings(deadline=None)
@given(
    st.from_regex(r"\A[+-]?[0-9]{1,9}(\.[0-9]{0,20})?\Z"), st.sampled_from((1, 1000, 10**6, 10**9))
)
def test_parsing_agrees_with_decimal(text: str, unit_ns: int) -> None:
    with localcontext() as context:
        context.prec = 60
        exact = Decimal(text) * unit_ns
        expected = int(abs(exact).to_integral_value(rounding=ROUND_HALF_UP))
    assert parse_decimal_ns(text, unit_ns) == (-expected if exact < 0 else expected)


@pytest.mark.parametrize(
    ("text", "time_ns"),
    [
        ("1.4E+3", 1_400_000_000_000),
        ("2e-9", 2),
        ("1483389946.197", 1_483_389_946_197_000_000),
        (".5", 500_000_000),
        ("7.", 7_000_000_000),
        ("0.0000000005", 1),
        ("0.00000000049", 0),
    ],
)
def test_odd_numbers(text: str, time_ns: int) -> None:
    assert parse_decimal_ns(text) == time_ns


@pytest.mark.parametrize(
    "text", ["", ".", "-", "1.2.3", "1_0", " 1", "1e400", "nan", "inf", "0x1", "9" * 16, "1²"]
)
def test_no_times(text: str) -> None:
    with pytest.raises(ValueError, match="time"):
        parse_decimal_ns(text)


def test_out_of_range() -> None:
    with pytest.raises(ValueError, match="out of range"):
        parse_decimal_ns("9223372036.854775808")
    assert parse_decimal_ns("9223372036.854775807") == 2**63 - 1


def test_decimals_as_needed() -> None:
    assert format_ns(1_500_000) == "0.001500"
    assert format_ns(1_500_001) == "0.001500001"
    assert format_ns(-1_500_001, 6) == "-0.001500"
    assert format_ns(999_999_999, 6) == "1.000000"
    assert enough_decimals([(1000,), (2000,)]) == 6
    assert enough_decimals([(1000,), (2001,)]) == 9


@pytest.mark.parametrize(
    ("text", "moment"),
    [
        ("Sat Sep 30 22:06:13.191 2017", (2017, 9, 30, 22, 6, 13, 191_000_000)),
        ("Sam Sep 30 22:06:13.191 2017", (2017, 9, 30, 22, 6, 13, 191_000_000)),
        ("Sat Sep 30 10:06:13.191 PM 2017", (2017, 9, 30, 22, 6, 13, 191_000_000)),
        ("Thu Dez 28 12:00:00 am 2022", (2022, 12, 28)),
        ("Thu Mai 5 12:00:00 pm 2022", (2022, 5, 5, 12)),
    ],
)
def test_dates_of_loggers(text: str, moment: tuple[int, ...]) -> None:
    assert parse_date(text) == utc_ns(*moment)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "yesterday",
        "Sat Feb 30 10:00:00 2017",
        "Sat Sep 30 13:00:00 pm 2017",
        "Sat Foo 3 1:00:00 2017",
    ],
)
def test_no_dates(text: str) -> None:
    assert parse_date(text) is None


@settings(deadline=None)
@given(st.integers(0, 4 * 10**18))
def test_written_dates_are_read(time_ns: int) -> None:
    assert parse_date(write_date(time_ns)) == time_ns // 10**6 * 10**6

"""ASC: kinds of lines, number bases, kinds of times, and what is left out by name."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from can_dbc.errors import InputError
from sil.logs import LogFrame, LogReport, convert, open_log, open_logs, open_writer
from sil.logs.asc import parse_event
from sil.logs.format import ZONE_NOTE, NotAFrame
from sil.logs.frame import frame_problem
from sil.logs.times import utc_ns
from tests.support.golden_logs import log_of

DATA = Path(__file__).resolve().parents[3] / "data" / "logs"


def test_a_torn_log_of_all_kinds() -> None:
    reader = open_log(DATA / "torn.asc")
    frames = list(reader)
    rx = LogFrame(0, 0, channel="1", direction="Rx")
    standard = rx._replace(direction="Tx", extended=False)
    fd, eight = rx._replace(fd=True, channel="2"), bytes.fromhex("55AA010203040506")
    assert frames == [
        standard._replace(time_ns=1_100_000_000, can_id=0x180, data=b"\x6a" + bytes(7)),
        standard._replace(time_ns=1_100_001_000, can_id=0x3FF, data=eight, raw_dlc=13),
        rx._replace(time_ns=1_100_002_000, can_id=0x123, remote=True, raw_dlc=8),
        LogFrame(1_100_003_000, 0, b"", False, error=True, channel="2"),
        fd._replace(
            time_ns=1_100_007_000, can_id=0x300, data=bytes(range(1, 13)), extended=False, brs=True
        ),
        fd._replace(time_ns=1_100_008_000, can_id=0x50005, remote=True, raw_dlc=5, direction="Tx"),
        LogFrame(1_100_009_000, 0, b"", False, error=True, fd=True, channel="5", direction="Tx"),
    ]
    report = reader.report
    assert report.other == {
        "status line": 2,
        "request to send": 1,
        "frame with a symbolic name instead of its identifier": 1,
        "reassembled J1939 message": 1,
    }
    assert [place.split(":")[0] for place in report.places["skipped"]] == [
        "line 15",
        "line 20",
        "line 21",
    ]
    assert report.start_ns == utc_ns(2022, 4, 28, 10, 44, 52, 480_000_000)


def test_relative_times_are_summed_and_decimal_numbers_read() -> None:
    """Every line counts, those of other events too."""
    reader = open_log(DATA / "relative_decimal.asc")
    assert [(f.time_ns, f.can_id, f.data) for f in reader] == [
        (500_000_000, 256, bytes((17, 255))),
        (1_000_000_000, 256, bytes((18,))),
    ]
    assert reader.report.time_base == "delta"


def test_classic_frames_in_canfd_lines_and_long_classic_lines() -> None:
    classic, long = open_log(DATA / "classic_in_canfd.asc")
    assert (classic.fd, classic.data) == (False, bytes(range(1, 9)))
    assert (long.fd, long.data) == (True, bytes(range(64)))


@pytest.mark.parametrize(
    "text",
    [
        "1 180 Rx d 2 6A",
        "1 180 Rx d 2 6A 0",
        "1 180 Rx d 2 6A 00 11",
        "1 180 Rx d",
        "1 180 Rx d Z 00",
        "1 800 Rx d 0",
        "1 20000000x Rx d 0",
        "1 180 Rx q 0",
        "1 180x d 1 00",
        "CANFD 1 Rx 300 1 0 9 12 01 02",
        "CANFD 1 Rx 300 1 0 9 16 " + "00 " * 16,
        "CANFD 1 Rx 300 2 0 1 1 00",
        "CANFD 1 Sx 300 1 0 1 1 00",
        "CANFD",
    ],
)
def test_broken_frame_lines(text: str) -> None:
    if text == "1 180x d 1 00":
        with pytest.raises(NotAFrame):
            parse_event(text, decimal=False)
        return
    with pytest.raises(ValueError, match=r"\w"):
        raise ValueError(frame_problem(parse_event(text, decimal=False).frame) or "")


@pytest.mark.parametrize("text", ["1 1A0 Rx d 1 00", "1 256 Rx d A 00", "1 256 Rx d 1 256"])
def test_decimal_logs_have_decimal_numbers(text: str) -> None:
    with pytest.raises(ValueError, match=r"\w"):
        parse_event(text, decimal=True)


common = st.tuples(
    st.integers(0, 10**15).map(lambda us: us * 1000),
    st.integers(1, 40),
    st.integers(0, 0x1FFFFFFF),
    st.booleans(),
    st.binary(max_size=8),
    st.sampled_from(("Rx", "Tx")),
)


@given(rows=st.lists(common, min_size=1, max_size=40), data=st.data())
@settings(max_examples=50, deadline=None)
def test_common_and_other_lines_mixed(
    rows: list[tuple[int, int, int, bool, bytes, str]],
    data: st.DataObject,
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    """The quick reading of chunks gives what each line gives by itself."""
    frames = [
        LogFrame(t, i if x else i & 0x7FF, d, x, channel=str(c), direction=w)
        for t, c, i, x, d, w in rows
    ]
    lines = [
        f"{f.time_ns // 10**9}.{f.time_ns % 10**9 // 1000:06d} {f.channel} "
        f"{f.can_id:X}{'x' * f.extended} {f.direction} d {len(f.data)} {f.data.hex(' ').upper()}"
        for f in frames
    ]
    for _ in range(data.draw(st.integers(0, 4))):
        index = data.draw(st.integers(0, len(lines)))
        other = data.draw(st.sampled_from(("", "0.1 1 Statistic: D 2", "// remark", "rubbish")))
        lines.insert(index, other)
    path = tmp_path_factory.mktemp("asc") / "log.asc"
    header = "date Sat Sep 30 10:06:13.191 PM 2017\nbase hex  timestamps absolute\n"
    path.write_text(header + f"// {'x' * 1000}\n" * 40 + "\n".join(lines) + "\n")
    reader = open_log(path)
    assert list(reader) == frames
    assert reader.report.skipped == lines.count("rubbish")


class TestUnterminated:
    """The last line, when it has no line end."""

    @pytest.mark.parametrize(
        ("line", "kept"),
        [
            ("1.0 1 180 Rx d 2 6A 00", True),
            ("1.0 1 180 Rx d 2 6A 0", False),
            ("1.0 1 180 Rx r 8", True),
            ("1.0 1 180 Rx r", False),
            ("1.0 1 ErrorFrame", True),
            ("1.0 1 18", False),
            ("1.0 CANFD 1 Rx 30", False),
            ("1.0 CANFD 1 Rx 300 1 0 1 1 00 0 0 3000 0", True),
            ("1.0 CANFD 1 Rx 300 1 0 1 1 00 0 0 3000", False),
        ],
    )
    def test_kept(self, line: str, kept: bool, tmp_path: Path) -> None:
        reader = log_of(
            tmp_path / "log.asc", f"base hex  timestamps absolute\n0.5 1 ErrorFrame\n{line}"
        )
        assert len(list(reader)) == 1 + kept
        assert reader.report.truncated is not kept


def test_times_of_python_can_count_from_the_trigger_block(tmp_path: Path) -> None:
    """python-can dates the header when the logger starts, and the block at the first frame."""
    path = tmp_path / "log.asc"
    path.write_text(
        "date Thu Apr 28 10:44:52.480 AM 2022\nbase hex  timestamps absolute\n"
        "internal events logged\nBegin Triggerblock Thu Apr 28 10:44:55.000 AM 2022\n"
        " 0.000000 Start of measurement\n 0.500000 1  123 Rx   d 1 11\nEnd TriggerBlock\n"
    )
    reader = open_log(path)
    assert [f.time_ns for f in reader] == [500_000_000]
    assert reader.report.start_ns == utc_ns(2022, 4, 28, 10, 44, 55)
    assert reader.report.notes == [ZONE_NOTE]
    target = tmp_path / "log.log"
    convert(path, target)
    (frame,) = open_log(target)
    assert frame.time_ns == utc_ns(2022, 4, 28, 10, 44, 55, 500_000_000)


def test_remote_frames_of_can_utils_are_classic() -> None:
    """`log2asc -f` writes classic frames in CANFD lines, without the flag of CAN FD."""
    text = f"CANFD   1 Rx           123 {'':33} 0 0 4  0  130000  130       10 0 0 0 0 0"
    frame = parse_event(text, decimal=False).frame
    assert (frame.remote, frame.fd, frame.raw_dlc) == (True, False, 4)
    assert parse_event(text.replace("  10 0", "1010 0"), decimal=False).frame.fd


def test_a_frame_before_the_start_is_refused(tmp_path: Path) -> None:
    start_ns = 1_700_000_000_000_000_000
    for suffix in ("asc", "blf", "trc"):
        writer = open_writer(tmp_path / f"log.{suffix}")
        with (
            pytest.raises(InputError, match=r"is before the start .*; expected csv or mf4"),
            writer,
        ):
            for i in range(writer.batch):
                writer.write(LogFrame(start_ns + i, 1, b"", channel="1"))
            writer.write(LogFrame(start_ns - 10**9, 1, b"", channel="1"))
    assert list(tmp_path.iterdir()) == []


HEADER = "date Sat Sep 30 10:06:13.191 PM 2017\nbase hex  timestamps absolute\n"


def read_text(
    tmp_path: Path, text: str, *, strict: bool = False
) -> tuple[list[LogFrame], LogReport]:
    path = tmp_path / "log.asc"
    path.write_text(text)
    reader = open_log(path, strict=strict)
    return list(reader), reader.report


@pytest.mark.parametrize("cut", ["1  18FE", "1  18FEF100x", "1  18FEF100x       R"])
def test_a_line_cut_inside_or_after_its_identifier_is_no_other_event(
    cut: str, tmp_path: Path
) -> None:
    whole = "   0.1 1  18FEF100x       Rx   d 1 00\n"
    for end in ("", "\n"):
        with pytest.raises(InputError, match="line 4"):
            read_text(tmp_path, HEADER + whole + f"   0.2 {cut}{end}", strict=True)
    _, report = read_text(tmp_path, HEADER + whole + f"   0.2 {cut}\n" + whole)
    assert report.skipped == 1 and not report.other


def test_decimal_length_codes_of_canfd_lines_are_read(tmp_path: Path) -> None:
    codes = ((9, 12), (10, 16), (13, 32), (15, 64))
    lines = [
        f"   0.{n} CANFD   1 Rx   1F8   1 0 {code} {length} {'0A ' * length} 0 0 1000 0 0 0 0 0\n"
        for n, (code, length) in enumerate(codes)
    ]
    frames, report = read_text(tmp_path, HEADER + "".join(lines))
    assert [len(frame.data) for frame in frames] == [12, 16, 32, 64]
    assert report.skipped == 0


FRAME_291 = "   0.1 1  291  Rx d 2 {}\n"


@pytest.mark.parametrize(
    ("base", "data", "can_id", "content"),
    [
        ("base dec  no internal events logged", "017 255", 291, b"\x11\xff"),
        ("base dec timestamps absolute  internal events logged", "17 255", 291, b"\x11\xff"),
        ("no internal events logged", "11 FF", 0x291, b"\x11\xff"),
        ("base hex\ntimestamps relative", "11 FF", 0x291, b"\x11\xff"),
    ],
)
def test_forms_of_the_base_line(
    tmp_path: Path, base: str, data: str, can_id: int, content: bytes
) -> None:
    frames, report = read_text(tmp_path, f"{base}\n" + FRAME_291.format(data))
    assert [(f.can_id, f.data) for f in frames] == [(can_id, content)]
    assert (report.time_base == "delta") == ("relative" in base)


def test_canfd_lines_have_the_base_of_the_header(tmp_path: Path) -> None:
    line = "   0.1 CANFD 1 Rx 291 1 0 2 2 017 255 0 0 1000 0 0 0 0 0\n"
    (frame,), _ = read_text(tmp_path, f"base dec  timestamps absolute\n{line}")
    assert (frame.can_id, frame.data, frame.fd) == (291, b"\x11\xff", True)


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("base octal\n" + FRAME_291.format("11 22"), "line 1: 'base octal'; expected base hex"),
        ("date yesterday\nbase hex\n", "line 1: 'date yesterday'; expected one as date Sat"),
        (FRAME_291.format("017 255"), "line 1: its bytes are not hex, .* expected base dec"),
        ("base dec\n" + FRAME_291.format("11 FF"), "line 2: its bytes are not decimal"),
    ],
)
def test_a_header_that_is_not_understood_or_contradicted_is_refused(
    tmp_path: Path, text: str, why: str
) -> None:
    with pytest.raises(InputError, match=why):
        read_text(tmp_path, text)


@pytest.mark.parametrize("lines", [1, 3000])
@pytest.mark.parametrize("suffix", [".asc", ".blf", ".trc"])
def test_joined_logs_are_refused_or_keep_the_date_of_each(
    tmp_path: Path, suffix: str, lines: int
) -> None:
    day_ns, start_ns = 86_400 * 10**9, utc_ns(2024, 3, 1)
    content = b""
    for number in range(2):
        path = tmp_path / f"{number}{suffix}"
        with open_writer(path) as writer:
            for k in range(lines):
                time_ns = start_ns + number * day_ns + k * 1_000_000
                writer.write(LogFrame(time_ns, 0x123, b"\x01", False, channel="1", direction="Rx"))
        content += path.read_bytes()
    whole = tmp_path / f"whole{suffix}"
    whole.write_bytes(content)
    log = open_logs([whole])
    if suffix == ".trc":
        times_ns = [frame.time_ns for frame in log]
        assert times_ns[0] == start_ns and times_ns[lines] == start_ns + day_ns
        assert len(times_ns) == 2 * lines and log.report.clean
    else:
        with pytest.raises(
            InputError, match=r"\d: a second measurement begins; expected a file for"
        ):
            list(log)

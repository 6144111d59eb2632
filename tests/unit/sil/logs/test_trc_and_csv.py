"""TRC and CSV: every version and table, kinds of lines, start times exact to the nanosecond."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from can_dbc.errors import InputError
from sil.logs import LogFrame, open_log, open_writer
from sil.logs.csv_log import OUR_HEADER
from tests.support.golden_logs import log_of

DATA = Path(__file__).resolve().parents[3] / "data" / "logs"
NOON_NS = 1_639_828_800 * 10**9
"""44548.5 days after 1899-12-30: 2021-12-18 12:00."""

PCAN_NS = 1_639_837_687_062_000_960
"""44548.6028595139 days, exactly."""

OFFSET_NS = 17_535_400_000


def tx(time_ns: int, data: str, channel: str = "") -> LogFrame:
    return LogFrame(time_ns, 0x100, bytes.fromhex(data), channel=channel, direction="Tx")


def remote(time_ns: int, channel: str = "", direction: str = "Rx") -> LogFrame:
    return LogFrame(
        time_ns, 0x704, b"", False, remote=True, channel=channel, direction=direction, raw_dlc=1
    )


FD = LogFrame(
    NOON_NS + 17_541_300_000, 0x123, bytes(range(12)), False, fd=True, brs=True, direction="Rx"
)
ERROR = LogFrame(
    NOON_NS + 17_542_300_000, 0, bytes.fromhex("04000200"), False, error=True, direction="Rx"
)
LAST_NS = NOON_NS + 17_700_000_000

VERSIONS = {
    "version_1_0.trc": [
        LogFrame(17_535_000_000, 0x100, bytes.fromhex("0011223344556677")),
        remote(17_700_000_000, direction=""),
        LogFrame(17_710_000_000, 0x123, b"\x01\x02", False),
    ],
    "version_1_1.trc": [
        tx(PCAN_NS + OFFSET_NS, "0011223344556677"),
        LogFrame(PCAN_NS + 17_550_000_000, 8, bytes.fromhex("00190808"), False, error=True),
        remote(PCAN_NS + 17_700_000_000),
    ],
    "version_1_2.trc": [tx(NOON_NS + OFFSET_NS, "0102", "1"), remote(LAST_NS, "2")],
    "version_1_3.trc": [tx(NOON_NS + OFFSET_NS, "0102", "1"), remote(LAST_NS, "2")],
    "version_2_0.trc": [tx(NOON_NS + OFFSET_NS, "0102"), FD, ERROR, remote(LAST_NS)],
    "version_2_1.trc": [
        tx(NOON_NS + OFFSET_NS, "0102", "1"),
        FD._replace(esi=True, channel="1"),
        ERROR._replace(data=bytes.fromhex("0400020000"), channel="1"),
        LogFrame(
            NOON_NS + 17_543_300_000,
            0x123,
            bytes(range(8)),
            False,
            channel="1",
            direction="Rx",
            raw_dlc=12,
        ),
        remote(LAST_NS, "2"),
    ],
}


@pytest.mark.parametrize("name", VERSIONS)
def test_every_version(name: str) -> None:
    reader = open_log(DATA / name)
    assert list(reader) == VERSIONS[name]
    report = reader.report
    assert report.other == ({} if "1_2" in name else {"status line": 1})
    assert report.skipped == (2 if "2_1" in name else 0)
    assert report.start_ns is None or report.start_ns > 10**18 or "1_2" in name


@pytest.mark.parametrize(
    ("header", "expected"),
    [
        (";$FILEVERSION=3.0\n", "TRC version '3.0'; expected one from 1.0 to 2.1"),
        (";$FILEVERSION=2.1\n;$COLUMNS=N,O,T\n", "expected N,O,T,B,I,d,R,L,D"),
    ],
)
def test_unknown_kinds_are_refused(header: str, expected: str, tmp_path: Path) -> None:
    text = header + "      1     17535.400 DT 1  00000100 Tx -  2    01 02\n"
    with pytest.raises(InputError, match=expected):
        list(log_of(tmp_path / "log.trc", text))


@pytest.mark.parametrize(
    "line",
    [
        "1 17535.400 DT 1 00000100 Tx - 2 01",
        "1 17535.400 DT 1 00000100 Tx - 2 01 02 03",
        "1 17535.400 DT 1 00000100 Tx - 2 01 2",
        "1 17535.400 DT 1 GG000100 Tx - 1 01",
        "1 17535.400 DT x 00000100 Tx - 1 01",
        "1 17535.400 DT 1 0800 Tx - 1 01",
        "1 17535.400 DT 1 00000100 Up - 1 01",
        "1 17535.400 DT 1 00000100 Tx - 16 01",
        "1 17535,400 DT 1 00000100 Tx - 1 01",
        "1 17535.400 DT",
        "rubbish",
    ],
)
def test_broken_lines(line: str, tmp_path: Path) -> None:
    sound = ";$FILEVERSION=2.1\n;$STARTTIME=44548.5\n1 17000.000 DT 1 00000100 Tx - 1 01\n"
    reader = log_of(tmp_path / "log.trc", f"{sound}{line}\n")
    assert len(list(reader)) == 1
    assert reader.report.places["skipped"][0].startswith("line 4: ")


common = st.tuples(
    st.integers(0, 10**10),
    st.integers(0, 0x1FFFFFFF),
    st.booleans(),
    st.binary(max_size=8),
    st.sampled_from(("Rx", "Tx")),
)


@pytest.mark.parametrize("version", ["1.1", "2.1"])
@given(rows=st.lists(common, min_size=1, max_size=30), data=st.data())
@settings(max_examples=50, deadline=None)
def test_common_and_other_lines_mixed(
    version: str,
    rows: list[tuple[int, int, bool, bytes, str]],
    data: st.DataObject,
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    """The quick reading of chunks gives what each line gives by itself."""
    bus = "" if version == "1.1" else "3"
    frames = [
        LogFrame(NOON_NS + t * 1000, i if x else i & 0x7FF, d, x, channel=bus, direction=w)
        for t, i, x, d, w in rows
    ]
    lines = []
    for number, (row, f) in enumerate(zip(rows, frames, strict=True), 1):
        digits = f"{f.can_id:08X}" if f.extended else f"{f.can_id:04X}"
        stamp = f"{row[0] // 1000}.{row[0] % 1000:03d}"
        shown = f"{len(f.data)}  {f.data.hex(' ').upper()}"
        if version == "1.1":
            lines.append(f"{number:>6})  {stamp:>9}  {f.direction}  {digits:>8}  {shown} ")
        else:
            lines.append(f"{number:>7} {stamp:>13} DT 3 {digits:>8} {f.direction} -  {shown}")
    for _ in range(data.draw(st.integers(0, 3))):
        index = data.draw(st.integers(0, len(lines)))
        lines.insert(index, data.draw(st.sampled_from(("", ";remark", "rubbish"))))
    path = tmp_path_factory.mktemp("trc") / "log.trc"
    header = f";$FILEVERSION={version}\n;$STARTTIME=44548.5\n"
    path.write_text(header + f";{'x' * 1000}\n" * 40 + "\n".join(lines) + "\n")
    reader = open_log(path)
    assert list(reader) == frames
    assert reader.report.skipped == lines.count("rubbish")


TABLES = {
    "python_can.csv": [
        LogFrame(1_483_389_946_197_000_000, 0xDADADA, b"[42, 9]"),
        LogFrame(1_483_389_946_198_000_000, 0x123, bytes(range(6)), False),
        LogFrame(1_483_389_946_199_000_000, 0x123, b"", False, remote=True, raw_dlc=8),
    ],
    "savvycan.csv": [
        LogFrame(10**9, 0x18FEF100, bytes.fromhex("FFFF7D06FFFFFFFF"), channel="0", direction="Rx"),
        LogFrame(1_000_123_000, 0x123, b"\x01\xa2", False, channel="1", direction="Tx"),
    ],
    "css.csv": [
        LogFrame(
            *(1_578_922_367_777_150_000, 0x14FEF131, bytes.fromhex("CFFFFFF300FFFF30")),
            channel="1",
            direction="Rx",
        ),
        LogFrame(
            *(1_578_922_367_777_750_000, 0x123, bytes(range(12)), False, False, False, True, True),
            channel="1",
            direction="Tx",
        ),
    ],
}


@pytest.mark.parametrize("name", TABLES)
def test_tables_of_other_tools(name: str) -> None:
    assert list(open_log(DATA / name)) == TABLES[name]


def test_savvycan_stamps_since_1970(tmp_path: Path) -> None:
    """SavvyCAN writes microseconds; since 1970 these have 16 digits."""
    header = (DATA / "savvycan.csv").read_text().splitlines()[0]
    row = "1700000000123456,00000123,false,Rx,0,1,1A,"
    reader = log_of(tmp_path / "log.csv", f"{header}\n{row}\n")
    assert [frame.time_ns for frame in reader] == [1_700_000_000_123_456_000]
    assert reader.report.time_base == "absolute"


def test_gvret_table_without_a_direction(tmp_path: Path) -> None:
    assert list(
        log_of(
            tmp_path / "log.csv",
            "Time Stamp,ID,Extended,Bus,LEN,D1,D2,D3,D4,D5,D6,D7,D8\n166064000,0000021A,false,0,2,FE,36,\n",
        )
    ) == [LogFrame(166_064_000_000, 0x21A, b"\xfe\x36", False, channel="0")]


@pytest.mark.parametrize(
    "row",
    [
        "0.1,can0,Rx,123,0,0,0,0,0,0,2,01",
        "0.1,can0,Rx,123,0,0,0,0,0,0,2,010203",
        "0.1,can0,Rx,123,0,0,0,0,0,0,1,0",
        "0.1,can0,Rx,123,0,0,0,0,0,0,1",
        "0.1,can0,Rx,123,2,0,0,0,0,0,1,01",
        "0.1,can0,Rx,XYZ,0,0,0,0,0,0,1,01",
        "0.1,can0,Up,123,0,0,0,0,0,0,1,01",
        "0.1,can0,Rx,123,0,0,0,0,0,0,16,01",
        "0.1,can0,Rx,123,0,0,0,1,0,0,9,01",
        "later,can0,Rx,123,0,0,0,0,0,0,1,01",
        "0.1,ca n,Rx,123,0,0,0,0,0,0,1,01",
    ],
)
def test_broken_rows(row: str, tmp_path: Path) -> None:
    reader = log_of(
        tmp_path / "log.csv", f"{OUR_HEADER}\n0.0,can0,Rx,123,0,0,0,0,0,0,1,01\n{row}\n"
    )
    assert len(list(reader)) == 1
    assert reader.report.places["skipped"][0].startswith("line 3: ")


def test_signals_are_named() -> None:
    with pytest.raises(InputError, match=r"holds signals \(position_m, .*no CAN frames"):
        list(open_log(DATA / "signals.csv"))


def test_an_unknown_header_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"line 1: header 'a,b,c' is unknown"):
        list(log_of(tmp_path / "log.csv", "a,b,c\n1,2,3\n"))


def test_a_comma_in_a_channel_name_is_refused(tmp_path: Path) -> None:
    writer = open_writer(tmp_path / "log.csv")
    with pytest.raises(InputError, match="comma"), writer:
        writer.write(LogFrame(0, 1, b"", channel="a,b"))


@pytest.mark.parametrize(("last", "kept"), [("5,A2", True), ("5,A", False), ("5,", True)])
def test_a_last_savvycan_row_without_end(last: str, kept: bool, tmp_path: Path) -> None:
    count = 2 if last.startswith("5,A") else 1
    header = (DATA / "savvycan.csv").read_text().splitlines()[0]
    sound = "1000000,00000123,false,Tx,1,1,1A,"
    text = f"{header}\n{sound}\n1000123,00000123,false,Tx,1,{count},{last}"
    reader = log_of(tmp_path / "log.csv", text)
    assert len(list(reader)) == 1 + kept
    assert reader.report.truncated is not kept


def test_a_header_of_a_further_part_is_no_broken_line(tmp_path: Path) -> None:
    reader = log_of(tmp_path / "a.csv", (DATA / "savvycan.csv").read_text() * 2)
    assert len(list(reader)) == 2 * len(list(open_log(DATA / "savvycan.csv")))
    assert reader.report.other == {"header of a further part": 1} and not reader.report.skipped

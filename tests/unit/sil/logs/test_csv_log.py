"""CSV logs: our table and those of other tools."""

from __future__ import annotations

from pathlib import Path

import pytest

from can_dbc.errors import InputError
from sil.logs import LogFrame, open_log, open_writer
from sil.logs.csv_log import OUR_HEADER

DATA = Path(__file__).resolve().parents[3] / "data" / "logs"


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
    path = tmp_path / "log.csv"
    text = (DATA / "savvycan.csv").read_text().splitlines()
    path.write_text(f"{text[0]}\n1700000000123456,00000123,false,Rx,0,1,1A,\n")
    reader = open_log(path)
    assert [frame.time_ns for frame in reader] == [1_700_000_000_123_456_000]
    assert reader.report.time_base == "absolute"


def test_gvret_table_without_a_direction(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_text(
        "Time Stamp,ID,Extended,Bus,LEN,D1,D2,D3,D4,D5,D6,D7,D8\n166064000,0000021A,false,0,2,FE,36,\n"
    )
    assert list(open_log(path)) == [
        LogFrame(166_064_000_000, 0x21A, b"\xfe\x36", False, channel="0")
    ]


def test_our_table_is_plain(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    with open_writer(path) as writer:
        writer.write(LogFrame(-1, 0x18FEF100, b"\x01\xff", channel="can0", direction="Rx"))
    assert path.read_text() == (f"{OUR_HEADER}\n-0.000000001,can0,Rx,18FEF100,1,0,0,0,0,0,2,01FF\n")
    assert [frame.time_ns for frame in open_log(path)] == [-1]


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
    path = tmp_path / "log.csv"
    path.write_text(f"{OUR_HEADER}\n0.0,can0,Rx,123,0,0,0,0,0,0,1,01\n{row}\n")
    reader = open_log(path)
    assert len(list(reader)) == 1
    assert reader.report.skipped_locations[0].line == 3


def test_signals_are_named() -> None:
    with pytest.raises(InputError, match=r"holds signals \(position_m, .*no CAN frames"):
        list(open_log(DATA / "signals.csv"))


def test_an_unknown_header_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_text("a,b,c\n1,2,3\n")
    with pytest.raises(InputError, match=r"line 1: header 'a,b,c' is unknown"):
        list(open_log(path))


def test_a_comma_in_a_channel_name_is_refused(tmp_path: Path) -> None:
    writer = open_writer(tmp_path / "log.csv")
    with pytest.raises(InputError, match="comma"), writer:
        writer.write(LogFrame(0, 1, b"", channel="a,b"))


@pytest.mark.parametrize(("last", "kept"), [("5,A2", True), ("5,A", False), ("5,", True)])
def test_a_last_savvycan_row_without_end(last: str, kept: bool, tmp_path: Path) -> None:
    count = 2 if last.startswith("5,A") else 1
    path = tmp_path / "log.csv"
    header = (DATA / "savvycan.csv").read_text().splitlines()[0]
    sound = "1000000,00000123,false,Tx,1,1,1A,"
    path.write_text(f"{header}\n{sound}\n1000123,00000123,false,Tx,1,{count},{last}")
    reader = open_log(path)
    assert len(list(reader)) == 1 + kept
    assert reader.report.truncated is not kept


def test_a_header_of_a_further_part_is_no_broken_line(tmp_path: Path) -> None:
    text = (DATA / "savvycan.csv").read_text()
    (tmp_path / "a.csv").write_text(text + text)
    reader = open_log(tmp_path / "a.csv")
    assert len(list(reader)) == 2 * len(list(open_log(DATA / "savvycan.csv")))
    assert reader.report.other == {"header of a further part": 1} and not reader.report.skipped

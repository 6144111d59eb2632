"""Signals of a log by a DBC, into CSV, MF4 and parquet."""

from __future__ import annotations

import csv
import importlib
import sys
from pathlib import Path
from typing import Any

import pytest

from can_dbc.errors import InputError
from sil.j1939.decode import decode
from sil.j1939.transport import broadcast
from sil.logs import LogFrame, open_writer

START_NS = 1_600_000_000 * 10**9
DBC = """\
VERSION ""
BU_: A
BO_ 2364540158 EEC1: 8 A
 SG_ EngineSpeed : 24|16@1+ (0.125,0) [0|8031.875] "rpm" A
 SG_ Torque : 16|8@1+ (1,-125) [-125|125] "%" A
BO_ 2566838526 Long: 12 A
 SG_ Last : 88|8@1+ (1,0) [0|255] "" A
BO_ 291 Plain: 2 A
 SG_ Mode : 0|8@1+ (1,0) [0|255] "" A
 SG_ Value : 8|8@1- (0.5,0) [-64|63.5] "V" A
VAL_ 291 Mode 0 "off, idle" 1 "on" ;
BA_DEF_ BO_ "VFrameFormat" ENUM "StandardCAN","ExtendedCAN","reserved","J1939PG";
BA_DEF_DEF_ "VFrameFormat" "StandardCAN";
BA_ "VFrameFormat" BO_ 2364540158 3;
"""


def eec1(source: int, rpm: float, torque: int = 125) -> tuple[int, bytes]:
    raw = round(8 * rpm).to_bytes(2, "little")
    return 0x0CF00400 | source, bytes((0xFF, 0xFF, torque)) + raw + b"\xff" * 3


@pytest.fixture
def log(tmp_path: Path) -> Path:
    (tmp_path / "truck.dbc").write_text(DBC)
    frames = [
        LogFrame(0, *eec1(0x00, 700.0, 135)),
        LogFrame(0, *eec1(0x0F, 1500.0)),
        LogFrame(0, 0x0CF00400, b"\xff" * 8),
        LogFrame(0, 0x123, bytes((0, 0xFE)), False),
        LogFrame(0, 0x123, bytes((1, 0x02)), False),
        LogFrame(0, 0x124, b"", False),
        LogFrame(0, 0x18FEF100, bytes(8)),
        *(LogFrame(0, frame.can_id, frame.data) for frame in broadcast(65240, 3, bytes(range(12)))),
        LogFrame(0, *eec1(0x00, 710.0, 140)),
    ]
    with open_writer(tmp_path / "a.log") as writer:
        for n, frame in enumerate(frames):
            writer.write(frame._replace(time_ns=START_NS + n * 10_000_000, channel="can0"))
    return tmp_path / "a.log"


def test_a_row_for_each_value(log: Path) -> None:
    report = decode([log], log.with_name("s.csv"), log.with_name("truck.dbc"))
    with log.with_name("s.csv").open() as file:
        rows = list(csv.DictReader(file))
    found = [(r["message"], r["source"], r["signal"], float(r["value"]), r["text"]) for r in rows]
    assert found == [
        ("EEC1", "0", "Torque", 10.0, ""),
        ("EEC1", "0", "EngineSpeed", 700.0, ""),
        ("EEC1", "15", "Torque", 0.0, ""),
        ("EEC1", "15", "EngineSpeed", 1500.0, ""),
        ("Plain", "", "Mode", 0.0, "off, idle"),
        ("Plain", "", "Value", -1.0, ""),
        ("Plain", "", "Mode", 1.0, "on"),
        ("Plain", "", "Value", 1.0, ""),
        ("Long", "3", "Last", 11.0, ""),
        ("EEC1", "0", "Torque", 15.0, ""),
        ("EEC1", "0", "EngineSpeed", 710.0, ""),
    ]
    assert rows[0]["time_s"] == "1600000000.000000000"
    assert rows[-1]["time_s"] == "1600000000.100000000"
    assert rows[1]["unit"] == "rpm"
    assert report.unknown == {"124": 1, "18FEF100": 1}
    text = "\n".join(report.lines())
    assert "2 frames of 2 identifiers: 124 (1), 18FEF100 (1)" in text
    assert "1 message of the transport protocol put together" in text


def test_the_same_values_in_mf4(log: Path) -> None:
    asammdf = importlib.import_module("asammdf")
    decode([log], log.with_name("s.mf4"), log.with_name("truck.dbc"))
    with asammdf.MDF(log.with_name("s.mf4")) as mdf:
        names = [group.channel_group.acq_name for group in mdf.groups]
        assert names == [
            "EEC1 of 0x00 on can0",
            "EEC1 of 0x0f on can0",
            "Plain on can0",
            "Long of 0x03 on can0",
        ]
        speed = mdf.get("EngineSpeed", group=0)
        assert (
            speed.samples.tolist()[::2] == [700.0, 710.0] and speed.samples[1] != speed.samples[1]
        )
        assert speed.timestamps.tolist() == [0.0, 0.02, 0.1]
        assert speed.unit == "rpm"


def test_parquet_without_its_library_is_one_line(log: Path, monkeypatch: Any) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(InputError, match="needs pyarrow, which is not installed") as refused:
        decode([log], log.with_name("s.parquet"), log.with_name("truck.dbc"))
    assert "\n" not in str(refused.value)
    assert not log.with_name("s.parquet").exists()


def test_parquet_holds_the_same_rows(log: Path) -> None:
    parquet = importlib.import_module("pyarrow.parquet")
    decode([log], log.with_name("s.parquet"), log.with_name("truck.dbc"))
    rows = parquet.read_table(log.with_name("s.parquet")).to_pylist()
    assert [row["value"] for row in rows][:3] == [10.0, 700.0, 0.0]


def test_what_cannot_be_decoded_is_refused_or_counted(log: Path) -> None:
    dbc = log.with_name("truck.dbc")
    with pytest.raises(InputError, match=r"expected OUT \.csv, \.csv\.gz, \.mf4 or \.parquet"):
        decode([log], log.with_name("s.asc"), dbc)
    dbc.write_text(DBC.split("BO_ 2364540158")[0] + "BO_ 5 Other: 8 A\n")
    with pytest.raises(InputError, match="none of its 11 frames is of a message in"):
        decode([log], log.with_name("s.csv"), dbc)
    assert not log.with_name("s.csv").exists()


ODD = """\
VERSION ""
BU_: A
BO_ 291 Over: 2 A
 SG_ X : 0|8@1+ (1,0) [0|255] "" A
 SG_ Y : 4|8@1+ (1,0) [0|255] "" A
BO_ 292 Out: 2 A
 SG_ X : 0|8@1+ (1,0) [0|255] "" A
 SG_ Z : 12|8@1+ (1,0) [0|255] "" A
BO_ 293 Twice: 2 A
 SG_ X : 0|8@1+ (1,0) [0|255] "" A
 SG_ X : 8|8@1+ (1,0) [0|255] "" A
BO_ 294 Big: 8 A
 SG_ N : 0|64@1+ (1,0) [0|1] "" A
BO_ 2566844926 Flags: 2 A
 SG_ One : 0|1@1+ (1,0) [0|1] "" A
 SG_ Two : 1|2@1+ (1,0) [0|3] "" A
 SG_ Three : 3|3@1+ (1,0) [0|7] "" A
 SG_ Named : 6|2@1+ (1,0) [0|3] "" A
 SG_ Byte : 8|8@1+ (1,0) [0|250] "" A
VAL_ 2566844926 Named 3 "locked" ;
"""


def test_a_database_that_contradicts_itself_is_decoded_as_far_as_it_goes(tmp_path: Path) -> None:
    (tmp_path / "odd.dbc").write_text(ODD)
    frames = [(0x123, b"\x12\x34"), (0x124, b"\x12\x34"), (0x125, b"\x12\x34")]
    frames += [(0x126, (2**63 + 1).to_bytes(8, "little")), (0x123, b"\x12")]
    with open_writer(tmp_path / "a.log") as writer:
        for n, (can_id, data) in enumerate(frames):
            writer.write(LogFrame(n, can_id, data, False))
        writer.write(LogFrame(9, 0x18FF0F00 | 0x03, b"\xff\xff"))
    (tmp_path / "odd.dbc").write_text(ODD.replace("2566844926", str(0x98FF0FFE)))
    report = decode([tmp_path / "a.log"], tmp_path / "s.csv", tmp_path / "odd.dbc")
    with (tmp_path / "s.csv").open() as file:
        rows = [(r["message"], r["signal"], r["value"], r["text"]) for r in csv.DictReader(file)]
    assert rows == [
        ("Over", "X", "18", ""),
        ("Over", "Y", "65", ""),
        ("Out", "X", "18", ""),
        ("Twice", "X", "18", ""),
        ("Twice", "X (bit 8)", "52", ""),
        ("Big", "N", str(2**63 + 1), ""),
        ("Over", "X", "18", ""),
        ("Flags", "One", "1", ""),
        ("Flags", "Three", "7", ""),
        ("Flags", "Named", "3", "locked"),
    ]
    text = "\n".join(report.lines())
    assert "signal Z of Out is not decoded: it leaves the message's 2 bytes" in text
    assert "a second signal X of Twice: as 'X (bit 8)'" in text
    assert "too short: 1 Over of 1 bytes in place of 2" in text
    assert "not available, left out: 2 values: Flags.Two (1), Flags.Byte (1)" in text

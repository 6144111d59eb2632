"""Tables of any dialect are read alike; what is no table is named."""

from __future__ import annotations

import importlib
from pathlib import Path

import numpy as np
import pytest

from can_dbc.errors import InputError
from sil.campaign.campaign import ColumnMap, read_record
from sil.campaign.tables import formula

TIME = np.arange(40) / 1000.0
POSITION = 0.01 * np.sin(50.0 * TIME)
MAPS = {
    "time_s": ColumnMap("t [ms]", 1e-3),
    "position_m": ColumnMap("x [mm]", 1e-3),
}


def text(delimiter: str, comma: bool, header: str) -> str:
    rows = [f"{1e3 * t:.3f}{delimiter}{1e3 * x:.6f}" for t, x in zip(TIME, POSITION, strict=True)]
    body = "\n".join(rows)
    return header + (body.replace(".", ",") if comma else body) + "\n"


@pytest.mark.parametrize(
    ("content", "dialect"),
    [
        (text(";", True, "t [ms];x [mm]\n"), "semicolon-separated, decimal comma"),
        (text("\t", False, "t [ms]\tx [mm]\n"), "tab-separated"),
        (text(",", False, '"t [ms]","x [mm]"\n'), "quoted header"),
        ("﻿" + text(",", False, "t [ms],x [mm]\n"), "UTF-8 with byte order mark"),
        (text(";", True, "Prüfstand 3\n\nt;x\n[ms];[mm]\n"), "units in a row of their own"),
        (
            text("  ", False, "# t[ms]   x[mm]\n").replace("t[ms]", "t").replace("x[mm]", "x"),
            "blank-separated",
        ),
    ],
)
def test_dialects_are_found_and_stated(tmp_path: Path, content: str, dialect: str) -> None:
    file = tmp_path / "a.txt"
    file.write_text(content, encoding="utf-8")
    maps = MAPS
    if "blank" in dialect:
        maps = {k: ColumnMap(v.column[0], v.scale) for k, v in MAPS.items()}
    record = read_record(file, maps)
    assert dialect in record.dialect
    assert record.time_s == pytest.approx(TIME)
    assert record["position_m"] == pytest.approx(POSITION, abs=1e-9)


def test_a_table_without_header_has_numbered_columns(tmp_path: Path) -> None:
    file = tmp_path / "a.csv"
    file.write_text(text("\t", False, ""), encoding="utf-8")
    record = read_record(file, {"time_s": ColumnMap("column_1", 1e-3)})
    assert record["column_2"] == pytest.approx(1e3 * POSITION, abs=1e-6)
    assert "no header row" in record.dialect


def test_a_slower_channel_is_interpolated_and_a_hole_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "a.csv"
    rows = [f"{t:.3f},{2.0 * t if k % 3 == 0 else ''}" for k, t in enumerate(TIME)]
    file.write_text("time_s,f\n" + "\n".join(rows) + "\n", encoding="utf-8")
    record = read_record(file)
    assert "1 columns of a slower rate" in record.dialect
    assert record["f"][:-1] == pytest.approx(2.0 * TIME[:-1])
    rows = [f"{t:.3f},{'' if k == 7 else t}" for k, t in enumerate(TIME)]
    file.write_text("time_s,f\n" + "\n".join(rows) + "\n", encoding="utf-8")
    with pytest.raises(InputError, match="line 9: '' is not a number"):
        read_record(file)


def test_columns_are_computed_from_others(tmp_path: Path) -> None:
    file = tmp_path / "a.csv"
    np.savetxt(
        file,
        np.column_stack([TIME, POSITION, 3.0 * POSITION]),
        header="t,p 1,q",
        comments="",
        delimiter=",",
    )
    record = read_record(
        file, {"time_s": ColumnMap("row / 1000"), "f": ColumnMap("-('p 1' - q) * 2 ** 2")}
    )
    assert record["f"] == pytest.approx(8.0 * POSITION) and record.time_s == pytest.approx(TIME)
    with pytest.raises(InputError, match="no column 't - y'"):
        read_record(file, {"time_s": ColumnMap("t - y")})
    with pytest.raises(ValueError, match="open"):
        formula("open('a')", {"a": TIME})


def test_a_stated_delay_is_taken_off(tmp_path: Path) -> None:
    file = tmp_path / "a.csv"
    np.savetxt(file, np.column_stack([TIME, TIME]), header="time_s,f", comments="", delimiter=",")
    record = read_record(file, {"f": ColumnMap("f", delay_s=0.01)})
    assert record["f"][:25] == pytest.approx(TIME[:25] + 0.01)


def test_matlab_files_are_read(tmp_path: Path) -> None:
    from scipy.io import savemat

    file = tmp_path / "a.mat"
    savemat(file, {"s": {"t": TIME, "x": POSITION}, "gain": 3.0, "note": "text"})
    record = read_record(file, {"time_s": ColumnMap("s.t"), "f": ColumnMap("'s.x' * gain")})
    assert record.dialect == "MAT" and record["f"] == pytest.approx(3.0 * POSITION)
    file.write_bytes(b"no such thing")
    with pytest.raises(InputError, match=r"a\.mat: not a MAT file|a\.mat: cannot be read"):
        read_record(file)


def test_hdf5_parquet_and_tdms_are_read_with_the_extra(tmp_path: Path) -> None:
    h5py = importlib.import_module("h5py")
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["t"], file["x"] = TIME, POSITION
    parquet, arrow = importlib.import_module("pyarrow.parquet"), importlib.import_module("pyarrow")
    parquet.write_table(arrow.table({"t": TIME, "x": POSITION}), tmp_path / "a.parquet")
    nptdms = importlib.import_module("nptdms")
    with nptdms.TdmsWriter(tmp_path / "a.tdms") as writer:
        writer.write_segment(
            [nptdms.ChannelObject("g", n, v) for n, v in (("t", TIME), ("x", POSITION))]
        )
    for suffix in ("h5", "parquet", "tdms"):
        record = read_record(tmp_path / f"a.{suffix}", {"time_s": ColumnMap("t")})
        assert record["x"] == pytest.approx(POSITION)


def test_a_missing_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "nptdms", None)
    with pytest.raises(InputError, match=r"a\.tdms: TDMS needs nptdms.*lab"):
        read_record(tmp_path / "a.tdms")


def test_mf4_channels_of_several_rates(tmp_path: Path) -> None:
    asammdf = importlib.import_module("asammdf")
    file = tmp_path / "a.mf4"
    with asammdf.MDF() as measured:
        measured.append([asammdf.Signal(POSITION, TIME, name="x")])
        measured.append([asammdf.Signal(TIME[::4], TIME[::4], name="f")])
        measured.save(file)
    record = read_record(file)
    assert record["f"][:36] == pytest.approx(TIME[:36]) and "f" in record.dialect
    assert record["x"] == pytest.approx(POSITION)

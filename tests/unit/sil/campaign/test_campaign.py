"""Campaigns: tables read and the shots run."""

from __future__ import annotations

import csv
import importlib
import tomllib
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from can_dbc.errors import InputError
from plant.parameters import load
from sil.campaign.binary_tables import Channels
from sil.campaign.campaign import ColumnMap, Record, Recorder, campaign_toml, load_campaign
from sil.campaign.campaign import read_record as read_as
from sil.campaign.formula import formula
from sil.campaign.simulate import simulate_campaign, write_campaign
from sil.campaign.tables import Decimal, read_columns
from sil.cli import main

Capture = pytest.CaptureFixture[str]

TEXT = """
name = "one"
rig = "fixed"
atmosphere_pa = 101325.0
temperature_k = 293.15
sample_rate_hz = 10000.0

[[stroke]]
file = "stroke_001.csv"
kind = "fixed"
supply_pressure_pa = 900000.0
commands = [[0.01, "1", 0.98]]
"""


def written(folder: Path, more: str = "") -> Path:
    folder.mkdir()
    (folder / "campaign.toml").write_text(TEXT + more, encoding="utf-8")
    return folder


def test_the_theoretical_flow_can_be_chosen_and_is_kept(tmp_path: Path) -> None:
    mapped = load_campaign(str(written(tmp_path / "mapped")))
    chosen = load_campaign(str(written(tmp_path / "chosen", 'flow_model = "theoretical"\n')))
    strokes = [next(iter(simulate_campaign(campaign, load()))) for campaign in (mapped, chosen)]
    arrivals = [stroke.arrival_s for stroke in strokes]
    assert arrivals[1] - arrivals[0] == pytest.approx(1.26e-3, rel=0.1)
    again = tmp_path / "again"
    again.mkdir()
    (again / "campaign.toml").write_text(campaign_toml(chosen, chosen.strokes), encoding="utf-8")
    assert load_campaign(str(again)).strokes[0].conditions.theoretical_flow
    assert not mapped.strokes[0].conditions.theoretical_flow
    odd = replace(strokes[0], entry=replace(strokes[0].entry, file='a"b\\c.csv'))
    write_campaign(mapped, [odd], again, lambda _: None)
    reference = tomllib.loads((again / "reference.toml").read_text(encoding="utf-8"))
    assert [entry["file"] for entry in reference["stroke"]] == ['a"b\\c.csv']
    assert load_campaign(str(again)).strokes[0].file == 'a"b\\c.csv'


def test_an_unknown_flow_model_is_refused(tmp_path: Path) -> None:
    folder = written(tmp_path / "wrong", 'flow_model = "guessed"\n')
    with pytest.raises(
        InputError, match=r"stroke\[0\].flow_model: 'guessed' is unknown; expected one of"
    ):
        load_campaign(str(folder))


@pytest.mark.parametrize("name", ["../stroke.csv", "a/b.csv", "stroke\\u0000.csv", "stroke\\n.csv"])
def test_a_file_that_is_no_plain_name_is_refused(tmp_path: Path, name: str) -> None:
    folder = tmp_path / "wrong"
    folder.mkdir()
    (folder / "campaign.toml").write_text(TEXT.replace("stroke_001.csv", name), encoding="utf-8")
    with pytest.raises(InputError, match="expected the name of a file next to"):
        load_campaign(str(folder))


def test_a_file_of_two_strokes_is_refused(tmp_path: Path) -> None:
    folder = written(tmp_path / "twice", TEXT[TEXT.index("[[stroke]]") :])
    with pytest.raises(InputError, match=r"stroke\[1\]\.file: 'stroke_001.csv' twice"):
        load_campaign(str(folder))


def test_a_scale_of_zero_is_refused(tmp_path: Path) -> None:
    folder = written(tmp_path / "flat", '[columns]\nposition_m = { column = "x", scale = 0 }\n')
    with pytest.raises(InputError, match=r"columns.position_m.scale: 0 makes every value the same"):
        load_campaign(str(folder))


@pytest.mark.parametrize(
    ("record", "wrong"),
    [
        ("time_s,position_m\n0.0,0.0\n0.0,0.0\n", "line 3: time_s does not increase; expected"),
        ("time_s,x,x\n0.0,0.0,1.0\n0.1,0.0,1.0\n", "line 1: column 'x' twice; expected each name"),
        (
            "time,position_m\n0.0,0.0\n0.1,0.0\n",
            "no column time_s among time, position_m; expected",
        ),
        ("", "line 1: empty; expected a header row"),
        (None, "is a folder; expected a table with a header row"),
    ],
)
@pytest.mark.parametrize("command", [["simulate"], ["diagnose"], ["identify", "flow"]])
def test_a_wrong_record_is_one_line_and_leaves_no_output(
    command: list[str], record: str | None, wrong: str, tmp_path: Path, capsys: Capture
) -> None:
    folder = written(tmp_path / "campaign", TEXT[TEXT.index("[[stroke]]") :].replace("001", "002"))
    (folder / "stroke_001.csv").write_text("time_s,position_m\n0.0,0.0\n0.1,0.0\n")
    file = folder / "stroke_002.csv"
    file.mkdir() if record is None else file.write_text(record)
    out = tmp_path / "out"
    assert main([*command, str(folder), "--out", str(out), "--quiet"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"opc4 {command[0]}: {file}: {wrong}") and not out.exists()


def test_a_campaign_is_not_replaced_by_its_simulation(tmp_path: Path, capsys: Capture) -> None:
    folder = written(tmp_path / "campaign")
    (folder / "stroke_001.csv").write_text("time_s,position_m\n0.0,0.0\n0.1,0.0\n")
    assert main(["simulate", str(folder), "--out", str(folder / "."), "--force"]) == 2
    what = "--out: is the campaign that is simulated; expected another folder"
    assert capsys.readouterr().err == f"opc4 simulate: {folder}: {what}\n"
    assert (folder / "stroke_001.csv").exists()


def test_options_of_a_truck_log_are_refused_for_a_campaign(tmp_path: Path, capsys: Capture) -> None:
    folder = written(tmp_path / "campaign")
    for option in ("--map", "--dbc"):
        assert main(["diagnose", str(folder), option, "x"]) == 2
        what = "not together with a campaign; expected CAN logs"
        assert capsys.readouterr().err == f"opc4 diagnose: {option}: {what}\n"
    (folder / "campaign.toml").write_text(TEXT.replace('"fixed"', '"force"'), encoding="utf-8")
    assert main(["diagnose", str(folder), "--model", "truck_40ms"]) == 2
    what = '--model: not together with rig = "force"; expected none'
    assert capsys.readouterr().err == f"opc4 diagnose: {what}\n"


TIME = np.arange(40) / 1000.0
POSITION = 0.01 * np.sin(50.0 * TIME)
MAPS = {"time_s": ColumnMap("t [ms]", 1e-3), "position_m": ColumnMap("x [mm]", 1e-3)}


def read_record(file: Path, columns: dict[str, ColumnMap] | None = None) -> Record:
    return read_as(file, Recorder(columns or {}))


def record_of(folder: Path, content: str, columns: dict[str, ColumnMap] | None = None) -> Record:
    (folder / "a.csv").write_text(content, encoding="utf-8")
    return read_record(folder / "a.csv", columns)


def text(delimiter: str, comma: bool, header: str, after: str = "", quote: str = "") -> str:
    rows = []
    for t, x in zip(TIME, POSITION, strict=True):
        cells = [f"{1e3 * t:.3f}", f"{1e3 * x:.6f}"]
        cells = [cell.replace(".", ",") for cell in cells] if comma else cells
        rows.append(delimiter.join(f"{quote}{cell}{quote}" for cell in cells) + after)
    return header + "\n".join(rows) + "\n"


@pytest.mark.parametrize(
    ("content", "dialect"),
    [
        (text(";", True, "t [ms];x [mm]\n"), "semicolon-separated, decimal comma"),
        (text("\t", False, "t [ms]\tx [mm]\n"), "tab-separated"),
        (text(",", False, '"t [ms]","x [mm]"\n'), "quoted header"),
        ("﻿" + text(",", False, "t [ms],x [mm]\n"), "UTF-8 with byte order mark"),
        (text(",", False, "t [ms],x [mm],\n", ","), "left out: without a name"),
        (text(";", True, "t [ms];x [mm];state\n", ";on"), "left out: state"),
        (text(",", False, "Bench 3, run 5\nt,x\nms,mm\n"), "1 line above the header"),
        (text(",", True, "t [ms],x [mm]\n", quote='"'), "decimal comma"),
        (text(";", True, "t [ms];x [mm]\n").replace("0,000;0,000000", "0;0"), "decimal comma"),
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
    record = record_of(tmp_path, text("\t", False, ""), {"time_s": ColumnMap("column_1", 1e-3)})
    assert record["column_2"] == pytest.approx(1e3 * POSITION, abs=1e-6)
    assert "no header row" in record.dialect


def test_time_stamps_are_seconds_and_dots_between_thousands_are_none(tmp_path: Path) -> None:
    rows = [f"2024-03-01 12:00:0{t:.3f};-1.234.5{k:02d},25" for k, t in enumerate(TIME)]
    rows = [f"{row};{k}" for k, row in enumerate(rows)]
    record = record_of(tmp_path, "time_s;f;row\n" + "\n".join(rows) + "\n")
    assert "time_s in seconds from 2024-03-01 12:00:00.000" in record.dialect
    assert record.time_s == pytest.approx(TIME)
    assert record["f"] == pytest.approx(-1234500.25 - np.arange(40.0))


def test_a_slower_channel_is_interpolated_and_a_hole_is_refused(tmp_path: Path) -> None:
    rows = [f"{t:.3f},{2.0 * t if k % 3 == 0 else ''}" for k, t in enumerate(TIME)]
    record = record_of(tmp_path, "time_s,f\n" + "\n".join(rows) + "\n")
    assert "f interpolated from a slower rate" in record.dialect
    assert record["f"][:-1] == pytest.approx(2.0 * TIME[:-1])
    rows = [f"{t:.3f},{'' if k == 7 else t}" for k, t in enumerate(TIME)]
    with pytest.raises(InputError, match="line 9: '' is not a number"):
        record_of(tmp_path, "time_s,f\n" + "\n".join(rows) + "\n")


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
    assert record["f"] == pytest.approx(TIME[:30] + 0.01)  # what lies beyond is left out
    assert record.time_s == pytest.approx(TIME[:30])
    with pytest.raises(InputError, match=r"delay_s: longer than the record of 0\.039 s"):
        read_record(file, {"f": ColumnMap("f", delay_s=0.04)})


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("f / (f - f)", r"f: sample 1: (-?nan|inf); expected a number below 1e30"),
        ("f * 1e35", "f: sample 2: 1e[+]32; expected"),
        ("1 / 0", "no column '1 / 0'"),
        ("9 ** 9 ** 9 ** 9", "no column '9"),
    ],
)
def test_formulas_without_a_finite_result_are_refused(tmp_path: Path, text: str, why: str) -> None:
    file = tmp_path / "a.csv"
    np.savetxt(file, np.column_stack([TIME, TIME]), header="time_s,f", comments="", delimiter=",")
    with pytest.raises(InputError, match=why):
        read_record(file, {"f": ColumnMap(text)})


def test_matlab_files_are_read(tmp_path: Path) -> None:
    from scipy.io import savemat

    file = tmp_path / "a.mat"
    savemat(file, {"s": {"t": TIME, "x": POSITION}, "gain": 3.0, "note": "text"})
    record = read_record(file, {"time_s": ColumnMap("s.t"), "f": ColumnMap("'s.x' * gain")})
    assert record.dialect == "MAT, left out: note" and record["f"] == pytest.approx(3.0 * POSITION)
    file.write_bytes(b"no such thing")
    with pytest.raises(
        InputError, match=r"a\.mat: .*; expected a MAT file|a\.mat: .*; expected a whole MAT"
    ):
        read_record(file)


def test_hdf5_parquet_and_tdms_are_read_with_the_extra(tmp_path: Path) -> None:
    h5py = importlib.import_module("h5py")
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["bench/t"], file["bench/x"] = TIME, 1e3 * POSITION
        file["bench/x"].attrs["unit"] = "mm"
        file["bench/t"].attrs["unit"] = np.array([1.0, 2.0])  # no text
        file["position_m"], file["position_m"].attrs["units"] = POSITION, np.bytes_(b"m")
    parquet, arrow = importlib.import_module("pyarrow.parquet"), importlib.import_module("pyarrow")
    dates = np.datetime64("2024-03-01") + (1e6 * TIME).round().astype("timedelta64[us]")
    parquet.write_table(arrow.table({"t": dates, "x": POSITION}), tmp_path / "a.parquet")
    nptdms = importlib.import_module("nptdms")
    with nptdms.TdmsWriter(tmp_path / "a.tdms") as writer:
        writer.write_segment(
            [
                nptdms.ChannelObject("g", "t", TIME),
                nptdms.ChannelObject("g", "x", 1e3 * POSITION, {"unit_string": "mm"}),
            ]
        )
    for suffix, prefix, unit in (
        ("h5", "bench/", " [mm]"),
        ("parquet", "", ""),
        ("tdms", "", " [mm]"),
    ):
        maps = {"time_s": ColumnMap(f"{prefix}t"), "position_m": ColumnMap(f"{prefix}x{unit}")}
        maps["bare"] = ColumnMap(f"{prefix}x")
        record = read_record(tmp_path / f"a.{suffix}", maps)
        assert record.time_s == pytest.approx(TIME)
        assert record["position_m"] * (1e-3 if unit else 1.0) == pytest.approx(POSITION)
        assert np.array_equal(record["bare"], record["position_m"])
    record = read_record(tmp_path / "a.h5", {"time_s": ColumnMap("bench/t")})
    assert record["position_m"] == pytest.approx(POSITION)


@pytest.mark.parametrize("fill", [np.nan, 1e36, np.inf])
def test_only_columns_in_use_must_be_finite(tmp_path: Path, fill: float) -> None:
    from scipy.io import savemat

    file = tmp_path / "a.mat"
    holed = np.where(np.arange(40) == 6, fill, TIME)
    savemat(file, {"time_s": TIME, "x": POSITION, "spare": holed})
    record = read_record(file)
    assert "spare" not in record and "not finite left out: spare" in record.dialect
    assert record["x"] == pytest.approx(POSITION)
    with pytest.raises(InputError, match=r"spare: sample 7: (nan|inf|1e\+36); expected"):
        read_record(file, {"f": ColumnMap("spare", 1e-9)})
    savemat(file, {"time_s": TIME, "force_n": holed})
    with pytest.raises(InputError, match="force_n: sample 7"):
        read_record(file)
    savemat(file, {"time_s": holed, "x": POSITION})
    with pytest.raises(InputError, match="time_s: sample 7"):
        read_record(file)


def test_a_missing_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "nptdms", None)
    (tmp_path / "a.tdms").touch()
    with pytest.raises(InputError, match=r"a\.tdms: TDMS needs nptdms.*lab"):
        read_record(tmp_path / "a.tdms")


def test_mf4_channels_of_several_rates(tmp_path: Path) -> None:
    asammdf = importlib.import_module("asammdf")
    file = tmp_path / "a.mf4"
    with asammdf.MDF() as measured:
        measured.append([asammdf.Signal(POSITION, TIME, name="x", unit="m")])
        measured.append([asammdf.Signal(TIME[::4], TIME[::4], name="f")])
        measured.save(file)
    record = read_record(file)
    assert record["f"][:36] == pytest.approx(TIME[:36]) and "f" in record.dialect
    assert record["x"] == pytest.approx(POSITION)


@pytest.mark.parametrize(
    ("content", "left_out"),
    [
        ("t;x;event\n0.0;1.0;start\n0.1;1.1;go\n0.2;1.2;\n0.3;1.3;\n0.4;1.4;end\n", "event"),
        ("t;x;state\n" + "".join(f"0.{k};1;ok, fine\n" for k in range(5)), "state"),
        ("t,x,note\n" + "".join(f'0.{k},1,"a, b"\n' for k in range(5)), "note"),
        ('t,x,note\n0.0,1,a\n0.1,1,b\n0.2,1,c\n0.3,1,"a, b"\n0.4,1,\n', "note"),
        ("t,x,month\n" + "".join(f"0.{k},1,2024-0{k + 1}\n" for k in range(5)), "month"),
        ("t,x,day\n" + "".join(f"0.{k},1,2024-01-0{k + 1}\n" for k in range(5)), "day"),
    ],
)
def test_columns_with_text_take_no_rows_from_the_others(
    tmp_path: Path, content: str, left_out: str
) -> None:
    record = record_of(tmp_path, content, {"time_s": ColumnMap("t")})
    assert set(record.columns) == {"t", "x", "time_s"} and f"left out: {left_out}" in record.dialect
    assert record.time_s == pytest.approx(0.1 * np.arange(5))


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("zone", ["", "Z", "+01:00"])
def test_stamps_with_a_time_zone_are_read_without_a_warning(tmp_path: Path, zone: str) -> None:
    rows = [f"2024-01-01T00:00:0{k}{zone},{k},1\n" for k in range(5)]
    assert record_of(tmp_path, "time_s,x,y\n" + "".join(rows)).time_s == pytest.approx(
        np.arange(5.0)
    )


def test_blank_lines_are_no_samples(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="1 sample; expected at least 2"):
        record_of(tmp_path, "time_s,x\n0,1\n\n\n")


def test_lines_without_a_quote_are_not_parsed_as_quoted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    parsed: list[str] = []

    def reader(lines: list[str], **how: object) -> Iterator[list[str]]:
        parsed.extend(lines)
        return iter([lines[0].replace('"', "").split(",")])

    file = tmp_path / "a.csv"
    file.write_text(text(",", False, '"t [ms]","x [mm]"\n'), encoding="utf-8")
    monkeypatch.setattr(csv, "reader", reader)
    assert len(read_record(file, MAPS)) == 40
    assert parsed and set(parsed) == {'"t [ms]","x [mm]"'}


def test_a_stored_unit_that_is_not_si_needs_its_scale(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for name, unit in (("time_s", "s"), ("position_m", "mm")):
            file[name] = np.arange(5.0)
            file[name].attrs["unit"] = unit
    with pytest.raises(InputError, match="position_m: stored in mm; expected SI, or its scale"):
        read_record(tmp_path / "a.h5")
    scaled = {"position_m": ColumnMap(column="position_m", scale=1e-3)}
    assert read_record(tmp_path / "a.h5", scaled).columns["position_m"][-1] == 4e-3


def test_channels_of_one_name_and_other_units_are_both_there() -> None:
    channels = Channels()
    for unit in ("mm", "V", ""):
        channels.add("x", np.arange(3.0), unit=unit)
    assert list(channels.values) == ["x", "x [V]", "x [no unit]"]
    assert channels.units == {"x": "mm", "x [V]": "V"}
    channels.add("x", np.arange(3.0), unit="mm")  # of another group
    channels.add("text", np.array(["a"]))
    assert list(channels.values)[-1] == "x (2)"
    assert channels.table(Path("a.tdms"))[1] == "left out: text"


@pytest.mark.parametrize("odd", ["", "2024-01-01 12:00:01+01:00"])
def test_one_wrong_stamp_is_named_with_its_line(tmp_path: Path, odd: str) -> None:
    stamps = ["2024-01-01 12:00:00", odd, "2024-01-01 12:00:02"]
    text = "t,x\n" + "".join(f"{stamp},{k}\n" for k, stamp in enumerate(stamps))
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(InputError, match="line 3: "):
        read_record(tmp_path / "a.csv", {"time_s": ColumnMap(column="t")})


KRAFT = "Zeit [ms];Kraft [N]\n0;1.230\n1;{}\n2;1.232\n"


def test_the_decimal_sign_is_decided_once_for_a_file(tmp_path: Path) -> None:
    file = tmp_path / "a.csv"
    file.write_text(KRAFT.format("1.231,5"))
    columns, dialect, _ = read_columns(file)
    assert columns["Kraft [N]"].tolist() == [1230.0, 1231.5, 1232.0] and "decimal comma" in dialect
    file.write_text(KRAFT.format("0.5"))
    assert read_columns(file)[0]["Kraft [N]"].tolist() == [1.23, 0.5, 1.232]


@pytest.mark.parametrize(
    ("cell", "decimal", "why"),
    [
        ("1.231", None, "line 2: '1.230' may be 1.23 or 1230, and no number .* tells which"),
        ("0,5", ".", r"line 3: '0,5' has another decimal sign than decimal = '.'"),
        ("0,5\n1;0.25", None, "line 4: '0.25' has another decimal sign than 0,5 in line 3"),
    ],
)
def test_an_undecidable_or_contradictory_sign_is_refused(
    tmp_path: Path, cell: str, decimal: Decimal | None, why: str
) -> None:
    (tmp_path / "a.csv").write_text(KRAFT.format(cell))
    with pytest.raises(InputError, match=why):
        read_columns(tmp_path / "a.csv", decimal)


def test_what_a_file_does_not_show_is_stated(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(KRAFT.format("1.231").replace("[ms]", "[V]"))
    assert read_columns(tmp_path / "a.csv", ",")[0]["Kraft [N]"].tolist() == [
        1230.0,
        1231.0,
        1232.0,
    ]
    (tmp_path / "b.csv").write_text("time_s,pressure_1_pa\n0.0,1e3\n0.1,2e3\n")
    gauge = read_as(tmp_path / "b.csv", Recorder(gauge_pa=1e5))
    assert gauge["pressure_1_pa"].tolist() == [101e3, 102e3]


@pytest.mark.parametrize("units", ["ms;V;A;°C", "ms;foo;foo;", "[ms];[mm];[x];[y]"])
def test_a_row_of_units_is_not_the_header(tmp_path: Path, units: str) -> None:
    rows = "\n".join(f"{k};0,5;1,5;21,5" for k in range(5))
    (tmp_path / "a.csv").write_text(f"Messung;;;\r\nZeit;s;F;T\r\n{units}\r\n{rows}\r\n")
    names = list(read_columns(tmp_path / "a.csv")[0])
    assert names[0] == "Zeit [ms]" and [name.split(" [")[0] for name in names[1:]] == [
        "s",
        "F",
        "T",
    ]


def test_samples_that_repeat_a_stamp_are_counted(tmp_path: Path) -> None:
    rows = "\n".join(f"{t},{k}" for k, t in enumerate((0, 1, 1, 2, 3, 4)))
    (tmp_path / "a.csv").write_text("time_s,x\n" + rows)
    record = read_record(tmp_path / "a.csv")
    assert record["x"].tolist() == [0, 1, 3, 4, 5]
    assert "1 sample left out that repeat a stamp" in record.dialect

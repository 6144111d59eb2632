"""Tables of signals go to MF4 with units and come back."""

from __future__ import annotations

import gzip
import importlib
from pathlib import Path

import pytest

from can_dbc.errors import InputError
from plant.trace import TRACE_COLUMNS
from sil.logs import convert
from sil.logs.traces import comment_of, is_trace_csv
from sil.recording.trace_csv import FIRST_COLUMNS, FROM_STATUS
from tests.unit.sil.logs.mf4_builder import Field, Mf4Builder, signal_file

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
        assert pressure.comment == "pressure of chamber B, absolute"
        assert measurement.get("position_m").unit == "m"
        assert measurement.header.abs_time == 0


def test_every_signal_of_a_run_has_a_comment() -> None:
    assert comment_of("something_else_m") == ""
    columns = {*FIRST_COLUMNS, *TRACE_COLUMNS, *FROM_STATUS} - {"time_s"}
    assert [name for name in sorted(columns) if not comment_of(name)] == []


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
        data = build.block(b"DT", [], bytes(16))
        groups.append(build.data_group(group, data, 0))
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


def test_what_is_a_trace(tmp_path: Path) -> None:
    assert is_trace_csv(str(DATA / "signals.csv"))
    assert not is_trace_csv(str(DATA / "python_can.csv"))
    assert not is_trace_csv(str(DATA / "candump_log.log"))

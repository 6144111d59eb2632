"""Conversion: reports, refusals, and what is never half done."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from can_dbc.errors import InputError
from sil.logs import LogFrame, convert, open_log, open_writer

DATA = Path(__file__).resolve().parents[3] / "data" / "logs"


def test_the_report_has_both_sides(tmp_path: Path) -> None:
    target = tmp_path / "torn.blf"
    report = convert(DATA / "torn.log", target)
    assert report.read is not None
    assert (report.written, report.read.frames, report.read.skipped) == (4, 4, 6)
    assert report.format == "blf"
    assert report.losses["channel can0 written as 1"] == 1
    assert report.losses["direction not recorded, written as Rx"] == 4
    lines = report.lines()
    assert lines[0] == f"{target}: 4 frames (blf)"
    assert "  broken and skipped: 6" in lines
    stated = json.loads(json.dumps(report.as_dict()))
    assert stated["read"]["backwards"] == 1
    assert len(list(open_log(target))) == 4


def test_strict_leaves_nothing_behind(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="line 3: 'garbage'"):
        convert(DATA / "torn.log", tmp_path / "torn.asc", strict=True)
    assert list(tmp_path.iterdir()) == []


def test_a_log_is_never_converted_onto_itself(tmp_path: Path) -> None:
    path = tmp_path / "log.log"
    path.write_bytes((DATA / "candump_log.log").read_bytes())
    before = path.read_bytes()
    with pytest.raises(InputError, match="is the source itself"):
        convert(path, tmp_path / "." / "log.log")
    assert path.read_bytes() == before


def test_unknown_targets_and_missing_sources(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="is of no log format"):
        convert(DATA / "candump_log.log", tmp_path / "log.xyz")
    with pytest.raises(InputError, match="No such file"):
        convert(tmp_path / "missing.log", tmp_path / "log.asc")
    assert list(tmp_path.iterdir()) == []


def test_formats_may_be_stated(tmp_path: Path) -> None:
    source, target = tmp_path / "a", tmp_path / "b"
    source.write_text("(1.000000) can0 123#11\n")
    report = convert(source, target, format="candump", target_format="csv")
    assert report.format == "csv"
    assert [frame.data for frame in open_log(target)] == [b"\x11"]


def test_delta_times_become_times(tmp_path: Path) -> None:
    target = tmp_path / "log.log"
    convert(DATA / "screen_delta.txt", target)
    reader = open_log(target)
    assert [frame.time_ns // 1000 for frame in reader] == [0, 100_012, 200_007, 299_998, 400_101]
    assert reader.report.time_base == "relative"


def test_error_frames_without_a_class_become_bus_errors(tmp_path: Path) -> None:
    target = tmp_path / "log.log"
    report = convert(DATA / "torn.asc", target)
    assert report.losses["error frame without a class written as a bus error"] == 2
    errors = [frame for frame in open_log(target) if frame.error]
    assert errors[0] == LogFrame(
        1_651_142_693_580_003_000, 0x80, bytes(8), False, error=True, channel="can1"
    )


@pytest.mark.parametrize("suffix", ["asc", "blf", "trc", "csv", "log.gz"])
def test_signals_are_no_frames(suffix: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="holds signals, no CAN frames"):
        convert(DATA / "signals.csv", tmp_path / f"log.{suffix}")
    assert list(tmp_path.iterdir()) == []


def test_negative_times_are_refused_with_formats_that_hold_them(tmp_path: Path) -> None:
    source = tmp_path / "a.csv"
    with open_writer(source) as writer:
        writer.write(LogFrame(0, 0x123, channel="1", direction="Rx"))
        writer.write(LogFrame(-104 * 10**9, 0x123, channel="1", direction="Rx"))
    for target in ("b.log", "b.asc"):
        with pytest.raises(InputError, match="expected csv or mf4 as the target") as refused:
            convert(source, tmp_path / target)
        assert "\n" not in str(refused.value)
    for target in ("b.csv", "b.mf4"):
        convert(source, tmp_path / target, strict=False)
        assert [frame.time_ns for frame in open_log(tmp_path / target)] == [0, -104 * 10**9]

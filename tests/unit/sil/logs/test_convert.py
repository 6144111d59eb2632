"""Conversion: reports, refusals, what is never half done, and captures beside a lockstep run."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from can_dbc.errors import InputError
from can_dbc.frame import EDP_BIT, Frame
from sil.coupling.transports import wire
from sil.coupling.transports.wire import Kind
from sil.log_replay.options import find_settings
from sil.log_replay.tick_grid import survey
from sil.logs import LogFrame, convert, open_log
from tests.support.golden_logs import arrivals, write

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
    assert json.loads(json.dumps(report.as_dict()))["read"]["backwards"] == 1
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
    assert convert(source, target, format="candump", target_format="csv").format == "csv"
    assert [frame.data for frame in open_log(target)] == [b"\x11"]


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
    frame = LogFrame(0, 0x123, channel="1", direction="Rx")
    source = write(tmp_path / "a.csv", [frame, frame._replace(time_ns=-104 * 10**9)])
    for target in ("b.log", "b.asc"):
        with pytest.raises(InputError, match="expected csv or mf4 as the target") as refused:
            convert(source, tmp_path / target)
        assert "\n" not in str(refused.value)
    for target in ("b.csv", "b.mf4"):
        convert(source, tmp_path / target, strict=False)
        assert [frame.time_ns for frame in open_log(tmp_path / target)] == [0, -104 * 10**9]


BUS_FRAMES = [(1_000_000 * k + 250, Frame(0x0CFF2091, bytes((k, *range(7))))) for k in range(20)]
FOREIGN = wire.real(Frame(0x18FF9927, b"\1"))


def capture(path: Path, records: list[bytes]) -> str:
    """Write records of a channel as candump does, 20 us apart by the wall clock."""
    found = []
    for k, (can_id, data) in enumerate(wire.split(b"".join(records))):
        found.append(f"(1700000000.{20 * k:06d}) vcan0 {can_id:08X}#{data.hex().upper()}\n")
    path.write_text("".join(found))
    return str(path)


def lockstep_records() -> list[bytes]:
    """Grant, offer and Done of each frame, then its delivery; a foreign frame in between."""
    records = []
    for number, (arrival_ns, frame) in enumerate(BUS_FRAMES):
        records += [
            wire.control(Kind.GRANT, 1, 0, arrival_ns - 250),
            wire.offer(frame),
            wire.control(Kind.DONE, 1, 1, arrival_ns + 1_000_000),
            wire.announced(1, arrival_ns, frame),
        ]
        if number == 7:
            records.append(FOREIGN)
    return records


def test_each_frame_once_at_its_simulated_time(tmp_path: Path) -> None:
    reader = open_log(capture(tmp_path / "a.log", lockstep_records()))
    assert [(f.time_ns, Frame(f.can_id, f.data)) for f in reader] == BUS_FRAMES
    report = reader.report
    assert report.frames == 20 and report.time_base == "relative" and report.clean
    assert report.lockstep == {
        "control frames": 60,
        "offers, repeated when delivered": 20,
        "frames of other programs": 1,
    }
    assert any(
        "left out: control frames (60), frames of other programs (1)" in x for x in report.lines()
    )
    assert report.as_dict()["lockstep"]["control frames"] == 60


def test_a_frame_of_another_program_is_not_taken_for_the_announced_one(tmp_path: Path) -> None:
    announced = wire.announced(1, 5, BUS_FRAMES[1][1])
    records = [announced[: wire.RECORD_BYTES], FOREIGN, announced[wire.RECORD_BYTES :]]
    records = [wire.announced(1, 3, BUS_FRAMES[0][1]), *records]
    reader = open_log(capture(tmp_path / "a.log", records))
    found = [(f.time_ns, Frame(f.can_id, f.data)) for f in reader]
    assert found == [(3, BUS_FRAMES[0][1]), (5, BUS_FRAMES[1][1])]
    assert reader.report.lockstep["frames of other programs"] == 1


def test_a_log_without_a_run_keeps_its_frames_and_times(tmp_path: Path) -> None:
    odd = [wire.real(Frame(0x1BFF_0000, b"")), wire.offer(BUS_FRAMES[0][1]), FOREIGN]
    reader = open_log(capture(tmp_path / "a.log", odd))
    found = list(reader)
    assert [f.can_id for f in found] == [0x1BFF_0000, BUS_FRAMES[0][1].can_id | EDP_BIT, 0x18FF9927]
    assert found[0].time_ns == 1_700_000_000 * 10**9 and not reader.report.lockstep


def test_a_log_of_impossible_periods_is_refused_without_naming_parameters() -> None:
    found = survey(arrivals("firmware_2500us"))._replace(sensor_period_ns=37_300_000)
    with pytest.raises(InputError) as error:
        find_settings("a.log", found)
    assert str(error.value) == (
        "a.log: the log shows period 2.5 ms and sensor period 37.3 ms, with which the firmware "
        "does not work; expected a recording in real time, or its settings by --firmware or --run"
    )

"""A capture taken next to a lockstep run gives the frames of the simulated bus, each once."""

from __future__ import annotations

from pathlib import Path

import pytest

from can_dbc.errors import InputError
from can_dbc.frame import EDP_BIT, Frame
from sil.coupling.transports import wire
from sil.coupling.transports.wire import Kind
from sil.log_replay.options import find_settings
from sil.log_replay.tick_grid import survey
from sil.logs import open_log
from sil.logs.convert import convert
from tests.support.golden_logs import arrivals

FRAMES = [(1_000_000 * k + 250, Frame(0x0CFF2091, bytes((k, *range(7))))) for k in range(20)]
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
    for number, (arrival_ns, frame) in enumerate(FRAMES):
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
    assert [(f.time_ns, Frame(f.can_id, f.data)) for f in reader] == FRAMES
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
    announced = wire.announced(1, 5, FRAMES[1][1])
    records = [announced[: wire.RECORD_BYTES], FOREIGN, announced[wire.RECORD_BYTES :]]
    records = [wire.announced(1, 3, FRAMES[0][1]), *records]
    reader = open_log(capture(tmp_path / "a.log", records))
    found = [(f.time_ns, Frame(f.can_id, f.data)) for f in reader]
    assert found == [(3, FRAMES[0][1]), (5, FRAMES[1][1])]
    assert reader.report.lockstep["frames of other programs"] == 1


def test_a_log_without_a_run_keeps_its_frames_and_times(tmp_path: Path) -> None:
    odd = [wire.real(Frame(0x1BFF_0000, b"")), wire.offer(FRAMES[0][1]), FOREIGN]
    reader = open_log(capture(tmp_path / "a.log", odd))
    found = list(reader)
    assert [f.can_id for f in found] == [0x1BFF_0000, FRAMES[0][1].can_id | EDP_BIT, 0x18FF9927]
    assert found[0].time_ns == 1_700_000_000 * 10**9 and not reader.report.lockstep


def test_convert_leaves_the_protocol_out_and_counts_it(tmp_path: Path) -> None:
    log = capture(tmp_path / "a.log", lockstep_records())
    report = convert(log, tmp_path / "b.log")
    assert report.written == 20
    assert any("left out: control frames (60)" in line for line in report.lines())
    assert [f.time_ns for f in open_log(tmp_path / "b.log")] == [at for at, _ in FRAMES]


def test_a_log_of_impossible_periods_is_refused_without_naming_parameters() -> None:
    found = survey(arrivals("firmware_2500us"))._replace(sensor_period_ns=37_300_000)
    with pytest.raises(InputError) as error:
        find_settings("a.log", found)
    assert str(error.value) == (
        "a.log: the log shows period 2.5 ms and sensor period 37.3 ms, with which the firmware "
        "does not work; expected a recording in real time, or its settings by --firmware or --run"
    )

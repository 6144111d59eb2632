"""Shifts cut out of logs; of another layout the same; what is missing is refused."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from can_dbc.codec import can_id_of
from can_dbc.contract import DBC_PATH
from can_dbc.errors import InputError
from can_dbc.frame import Frame
from can_dbc.messages import DrivelineSpeeds, SafetyBlow, ValveCommand
from plant.parameters import load
from sil.j1939.mapping import SignalMapping
from sil.log_replay.recorded_frames import OWN_IDS, RecordedFrames
from sil.log_replay.recorded_shifts import (
    BETWEEN_GEARS,
    RecordedShift,
    ShiftReader,
    shifts_of,
)
from sil.logs import open_log, open_writer
from tests.support.golden_logs import write
from tests.support.truck_logs import truck_log

MAP = """
[[signal]]
meaning = "{meaning}"
message = "{message}"
signal = "{signal}"
scale = {scale}
"""
ROWS = {
    "duty_b": ("ValveCommand", "DutyB", 0.01),
    "duty_n": ("ValveCommand", "DutyN", 0.01),
    "duty_f": ("ValveCommand", "DutyF", 0.01),
    "pulse_s": ("PositionPulse", "PulseDuration", 1e-6),
    "coil_temperature_k": ("PositionPulse", "CoilTemperature", 1.0),
    "input_shaft_rad_s": ("DrivelineSpeeds", "InputSpeed", 1.0),
    "output_shaft_rad_s": ("DrivelineSpeeds", "OutputSpeed", 1.0),
}


def cut(path: Path, mapping: SignalMapping | None = None) -> list[RecordedShift]:
    return list(shifts_of(str(path), load("nominal"), mapping, Counter()))


def test_a_shift_has_its_gears_commands_and_pulses(nominal_log: Path) -> None:
    shifts = cut(nominal_log)
    assert len(shifts) >= 4
    assert shifts[0].start == "N" and shifts[0].end in "BF"
    for shift in shifts:
        assert shift.commands[0][0] == pytest.approx(0.05, abs=1e-9)
        assert shift.commands[0][2] == pytest.approx(0.98)
        assert np.allclose(np.diff(shift.time_s), 0.01, atol=1e-5)
        assert np.isnan(shift.supply_pa)
    assert len({s.begin_s for s in shifts}) == len(shifts)


def test_a_shift_knows_when_each_valve_was_last_switched_off(nominal_log: Path) -> None:
    shifts = cut(nominal_log)
    assert shifts[0].off_s == (-np.inf,) * 3
    last: dict[int, float] = {}
    for shift in shifts:
        begin_s = shift.begin_s - 0.05
        for chamber, off_s in enumerate(shift.off_s):
            assert off_s + begin_s == pytest.approx(last.get(chamber, -np.inf), abs=1e-9)
        last |= {chamber: at + begin_s for at, chamber, duty in shift.commands if duty == 0.0}
    assert len(last) >= 2


def test_pulses_lost_and_damaged_are_left_out(nominal_log: Path, tmp_path: Path) -> None:
    whole, worse = cut(nominal_log), tmp_path / "worse.log"
    with open_writer(str(worse)) as writer:
        for number, frame in enumerate(open_log(str(nominal_log))):
            if number % 41 != 5:
                writer.write(frame)
    shifts = cut(worse)
    assert [(s.start, s.end) for s in shifts] == [(s.start, s.end) for s in whole]
    for own, other in zip(shifts, whole, strict=True):
        at = np.interp(own.time_s, other.time_s, other.position_m)
        near = np.min(np.abs(own.time_s[:, None] - other.time_s[None]), axis=1) < 3e-4
        assert near.all()
        assert np.max(np.abs(own.position_m - at)) < 1e-3


def test_a_log_of_something_else_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "other.log"
    path.write_text("(1.0) can0 18FEF100#0102030405060708\n")
    with pytest.raises(InputError, match="no ValveCommand"):
        cut(path)


def test_another_layout_needs_duties_and_pulses(tmp_path: Path, nominal_log: Path) -> None:
    path = tmp_path / "map.toml"
    path.write_text(
        MAP.format(meaning="duty_b", message="ValveCommand", signal="DutyB", scale=0.01)
    )
    with pytest.raises(InputError, match="no signal for duty_n"):
        cut(nominal_log, SignalMapping(str(path), str(DBC_PATH)))


def test_another_layout_gives_the_same_shifts(nominal_log: Path, tmp_path: Path) -> None:
    path = tmp_path / "map.toml"
    path.write_text(
        "".join(
            MAP.format(meaning=meaning, message=message, signal=signal, scale=scale)
            for meaning, (message, signal, scale) in ROWS.items()
        )
    )
    whole, mapped = cut(nominal_log), cut(nominal_log, SignalMapping(str(path), str(DBC_PATH)))
    assert [(s.start, s.end) for s in mapped] == [(s.start, s.end) for s in whole]
    for own, other in zip(mapped, whole, strict=True):
        assert own.difference_rad_s == pytest.approx(other.difference_rad_s)
        n = min(len(own.position_m), len(other.position_m))
        assert np.allclose(own.position_m[:n], other.position_m[:n], atol=1e-9)


def without(kind: type, log: Path, path: Path) -> Path:
    """Copy a log without the frames of a message."""
    with open_writer(str(path)) as writer:
        for entry in open_log(str(log)):
            if entry.can_id != can_id_of(kind):
                writer.write(entry)
    return path


def test_a_log_without_blows_has_the_same_shifts(nominal_log: Path, tmp_path: Path) -> None:
    whole, own = cut(nominal_log), cut(without(SafetyBlow, nominal_log, tmp_path / "own.log"))
    assert [(s.start, s.end) for s in own] == [(s.start, s.end) for s in whole]
    # the push ends at the confirmation, where the firmware's blow would go on
    assert own[0].commands[0] == pytest.approx(whole[0].commands[0], abs=1e-3)


def test_no_blow_is_added_to_a_first_blow(nominal_log: Path) -> None:
    cutter = ShiftReader("a.log", load("nominal"))
    received: list[int] = []

    def advance(_until_ns: int, frames: list[tuple[int, Frame]]) -> list[object]:
        received.append(len(frames))
        return []

    cutter._driver = SimpleNamespace(advance=advance)
    frames = RecordedFrames(open_log(str(nominal_log)), ids=OWN_IDS, path=str(nominal_log))
    for kind in (ValveCommand,) * 20 + (ValveCommand, SafetyBlow, ValveCommand):
        cutter.take(next(arrival for arrival in frames if arrival.kind is kind))
    assert received == [1] * 20 + [2, 1, 1]


def test_a_log_without_speeds_has_shifts_of_unknown_difference(
    nominal_log: Path, tmp_path: Path
) -> None:
    own = cut(without(DrivelineSpeeds, nominal_log, tmp_path / "own.log"))
    assert np.isnan([s.difference_rad_s for s in own if s.end in "BF"]).all()
    assert len(own) == len(cut(nominal_log))


def test_two_buses_in_one_log_are_refused(nominal_log: Path, tmp_path: Path) -> None:
    log = enumerate(open_log(str(nominal_log)))
    mixed = write(tmp_path / "mixed.log", (f._replace(channel=f"can{n % 2}") for n, f in log))
    with pytest.raises(InputError, match=r"on channels can. and can.; expected one bus"):
        cut(mixed)


def test_what_is_not_whole_in_a_log_is_said(nominal_log: Path, tmp_path: Path) -> None:
    cut_off, faults = tmp_path / "cut.log", list[str]()
    cut_off.write_bytes(nominal_log.read_bytes()[:-20])
    assert list(shifts_of(str(cut_off), load("nominal"), None, Counter(), faults))
    (fault,) = faults
    assert fault.startswith("cut off at line ")


def test_a_shift_that_fails_is_data(tmp_path: Path) -> None:
    log = tmp_path / "blocked.log"
    truck_log(log, 3, 4, {"plant.mesh_force_n": 20_000.0}, nominal=True)
    failed = [shift for shift in cut(log) if shift.failed]
    assert failed and all(shift.start == "N" and shift.end in "BF" for shift in failed)
    # followed for as long as pulses are kept
    for shift in failed:
        assert len(shift.time_s) == 96
        assert np.max(np.abs(shift.position_m)) < 0.012


def test_a_stay_that_stands_between_gears_is_counted(tmp_path: Path, nominal_log: Path) -> None:
    skipped = Counter[str]()
    list(shifts_of(str(nominal_log), load("nominal"), None, skipped))
    assert skipped[BETWEEN_GEARS] == 0
    # pushed out of neutral by a constant force, up to the teeth
    log = tmp_path / "pushed.log"
    truck_log(log, 3, 4, {"effect.external_force.force_n": 200.0}, nominal=True)
    shifts = list(shifts_of(str(log), load("nominal"), None, skipped))
    assert skipped[BETWEEN_GEARS] == 2 and len(shifts) == 1
    assert all(shift.start in ("B", "F") for shift in shifts)

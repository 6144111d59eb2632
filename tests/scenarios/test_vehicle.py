"""A truck's shift from torque to torque over CAN: order of what happens, rates, ratios, messages."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from can_dbc.codec import can_id_of
from can_dbc.errors import InputError
from can_dbc.frame import split_id
from can_dbc.messages import (
    Air1,
    Eec1,
    Eec2,
    Etc1,
    Etc2,
    Fault,
    Gear,
    OverrideMode,
    ShiftRequest,
    Tc1,
    Tsc1,
)
from sil.cli import main
from sil.j1939.management import PGN_CLAIM, PGN_DM1, TROUBLE_CODES, active_faults
from sil.j1939.transport import Assembler
from sil.logs.frame import LogFrame
from sil.report.run_figure import run_figure, without_torque
from sil.simulation.in_memory import Run, run_in_memory
from sil.simulation.load_scenario import load
from sil.simulation.runner import run

NAME = "truck_torque_to_torque"
RPM = 30.0 / np.pi


@pytest.fixture(scope="module")
def found() -> Run:
    return run_in_memory(load(NAME))


def first_s(of: Run, kind: type, field: str, value: object) -> float:
    times, values = of.record.series(kind, field)
    return float(times[[v == value for v in values].index(True)])


def test_order_of_a_shift_from_torque_to_torque(found: Run) -> None:
    ((begin, back),) = without_torque(found.record)
    times, torques = found.record.series(Eec1, "torque")
    order = {
        "gear asked for": first_s(found, Tc1, "requested_gear", 11),
        "torque request": first_s(found, Tsc1, "mode", OverrideMode.TORQUE),
        "torque falls": begin,
        "torque is out": float(times[np.argmin(torques)]),
        "actuator asked": first_s(found, ShiftRequest, "target", Gear.FORWARD),
        "in process": first_s(found, Etc1, "shift_in_process", True),
        "speed request": first_s(found, Tsc1, "mode", OverrideMode.SPEED),
        "neutral": first_s(found, Etc2, "current_gear", 0),
        "new gear": first_s(found, Etc2, "current_gear", 11),
        "torque is back": back,
    }
    assert list(order) == sorted(order, key=lambda name: round(order[name], 2))  # to a tick
    assert 0.9 < back - begin < 1.2
    assert first_s(found, Tsc1, "mode", OverrideMode.NONE) < back
    assert found.record.series(Tsc1, "mode")[1].count(OverrideMode.NONE) == 1


def test_rates_are_those_of_j1939(found: Run) -> None:
    periods_s = {Etc1: 0.01, Etc2: 0.1, Eec1: 0.01, Eec2: 0.05, Tc1: 0.05, Air1: 1.0}
    for kind, period_s in periods_s.items():
        times, _ = found.record.series(kind, next(iter(kind.__annotations__)))
        assert np.diff(times) == pytest.approx(period_s, abs=0.003), kind


def test_ratios_speeds_and_pressure_agree(found: Run) -> None:
    _, into = found.record.series(Etc1, "input_shaft_rad_s")
    times, out = found.record.series(Etc1, "output_shaft_rad_s")
    ratio = np.array([i / o if i and o else np.nan for i, o in zip(into, out, strict=True)])
    ((begin, back),) = without_torque(found.record)
    assert np.nanmedian(ratio[times < begin]) == pytest.approx(1.55, rel=2e-3)
    assert np.nanmedian(ratio[times > back]) == pytest.approx(1.24, rel=2e-3)
    steps = [abs(b - a) * RPM for a, b in pairwise(v for v in into if v is not None)]
    assert max(steps) < 20.0  # no jump where the reference changes from one gear to the other
    _, ratios = found.record.series(Etc2, "gear_ratio")
    assert [r for r in dict.fromkeys(ratios) if r] == pytest.approx([1.55, 1.24])
    _, engine = found.record.series(Eec1, "speed_rad_s")
    assert engine[-1] * RPM == pytest.approx(98.0 * 1.24 * RPM, rel=2e-3)
    _, supply = found.record.series(Air1, "supply_gauge_pa")
    assert supply[0] == pytest.approx(9e5 - 101_325.0, abs=4000.0)


def test_engine_without_requests_leaves_the_synchronizer_the_whole_difference(found: Run) -> None:
    lost = run_in_memory(load(NAME, settings={"driveline.follows_requests": False}))
    assert lost.shifts[0].arrived_s == pytest.approx(found.shifts[0].arrived_s, abs=0.1)
    table = {"fault": [{"kind": "loss", "message": "Tsc1"}], "controller.shift.sync_wait_s": 0.2}
    alone = run_in_memory(load(NAME, settings=table))
    assert _held_s(alone) > 0.02
    assert "sync_block" not in {e.name for e in found.record.events} or _held_s(found) < 0.01


def _held_s(of: Run) -> float:
    times = {e.name: e.time_s for e in of.record.events}
    return times["sync_unblock"] - times["sync_block"]


@pytest.mark.slow
def test_replay_finds_the_shift_and_no_difference(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    finished = run(load(NAME), tmp_path)
    assert finished.result.passed, finished.result.expectations
    log = str(tmp_path / "bus.log")
    assert main(["replay", "--summary", log]) == 0
    summary = capsys.readouterr().out
    assert "1 shift in" in summary and ": 10 to 11, ratio 1.55 to 1.24, source 0x03" in summary
    assert main(["replay", log]) == 0
    assert "no difference in 300 ticks" in capsys.readouterr().out


def test_picture_has_torque_speed_gear_and_stay(found: Run) -> None:
    figure = run_figure(found.record, found.shifts)
    titles = [panel.title for panel in figure.stacks[0].panels]
    assert titles[:4] == ["Engine torque", "Engine speed", "Gear (ETC2)", "Position"]
    (zoom,) = figure.stacks[0].zooms
    ((begin, back),) = without_torque(found.record)
    assert zoom.low < 1e3 * begin and 1e3 * back < zoom.high
    plain = run_in_memory(load("lab_n_b"))
    assert run_figure(plain.record, plain.shifts).stacks[0].panels[0].title == "Position"


def logged(of: Run) -> list[LogFrame]:
    return [
        LogFrame(entry.arrival_ns, entry.frame.can_id, entry.frame.data)
        for entry in of.record.frames
    ]


def test_addresses_are_claimed_and_no_fault_is_active(found: Run) -> None:
    sent = [(split_id(frame.can_id), frame) for frame in logged(found)]
    claims = [(parts.source, frame) for parts, frame in sent if parts.pgn == PGN_CLAIM]
    assert [source for source, _ in claims] == [0, 3, 5, 48]
    assert all(frame.time_ns < 10_000_000 for _, frame in claims)
    assert [frame.data[5] for _, frame in claims] == [0, 3, 5, 36]
    dm1 = [frame.data for parts, frame in sent if parts.pgn == PGN_DM1]
    assert len(dm1) == 3 and set(dm1) == {bytes.fromhex("00ff00000000ffff")}


def test_two_faults_go_over_the_transport_protocol() -> None:
    settings = {
        "speed_fault": [{"kind": "off", "start_s": 0.2}],
        "sensor_fault": [{"kind": "off", "start_s": 0.4}],
        "duration_s": 2.0,
    }
    faulty = run_in_memory(load(NAME, settings=settings))
    assembler = Assembler()
    long = [m for frame in logged(faulty) if (m := assembler.take(frame)) and m.pgn == PGN_DM1]
    assert len(long[-1].data) > 8 and long[-1].source == 3
    short = [f.data for f in logged(faulty) if split_id(f.can_id).pgn == PGN_DM1]
    codes = {
        (m[0] | m[1] << 8 | m[2] >> 5 << 16, m[2] & 31)
        for m in (long[-1].data[k : k + 4] for k in range(2, len(long[-1].data), 4))
    }
    assert TROUBLE_CODES[Fault.SPEEDS_LOST] in codes and TROUBLE_CODES[Fault.POSITION_LOST] in codes
    assert long[-1].data[0] == 0x04
    single = next(data for data in short if data[0])
    assert single[2:6] == bytes((161, 0, 9, 1))


def test_every_fault_has_a_code_of_its_own() -> None:
    assert set(TROUBLE_CODES) == {fault for fault in Fault if fault}
    assert len(set(TROUBLE_CODES.values())) == len(TROUBLE_CODES)
    assert len(active_faults(Fault.NONE)) == len(active_faults(Fault.INTERNAL)) == 1
    every = Fault(sum(TROUBLE_CODES))
    assert len(active_faults(every)) == 1 + -(-(2 + 4 * len(TROUBLE_CODES)) // 7)


def test_truck_without_a_table_is_absent_and_a_driver_with_one_refused() -> None:
    plain = run_in_memory(load("lab_n_b")).record
    assert not plain.frames_of(can_id_of(Eec1))
    with pytest.raises(InputError, match=r"driver: given; expected none with \[vehicle\]"):
        load(NAME, settings={"driver.period_s": 0.01})
    changed = load(NAME, settings={"vehicle.ratio_forward": 1.3}).scenario
    assert changed.driveline.ratio_forward == changed.controller.broadcast.ratio_forward == 1.3

"""A truck's log: any layout, senders, clocks; the phases of its shifts, found again."""

from __future__ import annotations

import random
from collections.abc import Iterable
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from can_dbc.codec import can_id_of
from can_dbc.errors import InputError
from can_dbc.messages import ValveCommand
from sil.j1939.mapping import LAYOUT, SHIPPED, SignalMapping
from sil.log_replay.truck_log import TruckLog
from sil.log_replay.truck_loop import inputs_of, scenario_of, why_not
from sil.log_replay.truck_shift import RecordedShift, peak_rate, recorded_shift
from sil.logs import LogFrame
from sil.simulation import load_scenario
from tests.support.truck_synthesis import (
    MS,
    RATIOS,
    START_NS,
    MadeShift,
    Truck,
    changed,
    replace,
    without,
)

FRAMES = Truck().frames()

PROPRIETARY = """VERSION ""
NS_ :
BS_:
BU_: X
BO_ 256 Gears: 8 X
 SG_ Wanted : 7|8@0+ (1,0) [0|0] "" X
 SG_ Engaged : 15|8@0+ (1,0) [0|0] "" X
 SG_ Busy : 16|1@1+ (1,0) [0|1] "" X
BO_ 257 Shafts: 8 X
 SG_ Out : 7|16@0+ (0.125,0) [0|0] "rpm" X
 SG_ In : 23|16@0+ (0.125,0) [0|0] "rpm" X
"""
ROWS = {
    "selected_gear": ("Gears", "Wanted", -125.0, 1.0),
    "current_gear": ("Gears", "Engaged", -125.0, 1.0),
    "shift_in_process": ("Gears", "Busy", 0.0, 1.0),
    "input_shaft_rad_s": ("Shafts", "In", 0.0, 0.10471975511965977),
    "output_shaft_rad_s": ("Shafts", "Out", 0.0, 0.10471975511965977),
}


def read_mapped(mapping: SignalMapping, frames: list[LogFrame]) -> TruckLog:
    log = TruckLog("truck.log", mapping)
    assert log.read(frames)
    return log


def proprietary(tmp_path: Path) -> SignalMapping:
    (tmp_path / "gearbox.dbc").write_text(PROPRIETARY)
    (tmp_path / "map.toml").write_text(
        "".join(
            f'[[signal]]\nmeaning = "{meaning}"\nmessage = "{message}"\nsignal = "{signal}"\n'
            f"offset = {offset}\nscale = {scale}\n"
            for meaning, (message, signal, offset, scale) in ROWS.items()
        )
    )
    return SignalMapping(str(tmp_path / "map.toml"), str(tmp_path / "gearbox.dbc"))


def as_proprietary(frames: list[LogFrame]) -> list[LogFrame]:
    """The same drive as 11-bit messages with the bytes in another order, both every 10 ms."""
    found, gears = [], b"\x7d\x7d"
    for frame in frames:
        data = frame.data
        if frame.can_id >> 8 & 0x3FFFF == 61445:
            gears = bytes((data[0], data[3]))
        elif frame.can_id >> 8 & 0x3FFFF == 61442:
            busy = bytes((data[0] >> 4 & 1,))
            shafts = data[2:0:-1] + data[6:4:-1] + bytes(4)
            plain = frame._replace(extended=False, can_id=0x100, data=gears + busy + bytes(5))
            found += [plain, plain._replace(can_id=0x101, data=shafts)]
    return found


def test_another_layout_gives_the_same_shifts(tmp_path: Path) -> None:
    standard = read_mapped(SignalMapping(), FRAMES)
    copied = SignalMapping(str(SHIPPED), str(LAYOUT))
    assert not copied.is_standard
    plain = [replace(shift, engine=None) for shift in standard.shifts]
    assert read_mapped(copied, FRAMES).shifts == plain
    other = read_mapped(proprietary(tmp_path), as_proprietary(FRAMES))
    assert len(other.shifts) == len(standard.shifts) == 3
    for ours, theirs in zip(other.shifts, standard.shifts, strict=True):
        assert (ours.start_ns, ours.end_ns) == (theirs.start_ns, theirs.end_ns)
        assert (ours.from_gear, ours.to_gear) == (theirs.from_gear, theirs.to_gear)
        a, b = recorded_shift(other, ours), recorded_shift(standard, theirs)
        assert a.times_s["synchronised"] == b.times_s["synchronised"]
        assert a.synchronisation is not None and b.synchronisation is not None
        assert a.synchronisation.step_rad_s == pytest.approx(b.synchronisation.step_rad_s)


def test_a_map_without_the_gears_is_refused(tmp_path: Path) -> None:
    proprietary(tmp_path)
    text = (tmp_path / "map.toml").read_text().split("[[signal]]")
    (tmp_path / "map.toml").write_text("[[signal]]".join(["", *text[4:]]))
    found = read_mapped(
        SignalMapping(str(tmp_path / "map.toml"), str(tmp_path / "gearbox.dbc")),
        as_proprietary(FRAMES),
    )
    with pytest.raises(
        InputError, match=r"no signal for current_gear and selected_gear in .*map\.toml"
    ):
        found.require_shifts()


def test_the_first_signal_with_values_counts_and_the_nearest_sender() -> None:
    """AIR1's supply pressure is not available: the brake circuit's; of two engines the lower address."""

    def circuit(data: bytearray) -> None:
        data[0], data[2] = 0xFF, 100

    other = [
        f._replace(can_id=f.can_id | 0x29)
        for f in changed(FRAMES, 61444, lambda data: data.__setitem__(2, 125))
        if f.can_id >> 8 & 0x3FFFF == 61444
    ]
    log = read_mapped(SignalMapping(), sorted([*changed(FRAMES, 65198, circuit), *other]))
    shift = log.shifts[0]
    span = shift.start_ns - 1500 * MS, shift.end_ns + 1500 * MS
    pressure = log.samples("supply_pressure_pa", shift, *span, shift.start_ns)
    assert pressure is not None and set(pressure.values) == {901325.0}
    assert pressure.origin == "AIR1.ServiceBrakeCircuit1AirPress of 0x30"
    torque = log.samples("engine_torque_share", shift, *span, shift.start_ns)
    assert torque is not None and torque.origin.endswith("of 0x00")
    assert max(torque.values) == pytest.approx(0.6)
    speeds = log.samples("engine_rad_s", replace(shift, channel="other"), *span, shift.start_ns)
    assert speeds is not None  # on the only channel there is


def test_reading_ends_at_a_command_of_our_unit() -> None:
    own = LogFrame(START_NS + 5_000 * MS, can_id_of(ValveCommand), bytes(8))
    frames = sorted([*FRAMES, own])
    log = TruckLog("own.log", SignalMapping())
    assert not log.read(frames, own.can_id)
    assert log.frames < len(frames) and log.shifts == []
    assert len(read_mapped(SignalMapping(), frames).shifts) == 3


def test_a_clock_that_steps_back_and_short_frames_are_no_trap() -> None:
    back = [
        f._replace(time_ns=f.time_ns - 4_000 * MS)
        for f in FRAMES
        if f.time_ns > START_NS + 11_000 * MS
    ]
    log = read_mapped(SignalMapping(), without(FRAMES, 11_000, 99_000) + back)
    for shift in log.shifts:
        assert recorded_shift(log, shift).times_s.keys()
    short = [f._replace(data=f.data[:4]) if f.time_ns % (100 * MS) == 0 else f for f in FRAMES]
    log = read_mapped(SignalMapping(), short)
    assert [s.to_gear for s in log.shifts] == [4, 5, 4]
    assert any("fewer than 8 bytes" in note for note in log.notes)


def test_remote_and_error_frames_show_nothing(tmp_path: Path) -> None:
    for mapping, frames in (
        (SignalMapping(), FRAMES),
        (proprietary(tmp_path), as_proprietary(FRAMES)),
    ):
        odd = [f._replace(error=True) for f in frames]
        odd += [f._replace(remote=True, data=b"") for f in frames]
        log = read_mapped(mapping, odd)
        assert log.shifts == [] and log.frames == 2 * len(frames)
        with pytest.raises(InputError, match=r"no ETC1|no Shafts"):
            log.require_shifts()


MAPPING = SignalMapping()
ONE = Truck(drive=(MadeShift(3_000, 7, 8, fall_from_ms=300, fall_to_ms=700),), end_ms=6_000)


def read(frames: Iterable[LogFrame]) -> TruckLog:
    log = TruckLog("truck.log", MAPPING)
    assert log.read(frames)
    return log


def recorded(frames: Iterable[LogFrame]) -> list[RecordedShift]:
    log = read(frames)
    log.require_shifts()
    return [recorded_shift(log, shift) for shift in log.shifts]


@st.composite
def made_shifts(draw: st.DrawFn) -> MadeShift:
    """A shift of any length with its instants in order."""
    instants = np.cumsum(draw(st.tuples(*(st.integers(60, 900) for _ in range(5))))).tolist()
    gears = draw(st.sampled_from([(7, 8), (8, 7), (3, 4), (6, 7), (4, 2), (1, 2), (8, 4)]))
    cut, out, begin, end, engaged = instants
    back = engaged + draw(st.integers(100, 900))
    return MadeShift(3_000, *gears, cut, out, begin, end, engaged, back)


@settings(max_examples=15, deadline=None)
@given(made_shifts(), st.sampled_from([10, 20]), st.sampled_from([50, 100]))
def test_instants_are_found_again(made: MadeShift, etc1_ms: int, etc2_ms: int) -> None:
    truck = Truck(
        (made,), end_ms=made.end_ms + 2_000, etc1_ms=etc1_ms, etc2_ms=etc2_ms, output_rpm=500
    )
    (found,) = recorded(truck.frames())
    times = found.times_s
    assert found.is_whole
    assert times["torque_cut"] is not None and times["torque_back"] is not None
    assert abs(times["torque_cut"] - made.cut_ms / 1e3) <= 0.1 * made.cut_ms / 1e3 + 0.025
    assert times["disengaged"] is not None
    assert -0.001 <= times["disengaged"] - made.out_ms / 1e3 <= etc2_ms / 1e3
    sync = found.synchronisation
    assert sync is not None and times["synchronised"] is not None
    assert sync.old_ratio == pytest.approx(RATIOS[made.before], rel=1e-3)
    assert sync.new_ratio == pytest.approx(RATIOS[made.after], rel=1e-3)
    ramp = abs(sync.step_rad_s) / (made.fall_to_ms - made.fall_from_ms) * 1e3
    assert times["synchronised"] == pytest.approx(
        made.fall_to_ms / 1e3 - 2.0 / ramp, abs=2.0 * etc1_ms / 1e3 + 0.01
    )
    assert sync.ramp_rad_s2 == pytest.approx(ramp, rel=0.45 if etc1_ms > 10 else 0.25)
    assert sync.apart_rad_s is not None and sync.apart_rad_s < 0.5 * abs(sync.step_rad_s)
    assert times["engaged"] is not None
    assert -0.001 <= times["engaged"] - made.in_ms / 1e3 <= etc2_ms / 1e3
    known = [t for t in times.values() if t is not None]
    assert all(a <= b + 0.11 for a, b in pairwise(known))


def test_the_synchronizer_is_in_front_of_the_range_section() -> None:
    """The same speeds of the output: in the low range the main shaft turns 3.75 times as fast."""
    (high,) = recorded(ONE.frames())
    (low,) = recorded(replace(ONE, drive=(replace(ONE.drive[0], before=3, after=4),)).frames())
    assert high.synchronisation is not None and low.synchronisation is not None
    output = ONE.output_rpm * np.pi / 30.0
    assert high.synchronisation.main_rad_s == pytest.approx(output, rel=1e-3)
    assert low.synchronisation.main_rad_s == pytest.approx(3.75 * output, rel=1e-3)
    assert low.synchronisation.step_rad_s == pytest.approx(
        3.75 * output * (RATIOS[3] / RATIOS[4] - 1.0), rel=2e-3
    )


def test_a_selected_gear_before_the_flag_is_the_request() -> None:
    """ETC2 shows the new selected gear from 0.3 s before the flag on."""

    def early(frame: LogFrame) -> LogFrame:
        since_ms = (frame.time_ns - START_NS) // MS - 3_000
        if frame.can_id >> 8 & 0x3FFFF == 61445 and -300 <= since_ms < 0:
            return frame._replace(data=bytes((8 + 125,)) + frame.data[1:])
        return frame

    (usual,) = recorded(ONE.frames())
    (found,) = recorded([early(frame) for frame in ONE.frames()])
    earlier_ns = usual.request_ns - found.request_ns
    assert usual.request_ns == usual.shift.start_ns
    assert 200 * MS <= earlier_ns <= 300 * MS
    assert any("selected gear" in note for note in found.notes)
    assert found.times_s["engaged"] == pytest.approx(
        (usual.times_s["engaged"] or 0) + earlier_ns / 1e9
    )


@pytest.mark.parametrize(("begin_ms", "end_ms"), [(3_200, 3_900), (3_400, 3_800), (3_050, 3_600)])
def test_a_gap_leaves_the_shift_out_of_the_figures(begin_ms: int, end_ms: int) -> None:
    (found,) = recorded(without(ONE.frames(), begin_ms, end_ms))
    assert not found.is_whole
    assert any("without frames of the transmission" in note for note in found.notes)
    assert all(known <= 0.35 for known in found.known_s.values())


def test_a_silent_gear_message_is_not_an_engagement() -> None:
    """ETC2 stops before the shift and comes back 0.8 s after its end."""
    (found,) = recorded(without(ONE.frames(), 2_950, 4_800, 61445))
    assert found.times_s["engaged"] == found.times_s["synchronised"]
    assert any("new gear reported: not known" in note for note in found.notes)


def test_speeds_that_are_missing_are_named() -> None:
    def no_speeds(data: bytearray) -> None:
        data[1:3] = data[5:7] = b"\xff\xff"

    (found,) = recorded(changed(ONE.frames(), 61442, no_speeds))
    assert found.synchronisation is None and found.times_s["synchronised"] is None
    assert found.times_s["engaged"] == pytest.approx(0.807)
    assert "shaft speeds not available: synchronisation not known" in found.notes
    away = [
        frame
        for frame in ONE.frames()
        if frame.can_id >> 8 & 0x3FFFF != 61442
        or not 3_200 <= (frame.time_ns - START_NS) // MS < 3_800
    ]
    (found,) = recorded(away)
    assert not found.is_whole
    assert any("speeds missing for a while" in note for note in found.notes)


def test_without_torque_neither_cut_nor_return_is_known() -> None:
    (found,) = recorded(without(ONE.frames(), 0, 99_000, 61444))
    assert found.times_s["torque_cut"] is None and found.times_s["torque_back"] is None
    assert any("engine torque not available" in note for note in found.notes)

    def steady(data: bytearray) -> None:
        data[2] = 125 + 30

    (found,) = recorded(changed(ONE.frames(), 61444, steady))
    assert found.times_s["torque_cut"] is None
    assert any("engine torque hardly changes (30% before)" in note for note in found.notes)


def test_equal_ratios_and_speeds_that_never_meet() -> None:
    same = replace(ONE, drive=(replace(ONE.drive[0], before=8, after=8),))
    frames = without(same.frames(), 0, 99_000, 61445)
    frames += [frame for frame in ONE.frames() if frame.can_id >> 8 & 0x3FFFF == 61445]
    (found,) = recorded(sorted(frames))
    assert found.synchronisation is None
    assert any("nothing to synchronise" in note for note in found.notes)


def test_another_transmission_and_other_priorities() -> None:
    second = Truck((MadeShift(4_500, 2, 3),), end_ms=8_000, source=0x85, priority=6)
    first = replace(ONE, end_ms=8_000)
    found = recorded(sorted([*first.frames(), *second.frames()]))
    assert [(f.shift.source, f.shift.from_gear, f.shift.to_gear) for f in found] == [
        (3, 7, 8),
        (0x85, 2, 3),
    ]
    alone = recorded(first.frames())[0]
    for name in ("disengaged", "synchronised", "engaged"):
        assert found[0].times_s[name] == alone.times_s[name]
    assert found[1].synchronisation is not None
    assert found[1].synchronisation.new_ratio == pytest.approx(RATIOS[3], rel=1e-3)


def test_a_shift_cut_off_by_the_end_of_the_log_is_noted() -> None:
    log = read([f for f in Truck().frames() if f.time_ns - START_NS < 14_400 * MS])
    assert len(log.shifts) == 2
    assert any("without beginning or end" in note for note in log.notes)


@pytest.mark.parametrize(
    ("frames", "expected"),
    [
        ([], "among 0 frames"),
        (
            [f for f in ONE.frames() if f.can_id >> 8 & 0x3FFFF != 61442],
            "no ETC1 (PGN 61442) among",
        ),
        (
            [f for f in ONE.frames() if f.can_id >> 8 & 0x3FFFF != 61445],
            "no ETC2 (PGN 61445) among",
        ),
        (without(ONE.frames(), 2_000, 99_000), "no gear shift among"),
    ],
)
def test_what_is_missing_is_said_in_one_line(frames: list[LogFrame], expected: str) -> None:
    log = read(frames)
    with pytest.raises(InputError) as raised:
        log.require_shifts()
    assert expected in str(raised.value) and "\n" not in str(raised.value)


def test_peak_rate_is_over_forty_milliseconds() -> None:
    time = np.arange(0.0, 1.0, 0.01)
    ramp = np.clip((time - 0.3) * 50.0, 0.0, 10.0)
    assert peak_rate(time, ramp, 0.0, 1.0) == pytest.approx(50.0)
    spike = ramp + np.where(np.isclose(time, 0.7), 1.0, 0.0)
    assert peak_rate(time, spike, 0.6, 1.0) == pytest.approx(25.0)
    assert peak_rate(time, ramp, 2.0, 3.0) is None


def damage(frames: list[LogFrame], draw: random.Random) -> list[LogFrame]:
    """The frames with one kind of damage somewhere: lost, random, late, coarse or doubled."""
    begin = draw.randrange(6_000)
    end = begin + draw.choice([20, 300, 3_000])

    def inside(frame: LogFrame) -> bool:
        return begin * MS <= frame.time_ns - START_NS < end * MS

    kind = draw.randrange(6)
    if kind == 0:
        return without(frames, begin, end, draw.choice([61442, 61445, 61444, None]))
    if kind == 1:
        return [f._replace(data=draw.randbytes(8)) if inside(f) else f for f in frames]
    if kind == 2:
        late = [f._replace(time_ns=f.time_ns - 300 * MS) if inside(f) else f for f in frames]
        return [f for f in late if draw.random() < 0.9]
    if kind == 3:
        return [f._replace(time_ns=f.time_ns // (100 * MS) * 100 * MS) for f in frames]
    if kind == 4:
        return [f for f in frames for _ in range(1 + (draw.random() < 0.1))]
    return frames[: draw.randrange(len(frames))]


@pytest.mark.parametrize("seed", range(10))
@pytest.mark.filterwarnings("error")
def test_damaged_logs_give_shifts_that_can_be_simulated_or_one_line(seed: int) -> None:
    draw = random.Random(seed)
    frames = ONE.frames()
    for _ in range(draw.randrange(1, 4)):
        frames = damage(frames, draw)
    log = read(frames)
    try:
        log.require_shifts()
    except InputError as error:
        assert "\n" not in str(error)
        return
    for shift in log.shifts:
        found = recorded_shift(log, shift)
        assert all(t is None or t >= -0.01 for t in found.times_s.values())
        if why_not(found) is None:
            load_scenario.from_table(scenario_of(inputs_of(found)), "truck.log")

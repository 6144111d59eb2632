"""The phases of recorded shifts, found again in logs made from known instants."""

from __future__ import annotations

import random
from collections.abc import Iterable
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from can_dbc.errors import InputError
from sil.j1939.mapping import SignalMapping
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
    lengths = draw(st.tuples(*(st.integers(60, 900) for _ in range(5))))
    instants = np.cumsum(lengths).tolist()
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
    frames = [f for f in Truck().frames() if f.time_ns - START_NS < 14_400 * MS]
    log = read(frames)
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

"""Shifts cut out of a drive, as reported and with the engine."""

from __future__ import annotations

import json
import math
import random
from collections.abc import Iterable
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from can_dbc.codec import encode
from can_dbc.frame import join_id, split_id
from can_dbc.messages import GEAR_PARK, Etc1, Etc2
from sil.j1939.summary import summarize
from sil.logs import LogFrame, open_log
from sil.shifts.cutter import Shift
from sil.shifts.engine import EngineTrace
from sil.shifts.reported import gear_at, shift_in_process, word_at
from tests.support.golden_logs import write
from tests.support.j1939_logs import (
    MS,
    NOT_AVAILABLE,
    SEVEN,
    START_NS,
    Drive,
    eec1,
    etc1,
    etc2,
    truck,
    with_engine,
)

ETC1, ETC2 = 61442, 61445


def shifts(log: Iterable[LogFrame]) -> list[Shift]:
    return summarize(log).shifts


def of_group(pgn: int, frames: Iterable[LogFrame]) -> list[LogFrame]:
    return [frame for frame in frames if split_id(frame.can_id).pgn == pgn]


def is_etc1(frame: LogFrame) -> bool:
    return bool(of_group(ETC1, [frame]))


def merged(*logs: list[LogFrame]) -> list[LogFrame]:
    return sorted((frame for log in logs for frame in log), key=lambda frame: frame.time_ns)


def echo(
    frames: list[LogFrame], late_ms: int, channel: str = "can0", source: int = 3
) -> list[LogFrame]:
    """The frames as another sender or channel repeats them."""
    return [
        f._replace(
            time_ns=f.time_ns + late_ms * MS, can_id=f.can_id & ~0xFF | source, channel=channel
        )
        for f in frames
    ]


def gears(found: Iterable[Shift]) -> list[tuple[int | None, int | None]]:
    return [(shift.from_gear, shift.to_gear) for shift in found]


def plain(found: Iterable[Shift]) -> list[tuple[int, int, int | None, int | None]]:
    """Shifts in whole tens of milliseconds, as a drive is written."""
    return [
        (
            (shift.start_ns - START_NS) // (10 * MS) * 10,
            (shift.end_ns - START_NS) // (10 * MS) * 10,
            shift.from_gear,
            shift.to_gear,
        )
        for shift in found
    ]


def test_seven_shifts_of_a_truck() -> None:
    found = shifts(truck())
    assert plain(found) == SEVEN
    assert found[1].duration_s == pytest.approx(0.85, abs=0.001)
    assert {shift.method for shift in found} == {"flag"}
    assert {shift.source for shift in found} == {3}


@pytest.mark.parametrize("suffix", ["log", "mf4", "csv.gz"])
def test_out_of_a_file(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"truck.{suffix}"
    write(path, truck())
    summary = summarize(open_log(path))
    assert plain(summary.shifts) == SEVEN
    assert summary.unflagged == []
    assert summary.groups[61442, 3] == 2800
    lines = summary.lines()
    assert lines[0] == f"7 shifts in {summary.frames} frames"
    assert "1 to 2, source 0x03" in lines[2]
    assert json.loads(json.dumps(summary.as_dict()))["shifts"][3]["to_gear"] == 5


@pytest.mark.parametrize("lag_ms", [0.0, 90.0, 400.0, 900.0])
def test_the_gear_may_be_reported_late(lag_ms: float) -> None:
    assert plain(shifts(truck(lag_ms=lag_ms))) == SEVEN


def test_chatter_of_one_sample_is_left_out_and_counted() -> None:
    """One sample up in rest, one sample down in a shift, and one at each edge."""
    log = truck()
    odd = {3_500, 5_400, 11_000, 19_500}
    chattering = [
        frame._replace(data=bytes((frame.data[0] ^ 0x10,)) + frame.data[1:])
        if is_etc1(frame) and (frame.time_ns - START_NS) // MS in odd
        else frame
        for frame in log
    ]
    summary = summarize(chattering)
    begun = list(SEVEN)
    begun[3] = (11_000, *SEVEN[3][1:])
    assert plain(summary.shifts) == begun
    assert summary.chatter == 3


def test_not_available_samples_change_nothing() -> None:
    rng = random.Random(3)
    log = [
        frame._replace(data=bytes((rng.choice((0xFC, 0xEC)),)) + frame.data[1:])
        if is_etc1(frame) and rng.random() < 0.3
        else frame
        for frame in truck()
    ]
    found = shifts(log)
    assert len(found) == 7
    for shift, (begin, end, old, new) in zip(found, SEVEN, strict=True):
        assert shift.start_ns - START_NS == pytest.approx(begin * MS, abs=100 * MS)
        assert shift.end_ns - START_NS == pytest.approx(end * MS, abs=100 * MS)
        assert (shift.from_gear, shift.to_gear) == (old, new)


WITHOUT_FLAG = truck(flags=False)


@pytest.mark.parametrize(
    "log",
    [
        WITHOUT_FLAG,
        of_group(ETC2, truck()),
        [f._replace(data=b"\xcc" + f.data[1:]) if is_etc1(f) else f for f in WITHOUT_FLAG],
    ],
    ids=["flag not available", "no ETC1", "flag never moves"],
)
def test_without_the_flag_the_gears_decide(log: list[LogFrame]) -> None:
    found = shifts(log)
    assert {shift.method for shift in found} == {"gear"}
    assert gears(found) == [row[2:] for row in SEVEN]
    for shift, (begin, end, _, _) in zip(found, SEVEN, strict=True):
        if shift.from_gear:
            assert shift.start_ns - START_NS == pytest.approx((begin + 150) * MS, abs=130 * MS)
        assert shift.end_ns - START_NS == pytest.approx((end + 60) * MS, abs=130 * MS)


def test_without_etc2_gears_are_unknown() -> None:
    found = shifts(truck(gears=False))
    assert plain(found) == [(begin, end, None, None) for begin, end, _, _ in SEVEN]
    assert all(shift.from_ratio is None for shift in found)
    assert "? to ?" in str(found[0])


def test_error_and_remote_and_standard_frames_are_passed_over() -> None:
    rng = random.Random(5)
    log = []
    for frame in truck():
        log.append(frame)
        if rng.random() < 0.1:
            log.append(frame._replace(remote=True, data=b""))
            log.append(frame._replace(error=True, data=bytes(8), extended=False))
            log.append(frame._replace(can_id=frame.can_id & 0x7FF, extended=False))
    assert plain(shifts(log)) == SEVEN


def test_transport_protocol_and_lockstep_twins_are_other_groups() -> None:
    """TP frames whose data look like ETC1, and the same group in the extended data page."""
    log = []
    for frame in truck():
        log.append(frame)
        if is_etc1(frame):
            flipped = bytes((frame.data[0] ^ 0x10,)) + frame.data[1:]
            log.append(frame._replace(can_id=0x1CEBFF03, data=flipped))
            log.append(frame._replace(can_id=frame.can_id | 1 << 25, data=flipped))
            log.append(frame._replace(can_id=frame.can_id | 1 << 24, data=flipped))
    assert plain(shifts(log)) == SEVEN


def test_short_frames_are_counted() -> None:
    log = truck()
    log[5] = log[5]._replace(can_id=join_id(3, 61442, 3), data=b"\xcc")
    summary = summarize(log)
    assert len(summary.shifts) == 7
    assert summary.notes == ["1 ETC1 or ETC2 frames of fewer than 8 bytes"]


def test_several_senders_are_followed_apart() -> None:
    other: Drive = [(3_000, 3_500, 1, 2), (12_000, 12_800, 2, 4)]
    found = shifts(merged(truck(), truck(other, source=5)))
    assert plain(s for s in found if s.source == 3) == SEVEN
    assert plain(s for s in found if s.source == 5) == other
    assert [s.start_ns for s in found] == sorted(s.start_ns for s in found)


def test_gears_of_another_sender_serve() -> None:
    """ETC1 from the clutch unit, ETC2 from the transmission: one of each on the bus."""
    flags = truck(gears=False, source=9)
    assert plain(shifts(merged(flags, of_group(ETC2, truck(flags=False))))) == SEVEN


@pytest.mark.parametrize(
    ("repeated", "note"),
    [
        (echo(truck(), 3, channel="can1"), "shifts on channel can1 repeat those on can0"),
        (echo(of_group(ETC1, truck()), 8, source=0x27), "shifts of 0x27 repeat those of 0x03"),
    ],
    ids=["a gateway", "another unit"],
)
def test_a_flag_that_is_repeated_shows_no_shift_twice(repeated: list[LogFrame], note: str) -> None:
    summary = summarize(merged(repeated, truck()))
    assert plain(summary.shifts) == SEVEN
    assert {(shift.source, shift.channel) for shift in summary.shifts} == {(3, "can0")}
    assert summary.notes == [note]


def test_gears_alone_on_another_channel_show_no_shift_twice() -> None:
    summary = summarize(merged(truck(), echo(of_group(ETC2, truck()), 5, channel="can1")))
    assert plain(summary.shifts) == SEVEN and not summary.unflagged


def test_gears_alone_of_two_senders_show_no_shift_twice() -> None:
    log = of_group(ETC2, truck(flags=False))
    assert gears(shifts(merged(log, echo(log, 40, source=0x27)))) == [row[2:] for row in SEVEN]


def test_duplicated_frames_are_no_second_sample() -> None:
    log = [frame for frame in truck() for _ in range(2)]
    odd = START_NS + 3_500 * MS
    log = [
        frame._replace(data=b"\xdc" + frame.data[1:])
        if is_etc1(frame) and odd <= frame.time_ns < odd + MS
        else frame
        for frame in log
    ]
    summary = summarize(log)
    assert plain(summary.shifts) == SEVEN
    assert summary.chatter == 1


def test_shifts_cut_off_by_the_log_are_reported() -> None:
    begun, end = START_NS + 2_300 * MS, START_NS + 24_400 * MS
    summary = summarize(frame for frame in truck() if begun < frame.time_ns < end)
    assert plain(summary.shifts) == SEVEN[1:6]
    assert summary.unfinished == 2
    assert "2 shifts without beginning or end in the log" in summary.lines()


def test_a_clock_that_steps_back_joins_nothing() -> None:
    """Ten hours back in the middle of a shift: that shift is reported as unfinished."""
    log = [
        frame._replace(time_ns=frame.time_ns - 36_000 * 10**9)
        if frame.time_ns > START_NS + 8_400 * MS
        else frame
        for frame in truck()
    ]
    summary = summarize(log)
    assert len(summary.shifts) == 6
    assert summary.unfinished >= 1
    assert all(0 < shift.duration_s < 2 for shift in summary.shifts)
    assert "the clock stepped back 1 times" in summary.notes[0]


def test_a_clock_that_steps_back_makes_no_negative_shift() -> None:
    """Without the flag, the gears before the step and after it are of two drives."""
    log = [
        frame._replace(time_ns=frame.time_ns - 104 * 10**9)
        if frame.time_ns > START_NS + 8_300 * MS
        else frame
        for frame in truck([(5_000, 5_600, 1, 2), (8_000, 8_600, 2, 3)], flags=False, end_ms=12_000)
    ]
    found = shifts(log)
    assert [(s.from_gear, s.to_gear, s.method) for s in found] == [(0, 3, "gear"), (1, 2, "gear")]
    assert all(0 < shift.duration_s < 2 for shift in found)


def test_slow_etc1_is_believed() -> None:
    """At 100 ms a shift may be a single sample; that is no chatter."""
    drive: Drive = [(2_000, 2_100, 1, 2), (5_000, 5_400, 2, 3)]
    found = shifts(truck(drive, period_ms=100))
    assert plain(found)[0][:2] == (2_000, 2_100)
    assert len(found) == 2


def test_gear_changes_outside_of_shifts_are_reported_apart() -> None:
    """Rolling out of gear at a stop is no flagged shift."""
    end_ns = START_NS + 26_500 * MS
    log = [frame for frame in truck() if is_etc1(frame) or frame.time_ns <= end_ns]
    summary = summarize(merged(log, [etc2(27_000 + 100 * i, 0, 0) for i in range(5)]))
    assert plain(summary.shifts) == SEVEN
    assert gears(summary.unflagged) == [(5, 0)]
    assert any("outside of flagged shifts" in line for line in summary.lines())


def test_one_odd_gear_sample_is_chatter() -> None:
    log = truck(flags=False)
    odd_ns = START_NS + 17_500 * MS
    at = next(i for i, f in enumerate(log) if not is_etc1(f) and f.time_ns > odd_ns)
    log[at] = etc2((log[at].time_ns - START_NS) / MS, 11, 6)
    summary = summarize(log)
    assert len(summary.shifts) == 7
    assert summary.chatter == 1


@pytest.mark.parametrize(
    ("log", "note"),
    [
        ([LogFrame(0, 0x18FEF100, bytes(8))], "no ETC1 (PGN 61442) and no ETC2 (PGN 61445)"),
        ([etc1(i, NOT_AVAILABLE) for i in range(9)], "neither shift in process nor a current gear"),
        ([], "no ETC1"),
    ],
)
def test_logs_without_shifts_say_why(log: list[LogFrame], note: str) -> None:
    summary = summarize(log)
    assert summary.shifts == []
    assert note in summary.notes[0]


@st.composite
def flag_logs(draw: st.DrawFn) -> tuple[list[LogFrame], Drive]:
    """Any sequence of rests and shifts of at least three samples."""
    time_ms, drive, log, gear = 0, [], [], 0
    for _ in range(draw(st.integers(1, 8))):
        time_ms += draw(st.integers(3, 80)) * 10
        end = time_ms + draw(st.integers(3, 80)) * 10
        drive.append((time_ms, end, gear, gear + 1))
        time_ms, gear = end, gear + 1
    end_ms = time_ms + 1_500
    for t in range(0, end_ms, 10):
        log.append(etc1(t, int(any(b <= t < e for b, e, _, _ in drive))))
    return log, drive


@given(flag_logs())
@settings(deadline=None, max_examples=50)
def test_any_flag_is_followed_to_the_sample(case: tuple[list[LogFrame], Drive]) -> None:
    log, drive = case
    assert [row[:2] for row in plain(shifts(log))] == [row[:2] for row in drive]


@given(
    st.lists(
        st.builds(
            LogFrame,
            st.integers(0, 10**12),
            st.sampled_from((0x0CF00203, 0x18F00503, 0x0CF00205, 0x18F00505)),
            st.binary(max_size=8),
        ),
        max_size=60,
    )
)
@settings(deadline=None)
def test_no_traffic_breaks_the_finder(log: list[LogFrame]) -> None:
    for shift in shifts(log):
        assert shift.duration_s >= 0.0
        assert shift.method in ("flag", "gear")


def silence(frames: list[LogFrame], begin_ms: int, end_ms: int) -> list[LogFrame]:
    """Leave out what a recorder or sender did not deliver."""
    gap = range(START_NS + begin_ms * MS, START_NS + end_ms * MS)
    return [frame for frame in frames if frame.time_ns not in gap]


def test_a_sender_that_was_silent_and_begins_with_zeros_makes_no_shift() -> None:
    frames = truck([(50_000, 50_600, 0, 1)], flags=False, end_ms=8_000)
    frames = silence(frames, 3_000, 5_000)
    index = next(i for i, f in enumerate(frames) if f.time_ns > START_NS + 5_000 * MS)
    zeros = LogFrame(frames[index].time_ns, join_id(6, 61445, 3), bytes(8), channel="can0")
    assert shifts([*frames[:index], zeros, *frames[index:]]) == []


def test_a_change_of_gear_during_silence_has_no_shift_time() -> None:
    found = summarize(silence(truck(SEVEN[:2], flags=False, end_ms=9_000), 4_000, 6_500))
    assert plain(found.shifts) == [(2_630, 2_730, 0, 1)]


def test_a_shift_in_which_the_recorder_was_off_has_no_known_time() -> None:
    summary = summarize(silence(truck(SEVEN[:2], end_ms=12_000), 5_600, 8_600))
    assert plain(summary.shifts) == SEVEN[:1]
    assert summary.unfinished == 1


def test_flags_have_two_bits() -> None:
    flags = [shift_in_process(bytes((0xCF | state << 4,))) for state in range(4)]
    assert flags == [False, True, None, None]


def test_words_above_the_valid_range_are_none() -> None:
    assert word_at(bytes((0x40, 0x1F)), 0) == 8000
    assert word_at(bytes((0, 0xFF, 0xFA)), 1) == 0xFAFF
    assert word_at(bytes((0x00, 0xFB)), 0) is None


def test_reverse_neutral_and_park() -> None:
    gears = [gear_at(bytes((raw,)), 0) for raw in (0, 1, 123, 125, 126, 250, 251)]
    assert gears == [None, -124, -2, 0, 1, 125, GEAR_PARK]
    assert [gear_at(bytes((raw,)), 0) for raw in (252, 253, 254, 255)] == [None] * 4


@given(shifting=st.booleans(), bits=st.integers(0, 0xFAFF), gear=st.integers(-124, 126))
def test_our_own_messages_are_read(shifting: bool, bits: int, gear: int) -> None:
    speed_rad_s = bits * 0.125 * 2.0 * math.pi / 60.0
    etc1 = encode(Etc1(shift_in_process=shifting, input_shaft_rad_s=speed_rad_s)).data
    assert shift_in_process(etc1) is shifting
    assert word_at(etc1, 5) == pytest.approx(bits, abs=1)
    assert gear_at(encode(Etc2(current_gear=gear)).data, 3) == gear


def test_each_shift_has_the_torque_and_its_cut() -> None:
    found = summarize(with_engine()).shifts
    assert len(found) == 3
    for shift, (begin, end, _, _) in zip(found, SEVEN, strict=False):
        engine = shift.engine
        assert engine is not None
        assert (engine.torque_before_percent, engine.torque_least_percent) == (60, -5)
        assert (engine.torque_after_percent, engine.speed_before_rpm) == (60, 1500)
        assert engine.torque_cut_s == pytest.approx((end - begin + 60) / 1e3, abs=0.011)
        assert "torque 60 %, down to -5 % (cut for" in str(shift)
    assert "ratio 11.70 to 9.20" in str(found[1])


def test_without_the_engine_there_are_no_figures() -> None:
    found = summarize([f for f in with_engine() if f.can_id != 0x0CF00400]).shifts
    assert [shift.engine for shift in found] == [None] * 3


def test_no_torque_no_cut_and_no_values() -> None:
    trace = EngineTrace()
    for n in range(300):
        trace.take(n * 10 * MS, eec1(0, 5, 700).data)
        trace.take(n * 10 * MS, b"\xff" * 8)
    engine = trace.figures(1_000 * MS, 1_500 * MS)
    assert engine is not None and engine.torque_cut_s is None
    assert trace.figures(-1, -1) is None


def test_samples_are_by_time_whatever_the_clock_did() -> None:
    traces = EngineTrace(), EngineTrace()
    frames = [eec1(n * 10, 60 - n % 7, 1000 + n) for n in range(400)]
    for trace, order in zip(traces, (frames, [*frames[200:], *frames[:200]]), strict=True):
        for frame in order:
            trace.take(frame.time_ns, frame.data)
        trace.sort()
    ours, stepped = (
        trace.figures(START_NS + 1_000 * MS, START_NS + 2_500 * MS) for trace in traces
    )
    assert ours is not None and ours == stepped

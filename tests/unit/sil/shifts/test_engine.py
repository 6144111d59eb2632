"""Engine torque and speed around shifts."""

from __future__ import annotations

import pytest

from sil.j1939.summary import summarize
from sil.shifts.engine import EngineTrace
from tests.support.j1939_logs import MS, SEVEN, START_NS, eec1, with_engine


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


def test_memory_grows_with_the_shifts_only() -> None:
    trace = EngineTrace()
    for n in range(5_000):
        trace.take(n * 10 * MS, eec1(0, 50, 1500).data)
        if n == 2_000:
            trace.keep(n * 10 * MS)
    assert len(trace.time_ns) == 301 + 200


def test_no_torque_no_cut_and_no_values() -> None:
    trace = EngineTrace()
    trace.keep(0)
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
        trace.keep(2**62)
        for frame in order:
            trace.take(frame.time_ns, frame.data)
        trace.sort()
    ours, stepped = (
        trace.figures(START_NS + 1_000 * MS, START_NS + 2_500 * MS) for trace in traces
    )
    assert ours is not None and ours == stepped

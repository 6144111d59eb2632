"""Pacing against the wall clock: absolute schedule, lateness counted, flat memory."""

from __future__ import annotations

import math
from collections import Counter

import pytest
from hypothesis import given
from hypothesis import strategies as st

from can_dbc.errors import InputError
from sil.coupling.clock import NEVER_NS, next_tick, to_ns, to_seconds
from sil.coupling.real_time import Pacer, quantile, rounded_up

MS = 1_000_000


class FakeWall:
    """A wall clock that passes by sleeping; each sleep takes `oversleep_ns` more."""

    def __init__(self, oversleep_ns: int = 0) -> None:
        self.now = 5_000_000_000
        self.oversleep_ns = oversleep_ns
        self.idled: list[float] = []

    def clock(self) -> int:
        return self.now

    def sleep(self, seconds: float) -> None:
        assert seconds > 0.0
        self.now += round(seconds * 1e9) + self.oversleep_ns

    def idle(self, seconds: float) -> None:
        self.idled.append(seconds)
        self.now += round(seconds * 1e9)


def paced(wall: FakeWall, factor: float = 1.0) -> Pacer:
    return Pacer(factor, wall.clock, wall.sleep)


@pytest.mark.parametrize("factor", [0.5, 1.0, 2.0])
def test_instants_come_when_the_wall_clock_is_there(factor: float) -> None:
    wall = FakeWall()
    pacer = paced(wall, factor)
    began = wall.now
    for tick in range(11):
        pacer.wait(100 * MS + tick * 10 * MS, wall.idle)
        assert wall.now - began == round(tick * 10 * MS / factor)
    found = pacer.lateness()
    assert (found.instants, found.max_s, found.overruns, found.factor) == (10, 0.0, 0, factor)
    assert len(wall.idled) == 10, "the channels are served while the coordinator waits"


def test_a_late_instant_does_not_shift_the_next_ones() -> None:
    wall = FakeWall(oversleep_ns=300_000)
    pacer = paced(wall)
    pacer.wait(0, wall.idle)
    began = wall.now
    for tick in range(1, 101):
        pacer.wait(tick * 10 * MS, wall.idle)
    assert wall.now - began == 1000 * MS + 300_000
    found = pacer.lateness()
    assert found.p50_s == found.p99_s == found.max_s == 3e-4
    assert found.overruns == 0


def test_work_that_takes_too_long_is_an_overrun_and_is_caught_up() -> None:
    wall = FakeWall()
    pacer = paced(wall)
    for tick in range(100):
        pacer.wait(tick * 10 * MS, wall.idle)
        if tick == 49:
            wall.now += 25 * MS
    found = pacer.lateness()
    assert found.overruns == 2  # due 10 and 20 ms after the one that took 25
    assert found.max_s == pytest.approx(0.015)
    assert found.p50_s == 0.0


@pytest.mark.parametrize("factor", [0.0, -1.0, float("nan"), float("inf"), 1e9])
def test_an_impossible_factor_is_refused(factor: float) -> None:
    with pytest.raises(InputError, match=r"speed: .+; expected 1e-6"):
        Pacer(factor)


@given(st.lists(st.integers(0, 10**12), min_size=1), st.floats(0.01, 1.0))
def test_quantiles_are_right_to_two_digits(values: list[int], share: float) -> None:
    exact = next(v for i, v in enumerate(sorted(values), 1) if i >= share * len(values))
    found = quantile(Counter(map(rounded_up, values)), share)
    assert exact <= found <= max(exact * 1.1, exact + 1)


def test_the_counts_stay_few() -> None:
    assert len({rounded_up(value) for value in range(0, 10**9, 99_991)}) < 1000
    assert quantile({}, 0.5) == 0


@pytest.mark.parametrize(
    ("seconds", "nanoseconds"),
    [(0.0, 0), (0.0025, 2_500_000), (0.1, 100_000_000), (86400.0, 86_400_000_000_000), (1e-9, 1)],
)
def test_seconds_become_the_nearest_nanosecond(seconds: float, nanoseconds: int) -> None:
    assert to_ns(seconds) == nanoseconds
    assert to_seconds(nanoseconds) == seconds


@pytest.mark.parametrize("seconds", [-1e-9, math.nan, math.inf, -math.inf, 3e5, 1e300])
def test_times_outside_the_lockstep_are_refused_by_name(seconds: float) -> None:
    with pytest.raises(InputError, match=r"^request\[0\].at_s: .*expected "):
        to_ns(seconds, "request[0].at_s")


@given(st.integers(0, 86_400_000_000_000))
def test_a_day_of_nanoseconds_survives_seconds(nanoseconds: int) -> None:
    assert to_ns(to_seconds(nanoseconds)) == nanoseconds


@given(
    st.integers(0, NEVER_NS), st.integers(1, 10**12), st.integers(0, 10**12), st.integers(0, 1000)
)
def test_next_tick_is_the_first_of_the_schedule_after(
    after: int, period: int, phase: int, extra: int
) -> None:
    tick = next_tick(after, period, phase)
    assert tick > after or tick == phase >= after
    assert (tick - phase) % period == 0 and tick >= phase
    assert tick - period <= after or tick == phase

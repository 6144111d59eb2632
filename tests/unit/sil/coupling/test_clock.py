"""Simulated time in whole nanoseconds."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from can_dbc.errors import InputError
from sil.coupling.clock import NEVER_NS, next_tick, to_ns, to_seconds


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

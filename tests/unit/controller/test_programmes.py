"""The tables of programmes: complete, consistent, and looked up as stated."""

from __future__ import annotations

from itertools import pairwise
from math import exp, log
from pathlib import Path

import numpy as np
import pytest

import controller
from controller.programmes import CAREFUL, NEVER, STRONG, Programme, Pulse, Table, library
from tests.bench._learned_programmes import IMPULSES_N_S, NONE, STRENGTHS, Draws, read
from tests.bench._learned_risk import RISK, Tail, risk

SUPPLIES, DELAYS = (8e5, 8.5e5, 9e5), (0.027, 0.031, 0.035, 0.039)


def row(plain_s: float, begin: int) -> Programme:
    return Programme(plain_s, plain_s, 1.0, (), (), begin)


def table(*begins: int) -> Table:
    rows = tuple(row(0.1 + 0.01 * k, begin) for k, begin in enumerate(begins))
    return Table(9e5, 0.035, (log(20.0), 0.1), (rows,) * 2, tuple(each.plain_s for each in rows))


@pytest.mark.parametrize("supply_pa", SUPPLIES)
@pytest.mark.parametrize("close_s", DELAYS)
def test_every_table_is_there_and_consistent(supply_pa: float, close_s: float) -> None:
    found = library().near(supply_pa, close_s).nearest
    assert (found.supply_pa, found.close_s) == (pytest.approx(supply_pa), pytest.approx(close_s))
    first, step = found.log_impulse
    assert exp(first) == pytest.approx(16.0, rel=0.01)
    assert exp(first + step * (len(found.plain_s) - 1)) == pytest.approx(275.0, rel=0.01)
    assert all(one < other for one, other in pairwise(found.plain_s))
    for strength, rows in enumerate(found.rows):
        assert len(rows) == len(found.plain_s)
        for each in rows:
            assert each.released_s > each.plain_s - 0.003
            assert 0.5 < each.gain < 3.0
            acts = [*each.vents, *each.brakes]
            assert all(2 <= act.start < act.end < 40 for act in acts)
            assert each.begin == min((act.start for act in acts), default=NEVER)
        acting = sum(bool(each.brakes or each.vents) for each in rows)
        assert acting > 0.4 * len(rows), strength


@pytest.mark.parametrize("strength", [CAREFUL, STRONG, STRONG + 3])
def test_a_programme_bears_a_valve_that_is_suddenly_slow(strength: int) -> None:
    """As one that was in the tables did not: in a truck it was 0.052 m/s harder than the open loop."""
    given = read(Path(controller.__file__).with_name("programmes.csv"))[8.0, 31.0, 19]
    model = Draws(STRENGTHS[strength], 8.0, 0.031, float(IMPULSES_N_S[19]))
    assert not np.array_equal(given[strength], NONE[0])
    assert model.failed(given[strength]) == []
    once = np.array([[11.0, 4.0, 0.0, -1.0], [5.0, 1.0, 0.0, -1.0]])
    assert min(model.failed(once)) >= model.loads - 60


def test_a_programme_that_stalled_in_two_trucks_is_too_risky_and_those_of_its_row_are_not() -> None:
    """It passes the proof, which goes 4.3 standard deviations in random directions."""
    given = read(Path(controller.__file__).with_name("programmes.csv"))[9.0, 31.0, 23]
    tail = Tail(9.0)
    for strength, programme in enumerate(given):
        tail.aim(STRENGTHS[strength], 0.031, float(IMPULSES_N_S[23]))
        assert risk(tail.fails(programme)) <= RISK
    once = np.array([[6.0, 4.0, 0.0, -1.0], [13.0, 1.0, 0.0, -1.0]])
    tail.aim(STRENGTHS[STRONG + 3], 0.031, float(IMPULSES_N_S[23]))
    assert risk(tail.fails(once)) > 5.0 * RISK
    assert Draws(STRENGTHS[STRONG + 3], 9.0, 0.031, float(IMPULSES_N_S[23])).failed(once) == []


def test_between_pressures_and_beyond_them() -> None:
    near = library().near
    low, high = near(8.0e5, 0.035).nearest, near(8.5e5, 0.035).nearest
    middle = near(8.3e5, 0.036)
    assert middle.nearest == high and middle.safe == low  # no programme for more than there is
    assert near(8.5e5, 0.035).safe == high and near(8.49e5, 0.035).safe == low
    assert (middle.low, middle.high) == (low, high)
    release_s, slope_s, share = middle.release(log(60.0))
    assert share == pytest.approx(log(60.0 / 16.0) / log(275.0 / 16.0), rel=1e-3)
    one, other = low.release(log(60.0)), high.release(log(60.0))
    assert release_s == pytest.approx(0.4 * one[0] + 0.6 * other[0])
    assert slope_s == pytest.approx(0.4 * one[1] + 0.6 * other[1])
    assert near(1.0e6, 0.1).nearest == near(9e5, 0.039).nearest == near(9e5, 0.039).safe
    assert near(1.0e6, 0.035).release(log(60.0))[0] < near(9e5, 0.035).release(log(60.0))[0]


def test_release_and_impulse_are_inverse_to_each_other() -> None:
    found = library().near(9e5, 0.035).nearest
    for impulse in (14.0, 18.0, 55.0, 200.0, 300.0):
        release_s, slope_s = found.release(log(impulse))
        logarithm, rate_s = found.spent(release_s)
        assert exp(logarithm) == pytest.approx(impulse)
        assert rate_s == pytest.approx(slope_s)


def test_a_programme_that_can_no_longer_begin_is_not_taken() -> None:
    own = table(7, 5, 8)
    rows = own.rows[STRONG]
    assert own.row(0.109, 5, STRONG) == rows[1]
    assert own.row(0.109, 6, STRONG) == rows[0], "the other neighbour still can"
    assert own.row(0.112, 6, STRONG) == rows[2]
    assert own.row(0.104, 8, STRONG) is None
    assert own.row(0.099, 0, STRONG) is None
    assert own.row(0.121, 0, STRONG) is None


def test_a_pulse_ends_before_its_end() -> None:
    assert Pulse(3, 5) == (3, 5)

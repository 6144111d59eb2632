"""The tables of programmes: complete, consistent, and looked up as stated."""

from __future__ import annotations

from itertools import pairwise
from math import exp, log
from pathlib import Path

import numpy as np
import pytest

import controller
from controller.programmes import (
    CAREFUL,
    LATE,
    LEVELS,
    LIGHTEST,
    NEVER,
    PER_LEVEL,
    SOFTEST,
    STRONG,
    Filling,
    Programme,
    Table,
    library,
)
from tests.bench._learned_programmes import (
    ALWAYS,
    EARLIEST,
    FIRST_S,
    NONE,
    RISK,
    SHORTEST_S,
    STEP_S,
    STRENGTHS,
    SUPPLY_BAR,
    Pushes,
    read,
)

SUPPLIES_PA = [1e5 * bar for bar in SUPPLY_BAR]


def row(plain_s: float, begin: int) -> Programme:
    return Programme(plain_s, plain_s, 1.0, (), begin)


def table(*begins: int) -> Table:
    rows = tuple(row(0.1 + 0.01 * k, begin) for k, begin in enumerate(begins))
    times = tuple(each.plain_s for each in rows)
    return Table(9e5, (log(20.0), 0.1), times, times, 0.01, (rows,) * 2)


@pytest.mark.parametrize("supply_pa", SUPPLIES_PA)
def test_every_table_is_there_and_consistent(supply_pa: float) -> None:
    found = library().near(supply_pa).nearest
    assert found.supply_pa == pytest.approx(supply_pa)
    first, step = found.log_impulse
    assert exp(first) == pytest.approx(14.0, rel=0.01)
    assert exp(first + step * (len(found.plain_s) - 1)) == pytest.approx(290.0, rel=0.01)
    assert all(one < other for one, other in pairwise(found.plain_s))
    assert found.rows_s[0] == pytest.approx(found.release(log(14.5))[0], abs=1.01 * STEP_S)
    assert found.rows_s[-1] == pytest.approx(found.release(log(305.0))[0], abs=1.01 * STEP_S)
    assert np.diff(found.rows_s) == pytest.approx(STEP_S, abs=1e-9)
    assert len(found.rows) == len(STRENGTHS)
    for strength, rows in enumerate(found.rows):
        assert len(rows) == len(found.rows_s)
        for each in rows:
            assert each.released_s > each.plain_s - 0.001
            assert 0.5 < each.gain < 3.0
            assert each.begin == (each.fillings[0].start if each.fillings else NEVER)
            assert each.begin >= EARLIEST
            for filling in each.fillings:
                assert filling.end_s > 0.01 * filling.start + SHORTEST_S - 1e-4
            for one, other in pairwise(each.fillings):
                assert 0.01 * other.start > one.end_s - 1e-4
        acting = sum(bool(each.fillings) for each in rows)
        assert acting > 0.8 * len(rows), strength


def test_the_firmware_has_the_strengths_that_were_searched() -> None:
    levels = [LIGHTEST + PER_LEVEL * k for k in range(LEVELS)]
    assert [each.heavier for each in STRENGTHS[STRONG:LATE]] == pytest.approx(levels)
    assert [k for k, each in enumerate(STRENGTHS) if not each.twice] == [LATE]
    assert STRENGTHS[CAREFUL].name == "careful"
    assert sorted(SOFTEST) == list(range(len(STRENGTHS)))


def test_programmes_are_soft_and_their_risk_is_small() -> None:
    """A sample of the tables, judged again; and a filling too early, which the same judgement refuses."""
    given = read(Path(controller.__file__).with_name("programmes.csv"))
    model = Pushes(9.0)
    likely = ALWAYS[:20]
    for plain_s, strength in (
        (0.0875, STRONG),
        (0.12, CAREFUL),
        (0.12, STRONG),
        (0.17, STRONG + 1),
    ):
        model.aim(STRENGTHS[strength], plain_s)
        programme = given[9.0, round((plain_s - FIRST_S) / STEP_S), strength]
        plain_m_s, impact_m_s = model.under(np.array([NONE[0], programme]), likely).cost_m_s
        assert impact_m_s.mean() < plain_m_s.mean() - 0.1
        assert model.risk(model.fails(programme)) <= RISK
        early = programme - np.array([2.0, 0.0, 2.0, 0.0])
        assert model.risk(model.fails(np.where(programme < 0.0, programme, early))) > 10.0 * RISK


def test_between_pressures_and_beyond_them() -> None:
    near = library().near
    low, high = (near(each).nearest for each in SUPPLIES_PA[:2])
    share = 0.6
    middle = near(SUPPLIES_PA[0] + share * (SUPPLIES_PA[1] - SUPPLIES_PA[0]))
    assert middle.nearest == high
    assert (middle.low, middle.high) == (low, high)
    release_s, slope_s, at = middle.release(log(60.0))
    assert at == pytest.approx(log(60.0 / 14.0) / log(290.0 / 14.0), rel=1e-3)
    one, other = low.release(log(60.0)), high.release(log(60.0))
    assert release_s == pytest.approx((1.0 - share) * one[0] + share * other[0])
    assert slope_s == pytest.approx((1.0 - share) * one[1] + share * other[1])
    assert near(1.0e6).nearest == near(9e5).nearest
    assert near(1.0e6).release(log(60.0))[0] < near(9e5).release(log(60.0))[0]


def test_release_and_impulse_are_inverse_to_each_other() -> None:
    found = library().near(9e5).nearest
    for impulse in (14.0, 18.0, 55.0, 200.0, 300.0):
        release_s, slope_s = found.release(log(impulse))
        logarithm, rate_s = found.spent(release_s)
        assert exp(logarithm) == pytest.approx(impulse)
        assert rate_s == pytest.approx(slope_s)


def test_a_programme_that_can_no_longer_begin_is_not_taken() -> None:
    own = table(7, 5, 8)
    rows, only = own.rows[STRONG], (STRONG,)
    assert own.row(0.109, 5, only) == rows[1]
    assert own.row(0.109, 6, only) == rows[0], "the other neighbour still can"
    assert own.row(0.112, 6, only) == rows[2]
    assert own.row(0.104, 8, only) is None
    assert own.row(0.099, 0, only) is None
    assert own.row(0.121, 0, only) is None


def test_those_of_the_next_strength_are_taken_if_they_can_still_begin() -> None:
    early, late = table(5, 5, 5).rows[0], table(9, 9, 9).rows[0]
    times = tuple(each.plain_s for each in early)
    own = Table(9e5, (log(20.0), 0.1), times, times, 0.01, (late, early))
    assert own.row(0.101, 5, (1, 0)) == early[0]
    assert own.row(0.101, 6, (1, 0)) == late[0]
    assert own.row(0.101, 6, (1,)) is None
    assert own.row(0.101, 10, (1, 0)) is None


def test_a_filling_begins_in_a_step_and_ends_at_a_time() -> None:
    assert Filling(3, 0.0655) == (3, 0.0655)

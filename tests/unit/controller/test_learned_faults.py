"""The strategy that learns: what it does when a sensor or a valve fails within a push."""

from __future__ import annotations

import pytest

from controller.position import Estimate
from tests.unit.controller.test_learned import PUSHES, plain, practised, push


def test_a_push_that_goes_on_after_its_end_teaches_once_and_the_next_two_are_plain() -> None:
    strategy = practised()
    push(strategy, 60.0, friction=1.05)
    values = list(strategy.correction.values)
    strategy.ended(10**9, Estimate(True, 0.012, 0.012, 0.0, ()), True, True)
    assert strategy.correction.values == values
    assert (strategy.correction.shifts, strategy.correction.plain) == (1, 2)


@pytest.mark.parametrize(("rest_m", "acts"), [(0.0005, True), (-0.0005, True), (-0.0023, False)])
def test_a_position_before_the_push_that_is_not_neutral_makes_it_plain(
    rest_m: float, acts: bool
) -> None:
    """As by a thermometer that is wrong by 45 K: the closing delay would be wrong as well."""
    strategy = practised()
    assert plain(push(strategy, 60.0, rest_m=rest_m)) != acts


def test_a_programme_that_has_begun_is_broken_off_if_the_synchronizer_does_not_work() -> None:
    whole, late = practised(), practised()
    given = push(whole, 70.0)
    acted = whole._programme
    assert acted is not None
    broken_off = push(late, 70.0, begin_ms=140)
    assert late._programme is not None
    assert acted == late._programme
    count = sum(duties != PUSHES for duties in broken_off)
    assert 0 < count < sum(duties != PUSHES for duties in given)
    assert late.correction.plain == 2


def test_two_stops_at_the_teeth_after_a_programme_make_many_pushes_plain() -> None:
    """As by a valve that did not open again: good pushes in between are no sign that it has healed."""
    strategy = practised()
    assert not plain(push(strategy, 140.0))
    assert strategy._release.released_s is not None
    arrived = Estimate(True, 0.012, 0.012, 0.0, ())
    for travel_s, plain_pushes in ((0.03, 0), (0.2, 2), (0.2, 2)):
        strategy._release.arrived_s = strategy._release.released_s + travel_s
        strategy._has_ended = False
        strategy.ended(10**9, arrived, True, True)
        assert strategy.correction.plain == plain_pushes
    pushes = [plain(push(strategy, 140.0)) for _ in range(30)]
    assert all(pushes[:6])
    assert not pushes[-1]


def test_a_programme_is_broken_off_if_the_speeds_stop_falling_once_it_acts() -> None:
    whole, stuck = practised(), practised()
    given = push(whole, 140.0)
    broken_off = push(stuck, 140.0, stuck_at=0.5)
    assert stuck._programme == whole._programme is not None
    count = sum(duties != PUSHES for duties in broken_off)
    assert 0 < count < sum(duties != PUSHES for duties in given)

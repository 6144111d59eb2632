"""The strategy that learns: what it does when a sensor or a valve fails within a push."""

from __future__ import annotations

import pytest

from controller.position import Estimate
from tests.unit.controller.test_learned import plain, practised, push


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


@pytest.mark.parametrize(
    ("before", "since", "acts"), [(True, False, True), (False, True, True), (False, False, False)]
)
def test_pushes_are_plain_until_the_speeds_have_agreed_in_a_gear_and_teach_if_they_then_do(
    before: bool, since: bool, acts: bool
) -> None:
    """An input speed that is wrong by a constant from power-on shows only in a gear."""
    strategy = practised(speeds_agreed=before)
    values = list(strategy.correction.values)
    assert plain(push(strategy, 60.0, friction=1.05, agreed=since)) != acts
    assert strategy.correction.values != values
    assert strategy.correction.plain == 0


@pytest.mark.parametrize("begun", [True, False])
def test_a_programme_that_has_begun_is_carried_out_without_speeds_and_teaches_nothing(
    begun: bool,
) -> None:
    """Breaking it off after its first filling made stops 0.05 to 0.08 m/s harder in trucks."""
    whole, lost = practised(), practised()
    given = push(whole, 140.0)
    assert whole._programme is not None
    begin_ms = 10 * whole._programme.begin
    found = push(lost, 140.0, lost_ms=begin_ms + 10 if begun else begin_ms)
    assert (found == given) == begun
    assert plain(found) != begun
    assert lost.correction.values == practised().correction.values != whole.correction.values


def test_speeds_that_stay_as_they_are_do_not_end_a_programme_but_make_the_next_pushes_plain() -> (
    None
):
    whole, stuck = practised(), practised()
    assert push(stuck, 140.0, stuck_at=0.5) == push(whole, 140.0)
    assert (stuck.correction.plain, whole.correction.plain) == (2, 0)
    assert stuck.correction.values == practised().correction.values


def test_two_stops_at_the_teeth_after_a_programme_make_many_pushes_plain() -> None:
    """As by a valve that did not open again: good pushes in between are no sign that it has healed."""
    strategy = practised()
    assert not plain(push(strategy, 140.0))
    assert strategy._motion.left is not None
    arrived = Estimate(True, 0.012, 0.012, 0.0, ())
    for travel_s, plain_pushes in ((0.03, 0), (0.2, 2), (0.2, 2)):
        strategy._motion.arrived_s = strategy._motion.left[0] + travel_s
        strategy._has_ended = False
        strategy.ended(10**9, arrived, True, True)
        assert strategy.correction.plain == plain_pushes
    pushes = [plain(push(strategy, 140.0)) for _ in range(30)]
    assert all(pushes[:6])
    assert not pushes[-1]

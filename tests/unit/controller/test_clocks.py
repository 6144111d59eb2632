"""What a unit learns of its valves by onsets of its pushes, and of the age of the speeds."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from controller.clocks import REFUSED, SAME_S, SETTLED, SPEEDS_S, UNKNOWN_S, Clocks, Delays

ONSET_S, MS = 0.03, 0.001


def settled(backward_s: float = 0.0, forward_s: float = 0.0) -> Clocks:
    """Return the clocks of a unit whose valves open so much later than at first."""
    made = Clocks()
    for _ in range(10):
        for direction in (0, 1):
            made.began(direction, ONSET_S)
    for _ in range(4):
        made.began(0, ONSET_S + backward_s)
        made.began(1, ONSET_S + forward_s)
    return made


def test_the_first_onsets_are_nominal_whatever_the_age_of_the_samples() -> None:
    clocks = Clocks()
    assert clocks.count == 0.0
    assert clocks.delays(0, ONSET_S) == Delays()
    for k in range(20):
        clocks.began(k % 2, ONSET_S + (0.2 if k % 4 < 2 else -0.2) * MS)
    assert clocks.origin_s == pytest.approx(ONSET_S, abs=0.06 * MS)
    assert clocks.delays(0, ONSET_S).driving_s == pytest.approx(0.0, abs=0.06 * MS)
    assert clocks.delays(1, None).driving_s == pytest.approx(0.0, abs=0.2 * MS)
    for _ in range(100):
        clocks.began(0, ONSET_S + 0.5 * MS)
    assert clocks.origin_s == pytest.approx(ONSET_S, abs=0.06 * MS), "settled"
    assert clocks.delays(0, None).driving_s == pytest.approx(0.5 * MS, abs=0.06 * MS), "followed"


@pytest.mark.parametrize(
    ("backward_ms", "forward_ms", "neutral_ms"),
    [(3.0, 3.0, 3.0), (3.0, 0.0, 0.0), (0.0, 3.0, 0.0), (3.0, 2.0, 2.0), (-1.0, 0.0, -1.0)],
)
def test_neutral_is_as_late_as_the_sooner_of_the_others(
    backward_ms: float, forward_ms: float, neutral_ms: float
) -> None:
    clocks = settled(backward_ms * MS, forward_ms * MS)
    for direction, driving_ms in enumerate((backward_ms, forward_ms)):
        for onset_s in (None, ONSET_S + driving_ms * MS):
            found = clocks.delays(direction, onset_s)
            assert found.driving_s == pytest.approx(driving_ms * MS, abs=0.3 * MS)
            assert found.neutral_s == pytest.approx(neutral_ms * MS, abs=0.3 * MS)
            assert not found.is_doubted


def test_an_onset_that_jumps_is_taken_when_another_confirms_it_and_the_other_is_in_doubt() -> None:
    clocks = settled()
    late_s = ONSET_S + 3.0 * MS
    assert clocks.delays(0, late_s).is_doubted
    clocks.began(0, late_s)
    assert clocks.delays(0, None).is_doubted and clocks.delays(1, None).is_doubted
    assert not clocks.delays(0, ONSET_S).is_doubted, "it was the sensor"
    assert not clocks.delays(1, ONSET_S).is_doubted, "this valve was not exchanged"
    assert clocks.delays(0, late_s).is_doubted, "neutral's may have been exchanged as well"
    clocks.began(0, late_s + 0.5 * SAME_S)
    assert clocks.delays(0, None).driving_s == pytest.approx(3.0 * MS, abs=SAME_S)
    assert clocks.delays(1, None).is_doubted
    assert not clocks.delays(1, late_s).is_doubted, "as late as the one that was confirmed"
    clocks.began(1, late_s)
    for direction in (0, 1):
        found = clocks.delays(direction, None)
        assert not found.is_doubted
        assert found.neutral_s == pytest.approx(3.0 * MS, abs=SAME_S)


def test_onsets_that_jump_here_and_there_are_never_taken() -> None:
    clocks = settled()
    for k in range(6):
        clocks.began(0, ONSET_S + (5.0 + 2.0 * k) * MS)
        assert clocks.delays(0, None).driving_s == pytest.approx(0.0, abs=1e-9)
        assert clocks.delays(0, None).is_doubted
    clocks.began(0, ONSET_S)
    assert not clocks.delays(0, None).is_doubted


def test_after_power_on_or_a_hidden_onset_another_one_is_needed() -> None:
    clocks = settled()
    clocks.doubt(1)
    assert clocks.delays(1, None).is_doubted and not clocks.delays(0, None).is_doubted
    assert not clocks.delays(1, ONSET_S).is_doubted
    clocks.began(1, ONSET_S)
    assert not clocks.delays(1, None).is_doubted
    new = Clocks()
    new.doubt(0, 1)
    assert new == Clocks()


def test_with_one_late_valve_from_the_beginning_the_sooner_one_is_nominal() -> None:
    for first in (0, 1):
        clocks = Clocks()
        clocks.began(first, ONSET_S + 3.0 * MS)
        clocks.began(1 - first, ONSET_S)
        assert clocks.delays(first, None)[:2] == pytest.approx((3.0 * MS, 0.0), abs=1e-9)
        assert clocks.delays(1 - first, None)[:2] == pytest.approx((0.0, 0.0), abs=1e-9)


def test_the_age_of_the_speeds_is_learned_and_what_does_not_fit_is_refused() -> None:
    clocks = Clocks()
    for _ in range(40):
        assert clocks.aged(0.004 - clocks.age_s)
    assert clocks.age_s == pytest.approx(0.004, abs=2e-4)
    assert clocks.variance == pytest.approx(SPEEDS_S**2 / 40.0, rel=0.1)
    for k in range(int(REFUSED)):
        assert clocks.variance < UNKNOWN_S**2, k
        assert not clocks.aged(0.02)
    assert clocks.variance == UNKNOWN_S**2
    assert clocks.age_s == pytest.approx(0.004, abs=2e-4)


@given(
    onsets=st.lists(st.tuples(st.integers(0, 1), st.floats(-0.1, 0.4)), min_size=1, max_size=60),
    ages=st.lists(st.floats(-0.1, 0.1), max_size=20),
)
def test_whatever_is_measured_the_numbers_are_those_of_a_unit(
    onsets: list[tuple[int, float]], ages: list[float]
) -> None:
    clocks = Clocks()
    for direction, onset_s in onsets:
        clocks.began(direction, onset_s)
    for later_s in ages:
        clocks.aged(later_s)
    again = Clocks.of(clocks.values)
    assert again == clocks
    assert clocks.count <= SETTLED
    for direction in (0, 1):
        found = clocks.delays(direction, None)
        assert found.neutral_s <= found.driving_s


@pytest.mark.parametrize("at", range(len(Clocks.LARGEST)))
def test_numbers_out_of_bounds_are_not_those_of_a_unit(at: int) -> None:
    for value in (float("nan"), float("inf"), 1.01 * Clocks.LARGEST[at], -1e9):
        values = list(settled().values)
        values[at] = value
        assert Clocks.of(values) is None

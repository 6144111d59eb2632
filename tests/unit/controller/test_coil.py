"""The current of a coil: fillings of the plant's valve end when they should."""

from __future__ import annotations

from math import log

import pytest
from hypothesis import given
from hypothesis import strategies as st

from controller.coil import HOLDING, LEAST, SETTLED, Coil
from plant.devices.coil import CoilConfig, CoilValve
from plant.devices.valve import Valve, ValveTiming

MS = 1_000_000
FULL, PERIOD_S, LATE_NS = 0.98, 0.01, 400_000
SHORTEST_S = 0.0255


def timing(close_s: float = 0.035) -> ValveTiming:
    slower = close_s / 0.035
    return ValveTiming(
        8 * MS, round(1e9 * close_s), 0.33, 0.35, True, 0.004 * slower, 0.0293 * slower
    )


def duties(end_s: float, close_s: float = 0.035) -> list[float]:
    """Return the duties of a filling that begins with the first of them and is to end at `end_s`."""
    coil, given = Coil(PERIOD_S, close_s), [FULL]
    coil.step(FULL)
    while given[-1] > 0.0:
        given.append(coil.duty_until(end_s - PERIOD_S * len(given), FULL))
        coil.step(given[-1])
    return given


def ends_s(given: list[float], valve: Valve) -> float:
    """Return when a valve closes that is given these duties, from the first command on."""
    for k, duty in enumerate(given):
        valve.command(LATE_NS + 10 * MS * k, duty)
    moves = valve.moves(10**9)
    assert [position for _, position in moves] == [1.0, 0.0]
    return 1e-9 * (moves[1][0] - LATE_NS)


@given(st.floats(SHORTEST_S, 0.2), st.floats(0.024, 0.048))
def test_a_filling_ends_when_it_should(length_s: float, close_s: float) -> None:
    """Within 2.5 ms: between the times that duties reach some are not, most of them in cold valves."""
    given = duties(length_s, close_s)
    found_s = ends_s(given, Valve(timing(close_s)))
    assert found_s == pytest.approx(length_s, abs=0.0025 if close_s > 0.036 else 0.0006)
    assert given[0] == FULL
    assert all(LEAST <= duty <= FULL for duty in given[:-1])


@pytest.mark.parametrize(
    ("close_s", "share", "most_s"),
    [(0.0237, 0.99, 3.5e-4), (0.035, 1.0, 3e-5), (0.040, 0.99, 7e-4), (0.0468, 0.97, 2.3e-3)],
)
def test_most_ends_are_met_to_a_tenth_of_a_millisecond(
    close_s: float, share: float, most_s: float
) -> None:
    """At 80, 20, 0 and -25 degrees Celsius."""
    lengths_s = [SHORTEST_S + 1e-4 * k for k in range(1500)]
    missed = [
        abs(ends_s(duties(each, close_s), Valve(timing(close_s))) - each) for each in lengths_s
    ]
    assert sum(each < 1e-4 for each in missed) >= share * len(missed)
    assert max(missed) < most_s


@pytest.mark.parametrize(
    ("length_s", "missed_s"), [(0.0305, 0.0), (0.0312, -0.0003), (0.0345, 0.0009)]
)
def test_an_end_in_a_cold_valve_that_no_duties_reach_is_met_by_the_nearer_one(
    length_s: float, missed_s: float
) -> None:
    """After two steps with the full duty the current is still small, after three it is too large."""
    found_s = ends_s(duties(length_s, 0.046875), Valve(timing(0.046875)))
    assert found_s - length_s == pytest.approx(missed_s, abs=1e-4)


@pytest.mark.parametrize("length_s", [0.030, 0.040, 0.055, 0.08, 0.12])
def test_the_magnetic_circuit_ends_a_filling_nearly_as_well(length_s: float) -> None:
    found_s = ends_s(duties(length_s), CoilValve(timing(), CoilConfig()))
    assert found_s == pytest.approx(length_s, abs=0.003)


def test_the_closing_delay_is_the_stated_one_after_a_long_full_duty() -> None:
    coil = Coil(PERIOD_S, 0.040)
    assert coil.closes_s() < 0.006
    for _ in range(60):
        coil.step(SETTLED)
    assert coil.closes_s() == pytest.approx(0.040)
    assert coil.current == pytest.approx(SETTLED)


def test_nothing_is_left_of_a_filling_that_should_have_ended() -> None:
    coil = Coil(PERIOD_S, 0.035)
    coil.step(FULL)
    assert coil.duty_until(-0.1, FULL) == 0.0
    assert coil.duty_until(coil.closes_s(), FULL) == 0.0
    assert coil.duty_until(0.3, FULL) < FULL
    assert coil.current < HOLDING
    assert coil.closes_s() == pytest.approx(0.035 - 0.0293 * log(SETTLED / HOLDING))

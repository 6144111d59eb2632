"""Causes that a truck's bus cannot separate: as diagnosed, and by another implementation."""

from __future__ import annotations

import numpy as np
import pytest

from tests.reference.truck import Pushed
from tests.support import bus_information as theory
from tests.support.bus_groups import NAMES, PHASE_S, compared, correlation, driven, lines


@pytest.mark.slow
def test_plain_pairs_come_out_by_both() -> None:
    sides = compared(driven(4))
    late, delayed = NAMES.index("valve_open_delay"), NAMES.index("sensor_delay")
    low, narrow = NAMES.index("supply_low"), NAMES.index("inlet_clog")
    for information in (sides.theory, sides.diagnosed):
        r = correlation(information)
        assert r[late, delayed] > 0.8
        # a stop that has moved is seen at rest, whatever the valves do
        assert abs(r[NAMES.index("stop_wear"), late]) < 0.3
        assert information[NAMES.index("valve_slow_close")] == pytest.approx(0.0, abs=1e-6)
        # a low supply hides in what is known of the supply: 3 %
        assert information[low, low] < 1.3 * (0.05 / 0.03) ** 2
        assert abs(r[low, narrow]) < 1.0
    assert any("pairs agree" in line for line in lines(sides))


def test_pulses_are_those_of_a_shift() -> None:
    pushed = Pushed("N-B", 30.0, 10.0, 0.40026, 0.70)
    times = theory.instants(pushed, PHASE_S)
    assert np.diff(times) == pytest.approx(0.01)
    assert -theory.BEFORE_S <= times[0] < -theory.BEFORE_S + 0.0105
    # a kink that the speed says all about adds nothing
    grid = np.linspace(-0.1, 0.1, 401)
    straight = theory.Pulses(pushed, np.zeros(1), np.zeros(1), np.full(1, 0.3), grid, 0.3 * grid)
    assert straight.kink_m2(1e-3) == pytest.approx(0.0, abs=1e-18)
    bent = theory.Pulses(
        pushed, np.zeros(1), np.zeros(1), np.zeros(1), grid, 0.3 * np.minimum(grid, 0.0)
    )
    assert bent.kink_m2(1e-3) == pytest.approx(0.5 * (0.3e-3) ** 2, rel=1e-6)

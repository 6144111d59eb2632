"""The safe states hold whatever one or two things fail, drawn at random."""

from __future__ import annotations

import pytest

from sil import safety
from sil.memory import run_in_memory
from sil.scenario import Scenario
from tests.faults.drawn import draw


def lies(scenario: Scenario) -> bool:
    """Whether the position reading may be wrong for good without looking so.

    One sensor cannot be told from a motion by itself; the fault table shows what happens then.
    """
    told = (*scenario.sensor_fault, *scenario.temperature_fault)
    return any(fault.kind in ("wrong", "stuck") for fault in told)


def check(first: int, count: int) -> None:
    shifted = reported = lying = 0
    for number in range(first, first + count):
        loaded = draw(number)
        run = run_in_memory(loaded)
        found = safety.figures(run.record, loaded.scenario)
        assert found["orphan_energised_s"] == 0.0, number
        if lies(loaded.scenario):
            lying += 1
        else:
            assert found["false_gear_s"] <= safety.sight_s(loaded.scenario), number
        shifted += bool(run.shifts) and run.shifts[-1].arrived_s is not None
        reported += found["fault_bits"] > 0
    # not vacuous: many shifts were done all the same, many faults were seen, few runs left aside
    assert shifted > 0.4 * count
    assert reported > 0.2 * count
    assert lying < 0.3 * count


def test_safe_states_hold() -> None:
    check(0, 60)


@pytest.mark.slow
def test_safe_states_hold_in_a_thousand_runs() -> None:
    check(60, 1000)

"""Tightening the tolerance a hundred times must not move a result that anybody reads."""

from __future__ import annotations

import numpy as np
import pytest

from plant.integrator.hybrid import DEFAULT_TOLERANCE
from plant.kernel.layout import FixedState, LengthState
from plant.systems.stroke import simulate
from tests.physics.bare import NOMINAL
from tests.physics.strokes import ALL, conditions_of

TIME_S = np.arange(0, 3001) * 1e-4
# A tenth of the acceptance limits.
POSITION_M, PRESSURE_PA, INSTANT_S, SPEED = 1e-6, 100.0, 2e-6, 2e-4


@pytest.mark.parametrize("name", sorted(ALL))
def test_results_are_converged(name: str) -> None:
    conditions = conditions_of(ALL[name])
    loose = simulate(NOMINAL, conditions, TIME_S, internal=False)
    tight = simulate(
        NOMINAL, conditions, TIME_S, tolerance=DEFAULT_TOLERANCE / 100.0, internal=False
    )
    moved = np.abs(loose.states - tight.states)
    first = FixedState.p_1 if conditions.kind == "fixed" else LengthState.p_b
    assert moved[:, 0].max() < POSITION_M
    assert moved[:, first : first + len(conditions.chambers)].max() < PRESSURE_PA
    assert loose.impact is not None and tight.impact is not None
    assert loose.impact.time_s == pytest.approx(tight.impact.time_s, abs=INSTANT_S)
    assert loose.impact.speed_m_s == pytest.approx(tight.impact.speed_m_s, rel=SPEED)
    assert np.any(loose.states != tight.states)

"""Command sequences in one batch arrive as the plant's own strokes do."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from plant.effects.stroke_conditions import FULL_DUTY
from plant.parameters import load as load_parameters
from plant.systems.stroke import simulate
from sil.studies.policies import GEARBOX, PUSH, arrivals_of

PARAMETERS = load_parameters("nominal")
BRAKED = (
    (0.0, "B", FULL_DUTY),
    (0.08, "N", FULL_DUTY),
    (0.09, "B", 0.0),
    (0.1, "B", FULL_DUTY),
    (0.11, "N", 0.0),
)


def test_each_sequence_and_load_is_the_stroke_that_the_plant_makes() -> None:
    arrivals = arrivals_of(PARAMETERS, GEARBOX, [PUSH.commands, BRAKED])
    assert arrivals.arrival_s.shape == (2, len(GEARBOX))
    for commands, row in ((PUSH.commands, 0), (BRAKED, 1)):
        stroke = simulate(
            PARAMETERS, replace(GEARBOX[2], commands=commands), np.array([0.0, 0.3]), internal=False
        )
        assert stroke.impact is not None
        revealed_s = next(event.time_s for event in stroke.events if event.name == "unblock")
        assert arrivals.impact_stay_m_s[row, 2] == pytest.approx(stroke.impact.speed_m_s, rel=1e-3)
        assert arrivals.arrival_s[row, 2] == pytest.approx(stroke.impact.time_s, abs=2e-6)
        assert arrivals.revealed_s[row, 2] == pytest.approx(revealed_s, abs=2e-6)
        assert (arrivals.impact_worst_m_s[row] >= arrivals.impact_stay_m_s[row] - 1e-9).all()
    assert (np.diff(arrivals.revealed_s[0]) > 0.0).all()


def test_a_late_arrival_has_no_impact() -> None:
    late = ((0.045, "B", FULL_DUTY),)
    arrivals = arrivals_of(PARAMETERS, GEARBOX, [late], limit_s=0.06)
    assert np.isinf(arrivals.impact_stay_m_s).all()

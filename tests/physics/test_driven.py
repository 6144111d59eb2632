"""The chambers alone, driven by a motion, give back what the whole model gave."""

from __future__ import annotations

import numpy as np
import pytest

from plant.effects.setup import Setup
from plant.effects.stroke_conditions import StrokeConditions
from plant.parameters import load
from plant.systems.driven import pressures_along
from plant.systems.setup import make_setup
from plant.systems.stroke import Stroke, run_setup

TIME_S = np.arange(2501) * 1e-4


def made() -> tuple[Setup, Stroke]:
    setup = make_setup(load(), StrokeConditions("fixed", 9e5, ((0.01, "1", 0.98),)))
    return setup, run_setup(setup, TIME_S, internal=False)


def pressures_of(stroke: Stroke) -> np.ndarray:
    names = stroke.conditions.chambers
    return np.column_stack([stroke.pressure_pa(name) for name in names])


def test_the_motion_gives_back_the_pressures() -> None:
    setup, stroke = made()
    true = pressures_of(stroke)
    found = pressures_along(setup, TIME_S, stroke.position_m)
    assert np.sqrt(np.mean((found - true) ** 2, axis=0)).max() < 500.0
    assert np.ptp(true, axis=0).max() > 4e5
    # friction of the stay plays no part, a volume does
    rough = setup.copy()
    rough.p.f_run_s *= 3.0
    assert pressures_along(rough, TIME_S, stroke.position_m) == pytest.approx(found, rel=1e-6)
    large = setup.copy()
    large.p[setup.volume_index(setup.charged_chamber)] *= 1.1
    assert np.abs(pressures_along(large, TIME_S, stroke.position_m) - true).max() > 5e3

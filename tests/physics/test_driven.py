"""One equation at a time gives back what the whole model gave, and differs where a part differs."""

from __future__ import annotations

import numpy as np
import pytest

from plant.effects.setup import Setup
from plant.effects.stroke_conditions import StrokeConditions
from plant.parameters import load
from plant.systems.imposed import motion_along, pressures_along
from plant.systems.setup import make_setup
from plant.systems.stroke import Stroke, run_setup

TIME_S = np.arange(2501) * 1e-4
STROKES = {
    "fixed": ((), {}),
    "N-B": (("N",), {}),
    "B-N": (("B",), {}),
    "F-N": ((), {}),
    "N-F": (("N",), {"mounted": True, "mesh_force_n": 500.0, "sync_impulse_n_s": 8.0}),
}


def made(kind: str) -> tuple[Setup, Stroke]:
    charged, more = STROKES[kind]
    valve = "1" if kind == "fixed" else kind[-1]
    commands = ((0.01, valve, 0.98), *((0.01, old, 0.0) for old in charged))
    conditions = StrokeConditions(kind, 9e5, commands, charged_before=charged, **more)
    setup = make_setup(load(), conditions)
    return setup, run_setup(setup, TIME_S, internal=False)


def pressures_of(stroke: Stroke) -> np.ndarray:
    names = stroke.conditions.chambers
    return np.column_stack([stroke.pressure_pa(name) for name in names])


@pytest.mark.parametrize("kind", sorted(STROKES))
def test_the_motion_gives_back_the_pressures(kind: str) -> None:
    setup, stroke = made(kind)
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


@pytest.mark.parametrize("kind", sorted(STROKES))
def test_the_pressures_give_back_the_motion(kind: str) -> None:
    setup, stroke = made(kind)
    found = motion_along(setup, TIME_S, pressures_of(stroke))
    assert np.ptp(found) > 0.012
    assert np.sqrt(np.mean((found - stroke.position_m) ** 2)) < 2e-5
    # a volume plays no part, friction does
    large = setup.copy()
    large.p.vol_b *= 1.1
    assert np.array_equal(motion_along(large, TIME_S, pressures_of(stroke)), found)
    rough = setup.copy()
    rough.p.f_run_s *= 3.0
    changed = motion_along(rough, TIME_S, pressures_of(stroke))
    assert np.abs(changed - stroke.position_m).max() > 1e-4


def test_pressures_of_the_wrong_shape_are_refused() -> None:
    setup, _stroke = made("fixed")
    with pytest.raises(ValueError, match="samples x chambers"):
        motion_along(setup, TIME_S, np.zeros((len(TIME_S), 3)))

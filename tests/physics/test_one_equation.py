"""One equation at a time: the damper's pressure from a known motion."""

from __future__ import annotations

import numpy as np
import pytest

from plant.kernel.layout import FIXED, LENGTH
from plant.kernel.packing import Load, pack
from plant.parts.damper import steady_oil_pressure
from tests.physics.bare import NOMINAL
from tests.reference import parts

VALUES = parts.nominal()


@pytest.mark.parametrize("system", [FIXED, LENGTH])
def test_oil_pressure_of_a_known_motion_is_3_34_along_it(system: int) -> None:
    p = pack(NOMINAL, system, supply_pressure_pa=9e5, atmosphere_pa=99000.0, load=Load())
    position = np.linspace(0.0, 0.01285, 60)
    velocity = 0.5 * np.cos(300.0 * position)
    out = np.zeros(60)
    steady_oil_pressure(position, velocity, p.array, out)
    expected = [
        99000.0 + parts.oil_pressure(x, v, VALUES) for x, v in zip(position, velocity, strict=True)
    ]
    assert out == pytest.approx(expected, rel=1e-9)
    assert out[velocity < 0.0] == pytest.approx(99000.0)


def test_the_damper_acts_away_from_neutral_on_either_side() -> None:
    p = pack(NOMINAL, LENGTH, supply_pressure_pa=9e5, atmosphere_pa=101325.0, load=Load())
    position = np.array([0.005, 0.005, -0.005, -0.005, 0.0, 0.0])
    velocity = np.array([0.4, -0.4, 0.4, -0.4, 0.4, -0.4])
    out = np.zeros(6)
    steady_oil_pressure(position, velocity, p.array, out)
    acting = out > 101326.0
    assert acting.tolist() == [True, False, False, True, True, True]
    assert out[0] == out[3] and out[4] == out[5]

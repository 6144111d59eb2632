"""Chamber pressure: the limits, the equation itself, and the chambers alone, driven by a motion."""

from __future__ import annotations

import numpy as np
import pytest

from plant.effects.setup import Setup
from plant.effects.stroke_conditions import StrokeConditions
from plant.kernel.layout import FIXED, LENGTH, FixedState, LengthState, Parameters
from plant.parameters import load
from plant.systems.setup import make_setup
from plant.systems.stroke import Stroke, run_setup
from tests.physics.bare import SMOOTH, Bare
from tests.support.driven import pressures_along

SHUT = {Parameters.k_in: 0.0, Parameters.k_out: 0.0}


@pytest.mark.parametrize("exponent", [1.0, 1.4])
@pytest.mark.parametrize("force", [150.0, 900.0])
def test_shut_fixed_piston_keeps_p_v_to_the_exponent(exponent: float, force: float) -> None:
    rig = Bare(
        FIXED,
        {
            **SHUT,
            Parameters.alpha_1: exponent,
            Parameters.alpha_2: exponent,
            Parameters.f_external: force,
        },
    )
    _, y = rig.samples(0.1, 300)
    p = rig.packed
    assert np.ptp(y[:, FixedState.x]) > 1e-3  # it moved
    for pressure, volume in (
        (y[:, FixedState.p_1], p.vol_b + p.area_p * y[:, FixedState.x]),
        (y[:, FixedState.p_2], p.vol_n - p.area_p2 * y[:, FixedState.x]),
    ):
        product = pressure * volume**exponent
        assert product == pytest.approx(np.full(len(product), product[0]), rel=1e-6)


@pytest.mark.parametrize("exponent", [1.0, 1.4])
def test_shut_length_stroke_keeps_p_v_to_the_exponent(exponent: float) -> None:
    changes = {**SHUT, **SMOOTH, Parameters.alpha_1: exponent, Parameters.alpha_2: exponent}
    rig = Bare(LENGTH, changes, {LengthState.p_b: 5e5, LengthState.p_f: 1.5e5})
    _, y = rig.samples(0.1, 300)
    p = rig.packed
    ap, a_s = p.area_p, p.area_s
    assert np.ptp(y[:, LengthState.x_s]) > 5e-3 and np.ptp(y[:, LengthState.x_1]) > 5e-3
    for pressure, volume in (
        (y[:, LengthState.p_b], p.vol_b + ap * y[:, LengthState.x_1] + a_s * y[:, LengthState.x_s]),
        (y[:, LengthState.p_n], p.vol_n - ap * (y[:, LengthState.x_1] + y[:, LengthState.x_2])),
        (y[:, LengthState.p_f], p.vol_f + ap * y[:, LengthState.x_2] - a_s * y[:, LengthState.x_s]),
    ):
        product = pressure * volume**exponent
        assert product == pytest.approx(np.full(len(product), product[0]), rel=1e-6)


TIME_S = np.arange(2501) * 1e-4


def made() -> tuple[Setup, Stroke]:
    setup = make_setup(load(), StrokeConditions("fixed", 9e5, ((0.01, "1", 0.98),)))
    return setup, run_setup(setup, TIME_S, internal=False)


def pressures_of(stroke: Stroke) -> np.ndarray:
    return np.column_stack([stroke.pressure_pa(name) for name in stroke.conditions.chambers])


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

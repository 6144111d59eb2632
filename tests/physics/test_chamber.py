"""Chamber pressure: the isothermal and the adiabatic limit, and the equation itself."""

from __future__ import annotations

import numpy as np
import pytest

from plant.kernel import layout as L
from plant.parts.chamber import pressure_rate
from tests.physics.bare import SMOOTH, Bare

SHUT = {L.K_IN: 0.0, L.K_OUT: 0.0}


@pytest.mark.parametrize("exponent", [1.0, 1.4])
@pytest.mark.parametrize("force", [150.0, 900.0])
def test_shut_fixed_piston_keeps_p_v_to_the_exponent(exponent: float, force: float) -> None:
    rig = Bare(L.FIXED, {**SHUT, L.ALPHA_1: exponent, L.ALPHA_2: exponent, L.F_EXTERNAL: force})
    _, y = rig.samples(0.1, 300)
    p = rig.packed
    assert np.ptp(y[:, L.FX]) > 1e-3  # it moved
    for pressure, volume in (
        (y[:, L.FP1], p[L.VOL_B] + p[L.AREA_P] * y[:, L.FX]),
        (y[:, L.FP2], p[L.VOL_N] - p[L.AREA_P2] * y[:, L.FX]),
    ):
        product = pressure * volume**exponent
        assert product == pytest.approx(np.full(len(product), product[0]), rel=1e-6)


@pytest.mark.parametrize("exponent", [1.0, 1.4])
def test_shut_length_stroke_keeps_p_v_to_the_exponent(exponent: float) -> None:
    changes = {**SHUT, **SMOOTH, L.ALPHA_1: exponent, L.ALPHA_2: exponent}
    rig = Bare(L.LENGTH, changes, {L.PB: 5e5, L.PF: 1.5e5})
    _, y = rig.samples(0.1, 300)
    p = rig.packed
    ap, a_s = p[L.AREA_P], p[L.AREA_S]
    assert np.ptp(y[:, L.XS]) > 5e-3 and np.ptp(y[:, L.X1]) > 5e-3
    for pressure, volume in (
        (y[:, L.PB], p[L.VOL_B] + ap * y[:, L.X1] + a_s * y[:, L.XS]),
        (y[:, L.PN], p[L.VOL_N] - ap * (y[:, L.X1] + y[:, L.X2])),
        (y[:, L.PF], p[L.VOL_F] + ap * y[:, L.X2] - a_s * y[:, L.XS]),
    ):
        product = pressure * volume**exponent
        assert product == pytest.approx(np.full(len(product), product[0]), rel=1e-6)


def test_isothermal_and_adiabatic_rates_differ_by_gamma_alone() -> None:
    rates = [
        pressure_rate.py_func(3e5, 0.0, 0.0, 0.0, 0.0, 1e-4, 2e-4, 287.05, 1.0, 1.0, 1.0, a)
        for a in (1.0, 1.4)
    ]
    assert rates[0] == pytest.approx(-3e5 * 2e-4 / 1e-4)
    assert rates[1] == pytest.approx(1.4 * rates[0])


def test_exponents_follow_the_valves_actual_position() -> None:
    def rate(u: float) -> float:
        return float(
            pressure_rate.py_func(3e5, u, 0.5, 0.7, 0.0, 1e-4, 2e-4, 287.05, 0.94, 0.87, 1.5, 1.05)
        )

    assert rate(1.0) == pytest.approx((287.05 * 0.94 * 0.5 - 0.87 * 3e5 * 2e-4) / 1e-4)
    assert rate(0.0) == pytest.approx((-287.05 * 1.5 * 0.7 - 1.05 * 3e5 * 2e-4) / 1e-4)

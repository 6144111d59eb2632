"""Chamber pressure: the isothermal and the adiabatic limit, and the equation itself."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from plant.kernel.layout import FIXED, LENGTH, FixedState, LengthState, Parameters
from plant.parts import chamber
from plant.parts.chamber import pressure_rate
from tests.physics.bare import SMOOTH, Bare

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


def test_isothermal_and_adiabatic_rates_differ_by_gamma_alone() -> None:
    rates = [pressure_rate.py_func(3e5, 0.0, a, 1e-4, 2e-4) for a in (1.0, 1.4)]
    assert rates[0] == pytest.approx(-3e5 * 2e-4 / 1e-4)
    assert rates[1] == pytest.approx(1.4 * rates[0])


def test_exponents_follow_the_valves_actual_position(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(chamber, "valve_flow_in", lambda *_: 0.5)
    monkeypatch.setattr(chamber, "valve_flow_out", lambda *_: 0.7)
    monkeypatch.setattr(chamber, "pressure_rate", pressure_rate.py_func)
    monkeypatch.setattr(chamber, "openings", lambda u, _: (u, 1.0 - u))
    gas = SimpleNamespace(r_air=287.05)

    def rate(u: float) -> float:
        exponents = (0.94, 0.87, 1.5, 1.05)
        return float(chamber.chamber.py_func(3e5, u, 0.0, 1e-4, 2e-4, 9e5, exponents, gas, None)[0])

    assert rate(1.0) == pytest.approx((287.05 * 0.94 * 0.5 - 0.87 * 3e5 * 2e-4) / 1e-4)
    assert rate(0.0) == pytest.approx((-287.05 * 1.5 * 0.7 - 1.05 * 3e5 * 2e-4) / 1e-4)

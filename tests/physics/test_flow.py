"""Valve flows: the maps, the theoretical flow, and filling of a fixed volume."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from plant.kernel.layout import FIXED, FixedState, FlowMap, Parameters
from plant.kernel.packing import flow_coefficients
from plant.parts.flow import charge, discharge, orifice
from tests.physics.bare import NOMINAL, STUCK, Bare
from tests.reference.parts import theoretical_flow

C = FlowMap(flow_coefficients(NOMINAL))
P_ATM = 101325.0
SUPPLIES = (6e5, 9e5)
CRITICAL = (2.0 / 2.4) ** 3.5


def ideal(upstream: float, downstream: float) -> float:
    """The kernel's theoretical flow through 1 mm^2."""
    return float(orifice.py_func(upstream, downstream, 1e-6, 293.15, 1.4, 287.05))


@pytest.mark.parametrize("supply", SUPPLIES)
def test_charge_map_has_its_root_at_the_supply(supply: float) -> None:
    choked = charge.py_func(0.3 * supply, supply, C)
    assert abs(charge.py_func(supply, supply, C)) < 1e-7 * choked
    assert (
        charge.py_func(0.999 * supply, supply, C) > 0.0 > charge.py_func(1.001 * supply, supply, C)
    )


def test_discharge_map_has_its_root_at_the_atmosphere() -> None:
    assert abs(discharge.py_func(P_ATM, P_ATM, C)) < 1e-7 * discharge.py_func(9e5, P_ATM, C)
    assert discharge.py_func(1.001 * P_ATM, P_ATM, C) > 0.0 > discharge.py_func(9e4, P_ATM, C)


def test_maps_do_not_jump_and_do_not_kink_at_their_joints() -> None:
    for flow, joint, scale in (
        (lambda x: charge.py_func(x * 9e5, 9e5, C) / 9e5, 0.55, 1.6e-6),
        (lambda x: charge.py_func(x * 9e5, 9e5, C) / 9e5, 1.0, 1.6e-6),
        (lambda x: discharge.py_func(x * P_ATM, P_ATM, C) / P_ATM, 3.0, 7e-6),
        (lambda x: discharge.py_func(x * P_ATM, P_ATM, C) / P_ATM, 1.0, 7e-6),
    ):
        step = 1e-6
        assert abs(flow(joint + 1e-12) - flow(joint - 1e-12)) < 1e-7 * scale
        before = (flow(joint - 1e-12) - flow(joint - step)) / step
        after = (flow(joint + step) - flow(joint + 1e-12)) / step
        assert after == pytest.approx(before, rel=2e-4)


def test_theoretical_flow_is_continuous_at_the_critical_ratio() -> None:
    assert pytest.approx(0.5283, abs=5e-5) == CRITICAL
    below = ideal(9e5, 9e5 * CRITICAL * (1.0 - 1e-12))
    assert ideal(9e5, 9e5 * CRITICAL * (1.0 + 1e-12)) == pytest.approx(below, rel=1e-9)
    assert ideal(9e5, 1e5) == below


def test_theoretical_flow_falls_to_zero_at_equal_pressures_and_changes_sign() -> None:
    assert ideal(9e5, 9e5) == 0.0
    flows = [ideal(9e5, 9e5 * ratio) for ratio in np.linspace(CRITICAL, 1.0, 200)]
    assert all(late < early for early, late in pairwise(flows))
    assert ideal(2e5, 5e5) == -ideal(5e5, 2e5)


@given(st.floats(1e5, 1.2e6), st.floats(0.05, 0.9985))
def test_theoretical_flow_agrees_with_3_12_to_3_20_step_by_step(
    upstream: float, ratio: float
) -> None:
    expected = theoretical_flow(upstream, ratio * upstream, 1e-6, 1.0, 293.15, 1.4, 287.05)
    assert ideal(upstream, ratio * upstream) == pytest.approx(expected, rel=1e-9)


def filling(volume_m3: float, changes: dict[int, float], charged: bool = False) -> Bare:
    """Chamber 1 of a stuck fixed piston, by the theoretical flow through 2 mm^2."""
    orifices = {Parameters.flow_model: 1.0, Parameters.cda_in: 2e-6, Parameters.cda_out: 2e-6}
    start = {FixedState.p_1: 9e5} if charged else {}
    return Bare(FIXED, {**STUCK, **orifices, Parameters.vol_b: volume_m3, **changes}, start)


@pytest.mark.parametrize("exponent", [1.0, 1.4])
def test_choked_filling_goes_at_a_constant_rate(exponent: float) -> None:
    volume = 1e-4
    rig = filling(volume, {Parameters.alpha_m1: exponent})
    slope = exponent * 287.05 * ideal(9e5, 1e5) * 2.0 / volume
    end = (CRITICAL * 9e5 - P_ATM) / slope
    times, states = rig.samples(0.999 * end, 50, [(0, 0, 1.0)])
    assert states[:, FixedState.p_1] == pytest.approx(P_ATM + slope * times, rel=1e-9)
    assert rig.balance().air_in_kg == pytest.approx(
        slope * times[-1] * volume / exponent / 287.05 / 293.15
    )


def test_choked_emptying_is_exponential() -> None:
    volume = 1e-4
    rig = filling(volume, {Parameters.alpha_m2: 1.0}, charged=True)
    rate = 287.05 * ideal(9e5, P_ATM) / 9e5 * 2.0 / volume
    end = math.log(9e5 * CRITICAL / P_ATM) / rate
    times, states = rig.samples(0.999 * end, 50)
    assert states[:, FixedState.p_1] == pytest.approx(9e5 * np.exp(-rate * times), rel=1e-7)


def test_the_same_map_fills_three_times_the_volume_in_three_times_the_time() -> None:
    fields = []
    for factor in (1.0, 3.0):
        rig = Bare(FIXED, {**STUCK, Parameters.vol_b: factor * 1e-4})
        _times, states = rig.samples(0.05 * factor, 100, [(0, 0, 1.0)])
        fields.append(states[:, FixedState.p_1])
    assert fields[1] == pytest.approx(fields[0], rel=1e-6) and fields[0][-1] > 3e5

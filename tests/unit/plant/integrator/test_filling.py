"""Filling curves against the integrated flow, and rests against the stepping kernel."""

from __future__ import annotations

import numba
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from plant.integrator import filling
from plant.integrator.filling import (
    CELLS_FAR,
    CURVE,
    TABLE,
    Curve,
    curve_of,
    curve_tau,
    curve_value,
    tabulate,
    vented,
)
from plant.kernel.layout import LENGTH, LengthState
from plant.kernel.packing import flow_coefficients, initial_state
from plant.kernel.views import view
from plant.parameters import load
from tests.physics.bare import MS, STUCK, Bare

CHARGE, DISCHARGE = 0, CURVE


@pytest.fixture(scope="module")
def flow():
    return flow_coefficients(load())


@pytest.fixture(scope="module")
def table(flow):
    table = np.zeros(TABLE)
    assert tabulate(flow, table)
    return table


@numba.njit
def values(table, place, tau):
    out = np.zeros(len(tau))
    curve = curve_of(view(table, place))
    for i in range(len(tau)):
        out[i] = curve_value(curve, tau[i])
    return out


@numba.njit
def places(table, place, ratio):
    out = np.zeros(len(ratio))
    curve = curve_of(view(table, place))
    for i in range(len(ratio)):
        out[i] = curve_tau(curve, ratio[i])
    return out


def polynomial(flow, start, count, r):
    return sum(flow[start + k] * r**k for k in range(count))


def phi(flow, charging, r):
    """The maps written anew, from the conventions of the parameter file."""
    if charging:
        if r < flow[1]:
            return polynomial(flow, 2, 4, max(r, flow[0]))
        return polynomial(flow, 6, 5, r)
    return polynomial(flow, 13, 5, r) if r < flow[12] else polynomial(flow, 18, 3, r)


@pytest.mark.parametrize("place, charging", [(CHARGE, True), (DISCHARGE, False)])
def test_curve_is_the_integral_of_the_flow(flow, table, place, charging):
    head = Curve(table[place:])
    sign = 1.0 if charging else -1.0
    border = head.step_far * CELLS_FAR

    def rate(_, r):
        return [sign * phi(flow, charging, r[0]) / head.rate]

    for start, first, last in ((head.start, 0.0, border), (head.split, border, border + 18.0)):
        tau = np.linspace(first, last, 400)[1:-1]
        truth = solve_ivp(
            rate, (first, last), [start], method="DOP853", rtol=1e-12, atol=1e-14, t_eval=tau
        ).y[0]
        error = values(table, place, tau) - truth
        assert np.abs(error).max() < 1e-9


@pytest.mark.parametrize("place", [CHARGE, DISCHARGE])
def test_place_is_the_inverse_of_value(table, place):
    tau = np.linspace(0.0, Curve(table[place:]).step_far * CELLS_FAR + 15.0, 2001)
    ratio = values(table, place, tau)
    assert (np.diff(ratio) * (1.0 if place == CHARGE else -1.0) > 0.0).all()
    # near the end the ratio itself resolves tau no better
    slope = np.abs(np.gradient(ratio, tau))
    assert (np.abs(places(table, place, ratio) - tau) < 1e-10 + 1e-15 / slope).all()


def test_beyond_the_table(flow, table):
    start, slope = flow[0], phi(flow, True, flow[0]) / Curve(table).rate
    below = values(table, CHARGE, np.array([-0.01]))[0]
    assert below == pytest.approx(start - 0.01 * slope, abs=1e-15)
    border = Curve(table).step_far * CELLS_FAR
    end = border + filling.NEAR_REACH
    left, right = values(table, CHARGE, np.array([end + 1.0, end + 2.0])) - 1.0
    assert left < 0.0
    assert right == pytest.approx(left * np.exp(-1.0), abs=0.006 * abs(left))


def test_what_fades_beyond_the_table_is_nothing(table) -> None:
    """exp by its reciprocal's series: 2.3e-3 of what the table leaves, itself under a ten-millionth."""
    x = np.linspace(0.0, 60.0, 6001)
    faded = np.array([filling.faded.py_func(value) for value in x.tolist()])
    assert np.max(np.abs(faded - np.exp(-x))) < 2.5e-3
    assert np.all(np.diff(faded) < 0.0)
    for begin in (CHARGE, DISCHARGE):
        assert abs(Curve(table[begin:]).end - 1.0) < 1e-7


def test_what_is_left_in_a_vented_chamber_is_what_the_kernel_leaves(flow) -> None:
    rig = Bare(LENGTH, STUCK, charged=("B", "F"))
    full = rig.state(LengthState.p_b)
    start = initial_state(LENGTH, rig.packed, position="N", charged=())
    rig.advance(0, [(0, 0, 0.0), (0, 2, 0.0)])
    for at_ms in (5, 40, 150):
        rig.advance(at_ms * MS)
        since_s = np.array([[at_ms * 1e-3, np.inf, 0.0]])
        left = vented(since_s, rig.packed.array[None], flow, start[None])[0]
        assert full > rig.state(LengthState.p_b) > left[LengthState.p_n] == 101325.0
        assert left[LengthState.p_b] == pytest.approx(rig.state(LengthState.p_b), rel=1e-6)
        assert left[LengthState.p_f] == pytest.approx(full)
    assert vented(since_s, rig.packed.array[None], 0.0 * flow, start[None])[0] == pytest.approx(
        start
    )


def test_maps_that_do_not_close_have_no_curve(flow):
    broken = flow.copy()
    broken[6] += 1e-7  # the charge flow no longer ends at the supply pressure
    assert not tabulate(broken, np.zeros(TABLE))
    broken = flow.copy()
    broken[13] -= 2e-6  # the discharge flow turns before it reaches the atmosphere
    assert not tabulate(broken, np.zeros(TABLE))

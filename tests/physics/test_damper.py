"""Oil damper: areas, steady speed, oil spring, decay after the stop, limits; its pressure of a known motion."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.optimize import brentq

from plant.kernel.layout import FIXED, LENGTH, FixedState, Parameters
from plant.kernel.packing import Load, pack
from plant.parts.damper import large_area, steady_oil_pressure
from plant.systems.stroke import StrokeConditions, simulate
from tests.physics.bare import AIRLESS, MS, NOMINAL, SMOOTH, STUCK, Bare
from tests.reference import parts

R_HOLE, X_HOLE, CAP = 0.0015, 0.0065, 1e-5
FREE = {**AIRLESS, **SMOOTH}
A_OIL, RHO = 4e-4, 870.0


def area(x: float) -> float:
    """The kernel's large outlet at a distance x."""
    return float(large_area.py_func(x, CAP, R_HOLE, X_HOLE))


@pytest.mark.parametrize("covered", [0.0003, 0.0011, 0.0015, 0.0019, 0.0028])
def test_hole_area_is_that_of_two_circles_cut_by_a_straight_edge(covered: float) -> None:
    half = quad(
        lambda s: 2.0 * math.sqrt(R_HOLE**2 - s * s), covered - R_HOLE, R_HOLE, epsabs=1e-15
    )[0]
    assert area(X_HOLE + covered) == pytest.approx(min(CAP, 2.0 * half), rel=1e-7)


def test_outlet_is_capped_until_x_r_and_shut_past_the_holes() -> None:
    x_r = NOMINAL.value("damper.x_r")
    assert area(0.0) == area(X_HOLE) == area(x_r - 1e-5) == CAP
    assert area(x_r) == pytest.approx(CAP, rel=1e-5) and area(x_r + 1e-5) < CAP
    assert area(X_HOLE + 2.0 * R_HOLE) == area(0.0125) == 0.0


@pytest.mark.parametrize("model", ["incompressible", "compressible"])
@pytest.mark.parametrize("force", [50.0, 200.0])
def test_a_constant_force_reaches_the_steady_speed(model: str, force: float) -> None:
    changes = {
        **FREE, Parameters.f_external: force, Parameters.stroke: 9.0, Parameters.x_hole: 9.0,
        Parameters.v_oil: 5e-3,
    }  # fmt: skip
    rig = Bare(FIXED, changes, damper=model)
    rig.advance(800 * MS)

    def excess(v: float) -> float:
        outlet = (2.1e-6 + CAP) * (1.0 + 0.65 * v)
        return A_OIL * 0.5 * RHO * (A_OIL * v / outlet) ** 2 - force

    assert 0.1 < rig.position_m < 9.0
    assert rig.velocity_m_s == pytest.approx(brentq(excess, 0.0, 10.0, xtol=1e-12), rel=1e-7)


def test_on_the_way_back_the_damper_does_not_act() -> None:
    for model in ("incompressible", "compressible"):
        rig = Bare(FIXED, FREE, {FixedState.v: -0.5}, place=0.01, damper=model)
        rig.advance(10 * MS)
        assert rig.velocity_m_s == pytest.approx(-0.5, rel=1e-9)
        assert rig.position_m == pytest.approx(0.005, rel=1e-9)


def test_shut_oil_is_a_spring() -> None:
    kappa, volume, mass = 1.724e8, 2.7e-5, 1.1
    changes = {**FREE, Parameters.a_small: 0.0, Parameters.x_hole: -1.0}
    rig = Bare(FIXED, changes, {FixedState.v: 0.01}, damper="compressible")
    rig.advance(5 * MS)
    turn = rig.events[0]
    assert turn.name == "turn"
    omega = math.sqrt(kappa * A_OIL**2 / (volume * mass))
    assert turn.time_s == pytest.approx(0.5 * math.pi / omega, rel=1e-3)
    assert turn.position_m == pytest.approx(0.01 / omega, rel=1e-3)


@pytest.mark.parametrize("tolerance", [1e-8, 1e-10])
def test_pressure_after_the_stop_falls_as_a_parabola(tolerance: float) -> None:
    start, x = 2.5e6, 0.01285
    rig = Bare(
        FIXED,
        STUCK,
        {FixedState.p_oil: 101325.0 + start},
        place=x,
        damper="compressible",
        tolerance=tolerance,
    )
    times, y = rig.samples(0.02, 400)
    volume = 2.7e-5 - A_OIL * x
    slope = 0.5 * 1.724e8 / volume * 0.65 * 2.1e-6 * math.sqrt(2.0 / RHO)
    root = np.maximum(math.sqrt(start) - slope * times, 0.0)
    assert y[:, FixedState.p_oil] - 101325.0 == pytest.approx(root**2, abs=20.0)
    # erratum "two fall times": a constant bulk modulus has one ratio
    fall = [(math.sqrt(0.9) - math.sqrt(level)) for level in (0.2, 0.1)]
    assert fall[1] / fall[0] == pytest.approx(1.26, abs=0.01)


def test_stiff_oil_approaches_the_incompressible_model() -> None:
    speeds = []
    for model, kappa in (("incompressible", 1.0), ("compressible", 1.724e10)):
        parameters = NOMINAL.override({"damper.kappa_effective": kappa})
        conditions = StrokeConditions(
            "fixed", 9e5, ((0.01, "1", 0.98),), load="damper", damper_model=model
        )
        stroke = simulate(parameters, conditions, np.array([0.0, 0.2]), internal=False)
        speeds.append(stroke.impact.speed_m_s)
    assert speeds[1] == pytest.approx(speeds[0], rel=2e-2)


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

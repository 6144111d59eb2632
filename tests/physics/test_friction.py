"""Set-valued friction: ballistic motion, Coulomb stop, dry oscillation, sticking, no chatter."""

from __future__ import annotations

import math

import numpy as np
import pytest

from plant.kernel.layout import FIXED, FixedState, Parameters
from plant.systems.stroke import StrokeConditions, simulate
from tests.physics.bare import AIRLESS, MS, NOMINAL, SMOOTH, STUCK, Bare

FREE = {**AIRLESS, **SMOOTH, Parameters.stroke: 10.0}
MASS = 1.1


def test_without_air_and_friction_a_body_flies_straight_and_falls_in_parabolas() -> None:
    rig = Bare(FIXED, FREE, {FixedState.x: 0.1, FixedState.v: 0.7})
    times, y = rig.samples(0.5, 20)
    assert y[:, FixedState.x] == pytest.approx(0.1 + 0.7 * times, rel=1e-12)
    rig = Bare(FIXED, {**FREE, Parameters.f_external: 5.5}, {FixedState.x: 0.1, FixedState.v: -0.7})
    times, y = rig.samples(0.5, 20)
    assert y[:, FixedState.x] == pytest.approx(0.1 - 0.7 * times + 2.5 * times**2, abs=1e-11)
    assert rig.names() == ["turn"]
    assert rig.events[0].time_s == pytest.approx(0.7 * MASS / 5.5, abs=1e-10)


def test_coulomb_friction_stops_within_m_v2_over_2_f() -> None:
    rig = Bare(
        FIXED, {**FREE, Parameters.f_run_s: 20.0, Parameters.f_static_s: 30.0}, {FixedState.v: 1.5}
    )
    rig.advance(1000 * MS)
    assert rig.names() == ["turn"]
    assert rig.events[0].time_s == pytest.approx(MASS * 1.5 / 20.0, abs=1e-10)
    assert rig.position_m == pytest.approx(MASS * 1.5**2 / 40.0, abs=1e-11)
    assert rig.velocity_m_s == 0.0
    assert rig.balance().friction_j == pytest.approx(0.5 * MASS * 1.5**2, rel=1e-9)


@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_coulomb_and_viscous_friction_stop_as_the_logarithm_says(direction: float) -> None:
    force, beta, speed = 50.9, 38.8, 2.0
    changes = {
        **FREE,
        Parameters.f_run_s: force,
        Parameters.f_static_s: force,
        Parameters.beta_s: beta,
    }
    rig = Bare(FIXED, changes, {FixedState.x: 0.2, FixedState.v: direction * speed})
    rig.advance(1000 * MS)
    growth = math.log(1.0 + beta * speed / force)
    assert rig.events[0].time_s == pytest.approx(MASS / beta * growth, abs=1e-9)
    travel = MASS / beta * (speed - force / beta * growth)
    assert rig.position_m == pytest.approx(0.2 + direction * travel, abs=1e-9)


@pytest.mark.parametrize("static", [12.0, 25.0])
def test_spring_oscillation_loses_2_f_over_k_a_half_cycle_and_sticks(static: float) -> None:
    rate, force, start = 4000.0, 12.0, 0.055
    changes = {
        **FREE,
        Parameters.spring_k: rate,
        Parameters.spring_x0: 0.1,
        Parameters.f_run_s: force,
        Parameters.f_static_s: static,
    }
    rig = Bare(FIXED, changes, {FixedState.x: 0.1 + start})
    rig.advance(60_000 * MS)
    half = math.pi * math.sqrt(MASS / rate)
    amplitude, turn = start, 0
    turns = [event for event in rig.events if event.name == "turn"]
    while amplitude * rate > static:
        amplitude -= 2.0 * force / rate
        turn += 1
        side = -1.0 if turn % 2 else 1.0
        assert turns[turn - 1].time_s == pytest.approx(turn * half, abs=1e-8)
        assert turns[turn - 1].position_m == pytest.approx(0.1 + side * amplitude, abs=1e-8)
    assert turn > 5
    assert len(turns) == turn  # and there it sticks
    assert rig.velocity_m_s == 0.0
    assert abs(rig.position_m - 0.1) * rate <= static


def test_breaks_away_when_the_rising_force_reaches_the_static_friction() -> None:
    changes = {
        Parameters.flow_model: 1.0,
        Parameters.cda_in: 2e-6,
        Parameters.f_static_s: 71.0,
        Parameters.alpha_m1: 1.0,
    }
    held = Bare(FIXED, {**changes, **STUCK})
    held.advance(MS, [(0, 0, 1.0)])
    slope = (held.state(FixedState.p_1) - 101325.0) / 1e-3  # choked: constant
    rig = Bare(FIXED, changes)
    rig.advance(10 * MS, [(0, 0, 1.0)])
    assert rig.names()[0] == "breakaway"
    areas = rig.packed.area_p
    assert rig.events[0].time_s == pytest.approx(71.0 / (areas * slope), abs=1e-9)
    assert rig.events[0].position_m == 0.0


@pytest.mark.parametrize("force", [70.999, -70.999])
def test_below_the_static_friction_nothing_moves_at_all(force: float) -> None:
    rig = Bare(FIXED, {Parameters.f_external: force}, place=0.005)
    rig.advance(500 * MS)
    assert rig.position_m == 0.005
    assert rig.velocity_m_s == 0.0
    assert rig.events == []


def test_three_times_the_dynamic_friction_does_not_chatter() -> None:
    heavy = NOMINAL.override({"friction_fixed.F_rf": 152.7, "friction_fixed.beta": 116.4})
    conditions = StrokeConditions("fixed", 9e5, ((0.01, "1", 0.98),))
    stroke = simulate(heavy, conditions, np.array([0.0, 0.3]), internal=False)
    assert [event.name for event in stroke.events] == ["breakaway", "stop"]
    start = stroke.events[0].time_s
    at = simulate(heavy, conditions, np.array([0.0, start]), internal=False).states[-1]
    p = stroke.packed
    net = at[FixedState.p_1] * p.area_p - at[FixedState.p_2] * p.area_p2 - p.p_atm * p.area_s
    assert net == pytest.approx(152.7, abs=0.01)  # F_sf in effect, not the 71 N below it

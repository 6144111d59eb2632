"""Loads of the gearbox: force barriers, and the synchronizer's block until its impulse is spent."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.optimize import brentq

from plant.kernel.layout import LENGTH, LengthState, Parameters
from plant.parts.forces import barrier
from plant.systems.stroke import StrokeConditions, simulate
from tests.physics.bare import AIRLESS, MS, NOMINAL, SMOOTH, Bare
from tests.physics.strokes import length_stroke

FREE = {**AIRLESS, **SMOOTH}
STROKE, X_MESH, W_MESH, W_PULL = 0.01285, 0.008, 0.002, 0.005
X_BLOCK = 0.006


def walked(side: float) -> dict[int, float]:
    """Pistons where they leave the stay free between neutral and the engaged stop."""
    return (
        {LengthState.x_1: 0.013, LengthState.x_2: 0.0}
        if side > 0.0
        else {LengthState.x_1: 0.0, LengthState.x_2: 0.013}
    )


def force(x: float, direction: float) -> float:
    """The kernel's barrier: 800 N into gear, 600 N out of gear."""
    return float(barrier.py_func(x, direction, STROKE, 800.0, X_MESH, W_MESH, 600.0, W_PULL))


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_barriers_are_cosines_squared_into_and_out_of_gear(side: float) -> None:
    for distance in np.linspace(0.0, STROKE, 200):
        u = (distance - X_MESH) / W_MESH
        into = 800.0 * math.cos(0.5 * math.pi * u) ** 2 if abs(u) < 1.0 else 0.0
        assert force(side * distance, side) == pytest.approx(into, abs=1e-9)
        u = (STROKE - distance) / W_PULL
        out = 600.0 * math.cos(0.5 * math.pi * u) ** 2 if abs(u) < 1.0 else 0.0
        if distance > 0.0:
            assert force(side * distance, -side) == pytest.approx(out, abs=1e-9)
    assert force(side * X_MESH, side) == 800.0 and force(side * STROKE, -side) == 600.0
    assert force(side * 0.005, side) == force(side * 0.0101, side) == 0.0


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_passing_the_meshing_barrier_costs_its_area(side: float) -> None:
    start = {**walked(side), LengthState.x_s: side * 0.005, LengthState.v_s: side * 1.5}
    rig = Bare(LENGTH, {**FREE, Parameters.mesh_force: 200.0}, start)
    rig.advance(20 * MS)
    area = quad(
        lambda x: 200.0 * math.cos(0.5 * math.pi * (x - X_MESH) / W_MESH) ** 2, 0.006, 0.01
    )[0]
    assert area == pytest.approx(200.0 * W_MESH)
    stop = rig.events[-1]
    assert stop.name == "stop"
    assert 0.5 * 0.9 * (1.5**2 - stop.speed_m_s**2) == pytest.approx(area, rel=2e-5)


def test_a_barrier_too_high_holds_the_stay() -> None:
    rig = Bare(
        LENGTH,
        {**FREE, Parameters.mesh_force: 2000.0},
        {**walked(1.0), LengthState.x_s: 0.005, LengthState.v_s: 1.5},
    )
    rig.advance(50 * MS)
    assert rig.names() == ["turn"]
    assert X_MESH - W_MESH < rig.position_m < X_MESH
    assert rig.velocity_m_s == 0.0


@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize(("share", "passes"), [(0.999, False), (1.001, True)])
def test_the_least_constant_force_that_passes_the_teeth_from_the_block(
    side: float, share: float, passes: bool
) -> None:
    """Where the barrier falls to the force again, u = (x - x_mesh)/w_mesh, its work is spent:
    tan(pi u) = pi (1 + u), so F = F_mesh (1 + cos(pi u))/2 = 0.609 F_mesh.

    For 10.1 kg and 1300 N it still leaves 0.75 m/s at the stop.
    """
    u = brentq(
        lambda u: math.sin(math.pi * u) - math.pi * (1.0 + u) * math.cos(math.pi * u), 0.1, 0.5
    )
    least = 0.5 * (1.0 + math.cos(math.pi * u))
    assert least == pytest.approx(0.6086, abs=1e-4)
    changes = {Parameters.mesh_force: 200.0, Parameters.f_external: side * share * least * 200.0}
    start = {**walked(side), LengthState.x_s: side * X_BLOCK, LengthState.v_s: side * 1e-4}
    rig = Bare(LENGTH, {**FREE, **changes}, start)
    rig.advance(400 * MS)
    assert ("stop" in rig.names()) == passes
    if passes:
        energy_j = share * least * 200.0 * (STROKE - X_BLOCK) - 200.0 * W_MESH
        stop = next(event for event in rig.events if event.name == "stop")
        assert 0.5 * 0.9 * stop.speed_m_s**2 == pytest.approx(energy_j, rel=1e-4)
    full_j = least * 1300.0 * (STROKE - X_BLOCK) - 1300.0 * W_MESH
    assert math.sqrt(2.0 * full_j / 10.1) == pytest.approx(0.75, abs=0.005)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_constant_force_is_blocked_for_impulse_over_force(side: float) -> None:
    pull, impulse = 400.0, 14.0
    changes = {
        **FREE,
        Parameters.f_external: side * pull,
        Parameters.sync_impulse: impulse,
        Parameters.m_s: 9.9,
    }
    rig = Bare(LENGTH, changes, walked(side))
    rig.advance(200 * MS)
    assert rig.names() == ["block", "unblock", "stop"]
    block, unblock, stop = rig.events
    a = pull / 9.9
    assert block.time_s == pytest.approx(math.sqrt(2.0 * X_BLOCK / a), abs=1e-10)
    assert block.speed_m_s == pytest.approx(math.sqrt(2.0 * X_BLOCK * a), rel=1e-9)
    assert block.position_m == side * X_BLOCK
    assert unblock.time_s - block.time_s == pytest.approx(impulse / pull, abs=1e-9)
    assert unblock.position_m == side * X_BLOCK
    rest = math.sqrt(2.0 * (STROKE - X_BLOCK) / a)
    assert stop.time_s - unblock.time_s == pytest.approx(rest, abs=1e-9)


def test_the_stroke_is_held_until_the_quadrature_of_its_driving_force_reaches_the_impulse() -> None:
    impulse = 30.0
    conditions = StrokeConditions(
        "N-B", 9e5, ((0.01, "B", 0.98),), mounted=True, mesh_force_n=800.0, sync_impulse_n_s=impulse
    )
    whole = simulate(NOMINAL, conditions, np.array([0.0, 0.2]), internal=False)
    named = {event.name: event.time_s for event in whole.events}
    held = np.linspace(named["block"], named["unblock"], 4001)
    stroke = simulate(NOMINAL, conditions, np.concatenate([[0.0], held]), internal=False)
    y, p = stroke.states[1:-1], stroke.packed
    assert y[:, LengthState.x_s] == pytest.approx(X_BLOCK, abs=1e-9)
    pressed = np.abs(y[:, LengthState.x_1] - y[:, LengthState.x_s] - p.x_free) < 1e-9
    driving = (y[:, LengthState.p_b] - y[:, LengthState.p_f]) * p.area_s
    driving += np.where(pressed, (y[:, LengthState.p_b] - y[:, LengthState.p_n]) * p.area_p, 0.0)
    integral = np.trapezoid(np.maximum(driving, 0.0), held[:-1])
    integral += max(driving[-1], 0.0) * (held[-1] - held[-2])
    # the grid knows the instants at which the piston meets the stay to one step
    assert integral == pytest.approx(impulse, rel=2e-3)


def test_out_of_gear_the_synchronizer_lets_the_stay_pass_and_blocks_the_other_side() -> None:
    changes = {**FREE, Parameters.f_external: -400.0, Parameters.sync_impulse: 10.0}
    rig = Bare(
        LENGTH, changes, {LengthState.x_1: 0.02, LengthState.x_2: 1e-4, LengthState.x_s: STROKE}
    )
    rig.advance(200 * MS)
    held = [event for event in rig.events if "block" in event.name]
    assert [event.name for event in held] == ["block", "unblock"]
    assert [event.position_m for event in held] == [-X_BLOCK, -X_BLOCK]


def test_a_new_impulse_blocks_the_next_engagement_again() -> None:
    actuator = length_stroke(NOMINAL, sync_impulse_n_s=5.0, mounted=True)
    actuator.advance(150 * MS, [(0, 0, 1.0)])
    assert [e.name for e in actuator.events if "block" in e.name] == ["block", "unblock"]
    assert actuator.spent_impulse_n_s == 5.0
    actuator.advance(600 * MS, [(150 * MS, 0, 0.0), (200 * MS, 1, 1.0), (450 * MS, 1, 0.0)])
    assert abs(actuator.position_m) < 1e-9
    actuator.set_sync_impulse(8.0)
    assert actuator.spent_impulse_n_s == 0.0
    before = len(actuator.events)
    actuator.advance(800 * MS, [(620 * MS, 2, 1.0)])
    named = [e for e in actuator.events[before:] if "block" in e.name]
    assert [e.name for e in named] == ["block", "unblock"]
    assert named[0].position_m == pytest.approx(-X_BLOCK, abs=1e-12)
    with pytest.raises(ValueError, match="impulse"):
        actuator.set_sync_impulse(-1.0)

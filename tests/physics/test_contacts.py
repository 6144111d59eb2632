"""Contacts of stay, pistons and stops: momentum, restitution, simultaneous events."""

from __future__ import annotations

import math

import numpy as np
import pytest

from plant.kernel.layout import FIXED, LENGTH, LengthState, Parameters
from plant.systems.setup import make_setup
from plant.systems.stroke import StrokeConditions, run_setup
from tests.physics.bare import AIRLESS, MS, NOMINAL, SMOOTH, Bare

FREE = {**AIRLESS, **SMOOTH}
STAY, PISTON = 0.9, 0.2
STROKE, GAP = 0.01285, 0.013


def test_a_flying_piston_takes_the_stay_along_with_its_momentum() -> None:
    rig = Bare(LENGTH, FREE, {LengthState.v_1: 1.2})
    rig.advance(12 * MS)
    met = rig.events[0]
    assert met.name == "collar 1 contact"
    assert met.time_s == pytest.approx(GAP / 1.2, abs=1e-12)
    common = PISTON * 1.2 / (PISTON + STAY)
    assert rig.velocity_m_s == pytest.approx(common, rel=1e-12)
    assert rig.state(LengthState.v_1) == rig.velocity_m_s
    lost = 0.5 * PISTON * 1.2**2 - 0.5 * (PISTON + STAY) * common**2
    assert met.energy_j == pytest.approx(lost, rel=1e-12)
    rig.advance(100 * MS)
    stops = [event.time_s for event in rig.events if event.name == "stop"]
    assert stops == [pytest.approx(GAP / 1.2 + STROKE / common, abs=1e-10)]
    assert rig.position_m == STROKE
    assert rig.state(LengthState.v_1) == rig.velocity_m_s == 0.0


def test_two_pistons_that_meet_the_stay_together_share_their_momentum() -> None:
    # piston 1 flies into its collar while the stay carries piston 2 at its nut
    start = {LengthState.v_1: 1.0, LengthState.x_s: -0.002, LengthState.x_2: 0.002}
    rig = Bare(LENGTH, FREE, start)
    rig.advance(20 * MS)
    assert rig.events[0].name == "collar 1 contact"
    assert rig.events[0].time_s == pytest.approx(GAP - 0.002, abs=1e-12)
    # piston 2 lies behind the stay at its nut: pushed away, it stays where it is
    assert rig.velocity_m_s == pytest.approx(PISTON / (PISTON + STAY), rel=1e-12)
    assert rig.state(LengthState.v_2) == 0.0
    start = {LengthState.v_1: 1.0, LengthState.x_s: -0.002, LengthState.x_2: GAP + 0.002}
    rig = Bare(LENGTH, FREE, start)
    rig.advance(20 * MS)
    # piston 2 lies ahead of the stay at its collar: all three go on together
    common = PISTON / (2.0 * PISTON + STAY)
    assert rig.velocity_m_s == pytest.approx(common, rel=1e-12)
    assert rig.state(LengthState.v_2) == pytest.approx(-common, rel=1e-12)


def test_joined_bodies_part_when_one_is_braked() -> None:
    moving = dict.fromkeys((LengthState.v_s, LengthState.v_1), 0.5)
    together = moving | dict.fromkeys((LengthState.x_s, LengthState.x_1), 0.001)
    # friction on the stay alone: the piston ahead of it at its nut flies on
    changes = {**FREE, Parameters.f_run_s: 10.0, Parameters.f_static_s: 10.0}
    rig = Bare(LENGTH, changes, together)
    rig.advance(5 * MS)
    assert rig.state(LengthState.v_1) == pytest.approx(0.5, rel=1e-12)
    assert rig.velocity_m_s == pytest.approx(0.5 - 10.0 / STAY * 5e-3, rel=1e-9)
    # friction on the piston ahead: the stay pushes it, both are braked together
    changes = {**FREE, Parameters.f_run_p: 10.0, Parameters.f_static_p: 10.0}
    rig = Bare(LENGTH, changes, together)
    rig.advance(5 * MS)
    assert rig.velocity_m_s == pytest.approx(0.5 - 10.0 / (STAY + PISTON) * 5e-3, rel=1e-9)
    assert rig.state(LengthState.v_1) == rig.velocity_m_s


def test_bodies_that_break_away_together_part_if_one_slides_more_easily() -> None:
    # stay: 20 N driving, 12 N friction; piston ahead at its nut: 35 N driving, 40 N at rest, 5 N sliding
    changes = {
        **SMOOTH,
        Parameters.k_in: 0.0,
        Parameters.k_out: 0.0,
        Parameters.f_run_s: 12.0,
        Parameters.f_static_s: 12.0,
        Parameters.f_run_p: 5.0,
        Parameters.f_static_p: 40.0,
        Parameters.f_external: 16.9,
        Parameters.area_s: 0.0,
        Parameters.area_p: 3.5e-3,
    }
    rig = Bare(LENGTH, changes, {LengthState.p_b: 101325.0 + 1e4})
    rig.advance(MS)
    # together 51.9 N stay below 52 N
    assert rig.velocity_m_s == 0.0 and rig.state(LengthState.v_1) == 0.0
    changes[Parameters.f_external] = 17.1
    rig = Bare(LENGTH, changes, {LengthState.p_b: 101325.0 + 1e4})
    rig.advance(MS // 10)
    assert rig.velocity_m_s == pytest.approx((17.1 - 12.0) / STAY * 1e-4, rel=1e-6)
    assert rig.state(LengthState.v_1) == pytest.approx((35.0 - 5.0) / PISTON * 1e-4, rel=1e-3)
    assert rig.balance().closed


@pytest.mark.parametrize("restitution", [0.1, 0.5, 0.9])
def test_a_pressed_body_bounces_in_a_geometric_sequence_that_ends(restitution: float) -> None:
    force, mass, drop = 50.0, 1.1, 0.004
    changes = {**FREE, Parameters.f_external: force, Parameters.restitution: restitution}
    rig = Bare(FIXED, changes, place=STROKE - drop)
    rig.advance(1000 * MS)
    speed = math.sqrt(2.0 * force / mass * drop)
    instant = mass * speed / force
    stops = [event for event in rig.events if event.name == "stop"]
    for n, stop in enumerate(stops):
        assert stop.speed_m_s == pytest.approx(speed, rel=1e-6, abs=1e-7)
        assert stop.time_s == pytest.approx(instant, abs=1e-7)
        assert stop.position_m == STROKE
        speed *= restitution
        instant += 2.0 * mass * speed / force
        assert n < 200
    assert speed < 5e-4  # the sequence was followed until it was negligible
    assert rig.position_m == pytest.approx(STROKE, abs=1e-9)
    assert rig.velocity_m_s == 0.0
    assert rig.balance().impact_j == pytest.approx(force * drop, rel=1e-6)


def test_arrival_in_neutral_stops_stay_and_piston_at_the_same_instant() -> None:
    start = {
        LengthState.x_s: 0.004,
        LengthState.x_1: 0.004,
        LengthState.v_s: -0.8,
        LengthState.v_1: -0.8,
    }
    rig = Bare(LENGTH, FREE, start)
    rig.advance(20 * MS)
    assert rig.names() == ["stop"]
    stop = rig.events[0]
    assert stop.time_s == pytest.approx(0.005, abs=1e-12)
    assert stop.speed_m_s == pytest.approx(0.8, rel=1e-12)
    assert stop.energy_j == pytest.approx(0.5 * (STAY + PISTON) * 0.8**2, rel=1e-12)
    assert (rig.position_m, rig.state(LengthState.x_1), rig.state(LengthState.x_2)) == (
        0.0,
        0.0,
        0.0,
    )
    assert (rig.velocity_m_s, rig.state(LengthState.v_1), rig.state(LengthState.v_2)) == (
        0.0,
        0.0,
        0.0,
    )


def test_a_stop_with_rebound_keeps_the_momentum_of_the_pistons_that_leave_it() -> None:
    # both pistons run with the stay into the forward stop: piston 1 flies on, piston 2 is met again
    speed, e = 1.5, 0.5
    at = -STROKE + 0.001
    start = {
        LengthState.x_s: at,
        LengthState.v_s: -speed,
        LengthState.x_1: at + GAP,
        LengthState.v_1: -speed,
        LengthState.x_2: GAP - at,
        LengthState.v_2: speed,
    }
    rig = Bare(LENGTH, {**FREE, Parameters.restitution: e}, start)
    rig.advance(round(1.01e-3 / speed * 1e9))
    assert rig.events[0].name == "stop"
    assert rig.state(LengthState.v_1) == pytest.approx(-speed, rel=1e-12)
    common = (STAY * e * speed - PISTON * speed) / (STAY + PISTON)
    assert rig.velocity_m_s == pytest.approx(common, rel=1e-12)
    assert rig.state(LengthState.v_2) == pytest.approx(-common, rel=1e-12)
    assert rig.balance().closed


@pytest.mark.parametrize("kind", ["N-B", "B-N", "N-F", "F-N"])
@pytest.mark.parametrize("restitution", [0.0, 0.5])
@pytest.mark.parametrize("damper", ["none", "incompressible", "compressible"])
def test_a_stop_worn_beyond_the_free_play_ends_at_the_far_collar(
    kind: str, restitution: float, damper: str
) -> None:
    """The collar of the piston that stands on its outer stop is as good as a stop."""
    old, new = kind[0], kind[-1]
    conditions = StrokeConditions(
        kind,
        5e5,
        ((0.01, new, 0.98), (0.01, old, 0.0)),
        charged_before=(old,),
        load="none" if damper == "none" else "damper",
        damper_model=damper if damper != "none" else "compressible",
    )
    setup = make_setup(NOMINAL.override({"stops.restitution": restitution}), conditions)
    setup.p.stop_offset = 1e-3
    free = float(setup.p.x_free)
    stroke = run_setup(setup, np.linspace(0.0, 0.4, 401), internal=False)
    y = stroke.states
    assert np.abs(y[:, LengthState.x_s]).max() == pytest.approx(free, abs=1e-9)
    assert y[:, [LengthState.x_1, LengthState.x_2]].min() > -1e-9
    assert stroke.position_m[-1] == pytest.approx({"B": free, "F": -free, "N": 0.0}[new], abs=1e-8)
    assert len(stroke.events) < 100 and stroke.balance.closed

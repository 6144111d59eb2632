"""Friction and contacts: stops, sticking, no chatter; momentum, restitution, simultaneous events, the bond."""

from __future__ import annotations

import math

import numpy as np
import pytest

from can_dbc.errors import InputError
from plant.kernel.layout import FIXED, LENGTH, FixedState, LengthState, Parameters
from plant.parameters import load as load_set
from plant.parameters import parse
from plant.systems.setup import make_setup
from plant.systems.stroke import StrokeConditions, run_setup, simulate
from sil.simulation.in_memory import Run, run_in_memory
from sil.simulation.load_scenario import load
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
        **FREE, Parameters.spring_k: rate, Parameters.spring_x0: 0.1, Parameters.f_run_s: force,
        Parameters.f_static_s: static,
    }  # fmt: skip
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
    assert rig.events[0].time_s == pytest.approx(71.0 / (rig.packed.area_p * slope), abs=1e-9)
    assert rig.events[0].position_m == 0.0


@pytest.mark.parametrize("force", [70.999, -70.999])
def test_below_the_static_friction_nothing_moves_at_all(force: float) -> None:
    rig = Bare(FIXED, {Parameters.f_external: force}, place=0.005)
    rig.advance(500 * MS)
    assert rig.position_m == 0.005 and rig.velocity_m_s == 0.0
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


AIRBORNE = {**AIRLESS, **SMOOTH}
STAY, PISTON = 0.9, 0.2
STROKE, GAP = 0.01285, 0.013


def test_a_flying_piston_takes_the_stay_along_with_its_momentum() -> None:
    rig = Bare(LENGTH, AIRBORNE, {LengthState.v_1: 1.2})
    rig.advance(12 * MS)
    met = rig.events[0]
    assert met.name == "collar 1 contact" and met.time_s == pytest.approx(GAP / 1.2, abs=1e-12)
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
    rig = Bare(LENGTH, AIRBORNE, start)
    rig.advance(20 * MS)
    assert rig.events[0].name == "collar 1 contact"
    assert rig.events[0].time_s == pytest.approx(GAP - 0.002, abs=1e-12)
    # piston 2 lies behind the stay at its nut: pushed away, it stays where it is
    assert rig.velocity_m_s == pytest.approx(PISTON / (PISTON + STAY), rel=1e-12)
    assert rig.state(LengthState.v_2) == 0.0
    start = {LengthState.v_1: 1.0, LengthState.x_s: -0.002, LengthState.x_2: GAP + 0.002}
    rig = Bare(LENGTH, AIRBORNE, start)
    rig.advance(20 * MS)
    # piston 2 lies ahead of the stay at its collar: all three go on together
    common = PISTON / (2.0 * PISTON + STAY)
    assert rig.velocity_m_s == pytest.approx(common, rel=1e-12)
    assert rig.state(LengthState.v_2) == pytest.approx(-common, rel=1e-12)


def test_joined_bodies_part_when_one_is_braked() -> None:
    moving = dict.fromkeys((LengthState.v_s, LengthState.v_1), 0.5)
    together = moving | dict.fromkeys((LengthState.x_s, LengthState.x_1), 0.001)
    # friction on the stay alone: the piston ahead of it at its nut flies on
    changes = {**AIRBORNE, Parameters.f_run_s: 10.0, Parameters.f_static_s: 10.0}
    rig = Bare(LENGTH, changes, together)
    rig.advance(5 * MS)
    assert rig.state(LengthState.v_1) == pytest.approx(0.5, rel=1e-12)
    assert rig.velocity_m_s == pytest.approx(0.5 - 10.0 / STAY * 5e-3, rel=1e-9)
    # friction on the piston ahead: the stay pushes it, both are braked together
    changes = {**AIRBORNE, Parameters.f_run_p: 10.0, Parameters.f_static_p: 10.0}
    rig = Bare(LENGTH, changes, together)
    rig.advance(5 * MS)
    assert rig.velocity_m_s == pytest.approx(0.5 - 10.0 / (STAY + PISTON) * 5e-3, rel=1e-9)
    assert rig.state(LengthState.v_1) == rig.velocity_m_s


def test_bodies_that_break_away_together_part_if_one_slides_more_easily() -> None:
    # stay: 20 N driving, 12 N friction; piston ahead at its nut: 35 N driving, 40 N at rest, 5 N sliding
    changes = {
        **SMOOTH, Parameters.k_in: 0.0, Parameters.k_out: 0.0, Parameters.f_run_s: 12.0,
        Parameters.f_static_s: 12.0, Parameters.f_run_p: 5.0, Parameters.f_static_p: 40.0,
        Parameters.f_external: 16.9, Parameters.area_s: 0.0, Parameters.area_p: 3.5e-3,
    }  # fmt: skip
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
    changes = {**AIRBORNE, Parameters.f_external: force, Parameters.restitution: restitution}
    rig = Bare(FIXED, changes, place=STROKE - drop)
    rig.advance(1000 * MS)
    speed = math.sqrt(2.0 * force / mass * drop)
    instant = mass * speed / force
    stops = [event for event in rig.events if event.name == "stop"]
    for n, stop in enumerate(stops):
        assert stop.speed_m_s == pytest.approx(speed, rel=1e-6, abs=1e-7)
        assert stop.time_s == pytest.approx(instant, abs=1e-7) and stop.position_m == STROKE
        speed *= restitution
        instant += 2.0 * mass * speed / force
        assert n < 200
    assert speed < 5e-4  # the sequence was followed until it was negligible
    assert rig.position_m == pytest.approx(STROKE, abs=1e-9) and rig.velocity_m_s == 0.0
    assert rig.balance().impact_j == pytest.approx(force * drop, rel=1e-6)


def test_arrival_in_neutral_stops_stay_and_piston_at_the_same_instant() -> None:
    start = {
        LengthState.x_s: 0.004,
        LengthState.x_1: 0.004,
        LengthState.v_s: -0.8,
        LengthState.v_1: -0.8,
    }
    rig = Bare(LENGTH, AIRBORNE, start)
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
        LengthState.x_s: at, LengthState.v_s: -speed, LengthState.x_1: at + GAP,
        LengthState.v_1: -speed, LengthState.x_2: GAP - at, LengthState.v_2: speed,
    }  # fmt: skip
    rig = Bare(LENGTH, {**AIRBORNE, Parameters.restitution: e}, start)
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


JOINED = "length.F_bond=1e6"


def shift(name: str, bond_n: float) -> Run:
    return run_in_memory(load(name, settings={"duration_s": 0.4, "length.F_bond": bond_n}))


@pytest.mark.parametrize(("name", "contact"), [("strategy_air_cushion", 0.013), ("lab_b_n", 0.0)])
def test_joined_bodies_stay_together_between_the_gears(name: str, contact: float) -> None:
    runs = [shift(name, bond) for bond in (0.0, 1e6)]
    apart = []
    for run in runs:
        truth = run.record.truth
        x = truth["position_m"]
        picked_up = np.flatnonzero(np.abs(x - x[0]) > 1e-4)[5:]
        between = picked_up[(x[picked_up] > 1e-4) & (x[picked_up] < 0.01275)]
        gap = truth["piston_1_m"] - truth["position_m"]
        apart.append(np.abs(gap[between] - contact).max())
        assert run.balances["closed"] and run.shifts[0].arrived_s is not None
    assert apart[1] < 1e-9 < 1e-5 < apart[0]


def test_a_weak_bond_breaks() -> None:
    """A bond that bears less than the brake pulls parts, later than none."""
    parted = []
    for bond in (0.0, 50.0, 1e6):
        events = shift("strategy_air_cushion", bond).record.events
        parted.append([e.time_s for e in events if e.name == "piston_1_separation"])
    assert parted[0][0] < parted[1][0] and not parted[2]


def test_in_the_truck_the_open_loop_hardly_depends_on_the_contact() -> None:
    found = [shift("truck_into_gear_2200n", bond) for bond in (0.0, 1e6)]
    push, joined = (run.shifts[0].impact_worst_m_s for run in found)
    assert push == pytest.approx(joined, abs=1e-5)


def test_a_full_set_may_leave_the_bond_out_but_nothing_else() -> None:
    nominal = load_set()
    raw: dict[str, dict[str, object]] = {}
    for path, item in nominal.entries.items():
        section, key = path.split(".")
        raw.setdefault(section, {})[key] = {
            "value": list(item.value) if isinstance(item.value, tuple) else item.value,
            "unit": item.unit,
            "source": item.source,
        }
    raw["length"].pop("F_bond")
    assert parse(raw, "older").value("length.F_bond") == 0.0
    raw["length"].pop("m_p")
    with pytest.raises(InputError, match=r"older: no length\.m_p"):
        parse(raw, "older")

"""The light model and its valves against closed forms, and the observer that runs on them."""

from __future__ import annotations

import math

import pytest

from controller.config import FirmwareConfig
from controller.filters import SectionFilter, butterworth
from controller.light_model import (
    STEP_S,
    LightModel,
    LightModelState,
    ModelSettings,
    Observer,
    ObserverSettings,
    Valve,
)
from controller.settings import FilterConfig

STROKE_M = 0.01285
GAP_M = 0.013
ATMOSPHERE_PA = 101325.0


def test_valve_acts_after_its_delay_and_a_short_command_never() -> None:
    valve = Valve(0.008, 0.035)
    valve.command(0.0, True)
    assert [valve.at(t) for t in (0.0, 0.0075, 0.008)] == [False, False, True]
    valve.command(0.01, False)
    assert valve.at(0.0449) and not valve.at(0.0451)
    valve.command(0.05, True)
    valve.command(0.057, False)
    assert not valve.at(0.2)
    valve.command(0.3, True)
    valve.command(0.31, True)  # the same again moves nothing
    assert valve.at(0.308)


def test_a_choked_chamber_empties_exponentially() -> None:
    """P' = -(alpha R C / V) P while the outflow is choked and nothing moves."""
    settings = ModelSettings(piston_friction_n=2000.0, stay_friction_n=2000.0)
    model = LightModel(settings, STROKE_M)
    motion = LightModelState(ATMOSPHERE_PA, ATMOSPHERE_PA)
    motion.driving_pa = 8e5
    outflow = settings.venting_alpha_flow * settings.flow_out
    rate_per_s = 287.0 * outflow / settings.driving_m3
    for _ in range(1000):
        model.step(motion, False, False, 1e-5)
    assert motion.stay_m_s == 0.0
    assert motion.driving_pa == pytest.approx(8e5 * math.exp(-rate_per_s * 0.01), rel=1e-3)


@pytest.mark.parametrize(("driving", "braking"), [(True, True), (True, False), (False, True)])
def test_a_shut_in_gas_follows_its_polytrope(driving: bool, braking: bool) -> None:
    """P V^alpha is constant without flow; the exponent is that of the valve's position."""
    settings = ModelSettings(
        flow_in=0.0,
        flow_out=0.0,
        piston_friction_n=0.0,
        stay_friction_n=0.0,
        piston_kg=10.0,
        stay_kg=100.0,
        stay_m2=0.002,
        filling_alpha_volume=0.6,
        venting_alpha_volume=1.9,
    )
    model = LightModel(settings, STROKE_M)
    motion = LightModelState(ATMOSPHERE_PA, ATMOSPHERE_PA)
    motion.piston_m, motion.stay_m = GAP_M - 0.002, 0.004
    motion.piston_m_s, motion.stay_m_s = 0.5, 1.0
    motion.driving_pa, motion.braking_pa = 3e5, 2e5

    def volumes_m3() -> tuple[float, float]:
        ahead_m3 = settings.piston_m2 * motion.piston_m
        behind_m3 = ahead_m3 + settings.stay_m2 * motion.stay_m
        return settings.driving_m3 + behind_m3, settings.braking_m3 - ahead_m3

    before = volumes_m3()
    for _ in range(500):
        model.step(motion, driving, braking, 1e-5)
    after = volumes_m3()
    assert after[0] > 1.1 * before[0] and after[1] < 0.92 * before[1]
    alphas = [0.6 if is_open else 1.9 for is_open in (driving, braking)]
    expected = [
        p * (v0 / v1) ** alpha
        for p, v0, v1, alpha in zip((3e5, 2e5), before, after, alphas, strict=True)
    ]
    assert (motion.driving_pa, motion.braking_pa) == pytest.approx(expected, rel=1e-3)


def test_a_closed_loop_of_pressures_ends_at_supply_and_atmosphere() -> None:
    model = LightModel(ModelSettings(), STROKE_M)
    motion = LightModelState(ATMOSPHERE_PA, ATMOSPHERE_PA)
    for _ in range(4000):
        model.step(motion, True, False, STEP_S)
    assert motion.stay_m == STROKE_M and motion.piston_m == GAP_M + STROKE_M
    assert motion.stay_m_s == motion.piston_m_s == 0.0
    assert motion.driving_pa == pytest.approx(9e5, rel=1e-3)
    assert motion.braking_pa == pytest.approx(ATMOSPHERE_PA, rel=1e-3)


def test_the_piston_gives_its_momentum_to_the_stay() -> None:
    """v' = v m_p / (m_p + m_s) where they meet, but for one step's forces."""
    model = LightModel(ModelSettings(), STROKE_M)
    motion = LightModelState(ATMOSPHERE_PA, ATMOSPHERE_PA)
    motion.piston_m, motion.piston_m_s = 0.013 - 1e-6, 1.0
    model.step(motion, False, False, 1e-5)
    assert motion.stay_m > 0.0
    assert motion.stay_m_s == motion.piston_m_s == pytest.approx(0.2 / 1.1, rel=0.01)


@pytest.mark.parametrize("speed_m_s", [0.0, 0.3])
@pytest.mark.parametrize("load_n", [0.0, 135.0, 600.0])
def test_piston_and_stay_in_contact_are_one_mass(speed_m_s: float, load_n: float) -> None:
    """(m_p + m_s) v' = A_p (P_d - P_n) + A_s (P_d - P_atm) - frictions - dampings - load.

    From rest as well, where the stay's own area cannot move it: by 0.3 N with the load of 135 N.
    """
    nominal = ModelSettings()
    motion = LightModelState(ATMOSPHERE_PA, ATMOSPHERE_PA)
    motion.stay_m, motion.piston_m = 0.004, GAP_M + 0.004
    motion.stay_m_s = motion.piston_m_s = speed_m_s
    motion.driving_pa, motion.braking_pa, motion.load_n = 6e5, 1.5e5, load_n
    force_n = (
        nominal.piston_m2 * (6e5 - 1.5e5)
        + nominal.stay_m2 * (6e5 - ATMOSPHERE_PA)
        - nominal.piston_friction_n
        - nominal.stay_friction_n
        - (nominal.piston_damping_n_s_m + nominal.stay_damping_n_s_m) * speed_m_s
        - load_n
    )
    then_m_s = speed_m_s + 1e-4 * force_n / (nominal.piston_kg + nominal.stay_kg)
    LightModel(nominal, STROKE_M).step(motion, True, False, 1e-4)
    assert then_m_s > 0.01
    assert (motion.piston_m_s, motion.stay_m_s) == pytest.approx((then_m_s, then_m_s), rel=1e-9)
    assert motion.stay_m == pytest.approx(0.004 + 1e-4 * then_m_s, abs=1e-12)
    assert motion.piston_m == pytest.approx(GAP_M + motion.stay_m, abs=1e-12)


def test_what_is_thrown_back_stops_at_its_stops() -> None:
    motion = LightModelState(ATMOSPHERE_PA, ATMOSPHERE_PA)
    motion.piston_m = motion.stay_m = 1e-6
    motion.piston_m_s = motion.stay_m_s = -0.5
    LightModel(ModelSettings(), STROKE_M).step(motion, False, False, 1e-4)
    assert (motion.piston_m, motion.stay_m) == (0.0, 0.0)
    assert (motion.piston_m_s, motion.stay_m_s) == (0.0, 0.0)


def test_a_piston_that_does_not_reach_the_stay_yet_moves_alone() -> None:
    """m_p u' = A_p (P_d - P_n) - friction - damping u."""
    nominal = ModelSettings()
    motion = LightModelState(ATMOSPHERE_PA, ATMOSPHERE_PA)
    motion.piston_m, motion.piston_m_s = GAP_M - 2e-4, 0.3
    force_n = nominal.piston_friction_n + nominal.piston_damping_n_s_m * 0.3
    LightModel(nominal, STROKE_M).step(motion, False, False, STEP_S)
    then_m_s = 0.3 - STEP_S * force_n / nominal.piston_kg
    assert motion.piston_m_s == pytest.approx(then_m_s, rel=1e-9)
    assert motion.piston_m == pytest.approx(GAP_M - 2e-4 + STEP_S * then_m_s, abs=1e-12)
    assert (motion.stay_m, motion.stay_m_s) == (0.0, 0.0)


def test_a_braked_piston_lets_the_stay_coast() -> None:
    """m_s v' = A_s (P_d - P_atm) - friction: the neutral chamber's pressure is not in it."""
    model = LightModel(ModelSettings(stay_damping_n_s_m=0.0), STROKE_M)
    motion = LightModelState(ATMOSPHERE_PA, ATMOSPHERE_PA)
    motion.stay_m, motion.piston_m = 0.001, 0.014
    motion.stay_m_s = motion.piston_m_s = 0.5
    motion.braking_pa = 5e5
    for _ in range(100):
        model.step(motion, False, True, 1e-5)
    assert motion.piston_m < 0.013 + motion.stay_m - 1e-4
    assert motion.stay_m_s == pytest.approx(0.5 - 22.0 / 0.9 * 1e-3, abs=1e-3)


def test_a_load_holds_the_stay_and_never_drives_it() -> None:
    model = LightModel(ModelSettings(), STROKE_M)
    motion = LightModelState(ATMOSPHERE_PA, ATMOSPHERE_PA)
    motion.piston_m, motion.stay_m = 0.015, 0.002
    motion.load_n, motion.driving_pa = 2200.0, 5e5
    for _ in range(100):
        model.step(motion, False, False, STEP_S)
    assert (motion.piston_m, motion.stay_m) == (0.015, 0.002)


def test_an_open_loop_stroke_takes_as_long_as_the_laboratory_s() -> None:
    """About 41 ms from the command and some 0.9 m/s at the stop, 9 bar (within a tenth)."""
    model = LightModel(ModelSettings(), STROKE_M)
    motion, valve = LightModelState(ATMOSPHERE_PA, ATMOSPHERE_PA), Valve(0.008, 0.035)
    valve.command(0.0, True)
    steps, before_m_s = 0, 0.0
    while motion.stay_m < STROKE_M:
        before_m_s = motion.stay_m_s
        model.step(motion, valve.at(steps * STEP_S), False, STEP_S)
        steps += 1
    assert steps * STEP_S == pytest.approx(0.0408, rel=0.1)
    assert before_m_s == pytest.approx(0.94, rel=0.1)


def test_observer_finds_a_load_that_holds_the_stay() -> None:
    config = FirmwareConfig(filter=FilterConfig(enabled=False))
    observer = Observer(config, ModelSettings(), ObserverSettings())
    estimated = []
    for tick in range(1, 21):
        observer.advance(tick * 0.01, 0.0, 1)  # it does not move
        observer.command(True, False)
        estimated.append(observer.travelled_m)
    assert observer.motion.load_n > 500.0
    assert max(estimated[-5:]) < 0.5 * STROKE_M


def test_observer_forgets_on_reset() -> None:
    observer = Observer(FirmwareConfig(), ModelSettings(), ObserverSettings())
    observer.command(True, False)
    observer.advance(0.05, 0.001, 5)
    observer.reset()
    assert (observer.steps, observer.travelled_m, observer.motion.load_n) == (0, 0.0, 0.0)
    observer.advance(0.05, 0.0, 0)
    assert observer.travelled_m == 0.0


def test_observer_is_the_model_seen_through_delay_and_filter() -> None:
    """Against model, valves and filter run by hand; what they say corrects nothing."""
    config, settings = FirmwareConfig(), ModelSettings()
    observer = Observer(config, settings, ObserverSettings())
    model, motion = LightModel(settings, STROKE_M), LightModelState(ATMOSPHERE_PA, ATMOSPHERE_PA)
    driving, braking = (Valve(settings.valve_open_s, settings.valve_close_s) for _ in range(2))
    late = SectionFilter(butterworth(6, 22.0, 100.0))
    late.settle(0.0)
    positions_m = [0.0]
    for tick in range(1, 13):
        for step in range(20 * (tick - 1), 20 * tick):
            now_s = step * STEP_S
            model.step(motion, driving.at(now_s), braking.at(now_s), STEP_S)
            positions_m.append(motion.stay_m)
        observer.advance(tick * 0.01, late.update(positions_m[-1 - round(0.00455 / STEP_S)]), 1)
        for name in LightModelState.__slots__:
            seen, true = getattr(observer.motion, name), getattr(motion, name)
            assert seen == pytest.approx(true, rel=1e-9, abs=1e-9), (tick, name)
        charge, brake = tick < 8, 4 <= tick < 6
        observer.command(charge, brake)
        at_s = tick * 0.01 + settings.transport_s
        driving.command(at_s, charge)
        braking.command(at_s, brake)
    assert max(positions_m) > 0.5 * STROKE_M and motion.braking_pa > 1.2 * ATMOSPHERE_PA


def corrected(piston_m: float, stay_m: float, error_m: float) -> LightModelState:
    """Motion after a correction; both move at 0.3 m/s, the load is 100 N, nothing was expected."""
    config = FirmwareConfig(filter=FilterConfig(enabled=False))
    observer = Observer(config, ModelSettings(), ObserverSettings())
    motion = observer.motion
    motion.piston_m, motion.stay_m, motion.load_n = piston_m, stay_m, 100.0
    motion.piston_m_s = motion.stay_m_s = 0.3
    observer.advance(0.0, error_m, 1)
    return motion


@pytest.mark.parametrize(
    ("piston_m", "stay_m", "error_m", "piston_then_m", "piston_then_m_s"),
    [
        (GAP_M + 0.005, 0.005, 0.002, GAP_M + 0.006, 0.34),  # the piston pushes: both are moved
        (GAP_M + 0.005 - 5e-10, 0.005, 0.002, GAP_M + 0.006, 0.34),  # rounding is no distance
        (GAP_M + 0.005, 0.005, 5e-5, GAP_M + 0.005025, 0.301),
        (GAP_M, 0.0, 5e-5, GAP_M + 2.5e-5, 0.301),
        (0.004, 0.005, 0.002, 0.004, 0.3),  # the piston is on its own: the stay alone is
        (0.004, 0.005, 5e-5, 0.004, 0.3),
        (0.004, 0.0, 1.1e-4, 0.004, 0.3),
        (GAP_M + 0.0049, 0.005, -0.002, GAP_M + 0.004, 0.3),  # but is never ahead of what it pushes
    ],
)
def test_what_a_measurement_corrects(
    piston_m: float, stay_m: float, error_m: float, piston_then_m: float, piston_then_m_s: float
) -> None:
    """By the gains: half of the error, 20 times it per second, 30 kN per metre of it."""
    motion = corrected(piston_m, stay_m, error_m)
    assert motion.stay_m == pytest.approx(stay_m + 0.5 * error_m, abs=1e-12)
    assert motion.stay_m_s == pytest.approx(0.3 + 20.0 * error_m, abs=1e-12)
    assert motion.load_n == pytest.approx(100.0 - 3e4 * error_m, abs=1e-9)
    assert motion.piston_m == pytest.approx(piston_then_m, abs=1e-12)
    assert motion.piston_m_s == pytest.approx(piston_then_m_s, abs=1e-12)


@pytest.mark.parametrize("error_m", [1e-4, 5e-5, -0.001])
def test_a_stay_at_rest_teaches_nothing_until_it_moves(error_m: float) -> None:
    motion = corrected(0.004, 0.0, error_m)
    assert (motion.piston_m, motion.stay_m, motion.stay_m_s, motion.load_n) == (
        0.004,
        0.0,
        0.3,
        100.0,
    )


def test_commands_reach_the_valves_after_the_way_over_the_bus() -> None:
    observer = Observer(FirmwareConfig(), ModelSettings(), ObserverSettings())
    observer.advance(0.01, 0.0, 0)
    observer.command(True, True)
    for valve in (observer.driving, observer.braking):
        assert valve.wanted is True
        assert valve.due_s == pytest.approx(0.01 + 0.00038 + 0.008, abs=1e-12)
    observer.command(False, False)
    for valve in (observer.driving, observer.braking):
        assert valve.wanted is False
        assert valve.due_s == pytest.approx(0.01 + 0.00038 + 0.035, abs=1e-12)

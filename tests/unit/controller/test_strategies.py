"""The strategies' commands for given inputs, and what they plan with the light model."""

from __future__ import annotations

import math
from copy import copy
from itertools import chain
from typing import Any

import pytest

from can_dbc.errors import InputError
from can_dbc.messages import Chamber, Gear
from controller import strategies
from controller.config import FirmwareConfig, create_strategy
from controller.light_model import STEP_S, LightModel, ModelSettings, Observer, ObserverSettings
from controller.position import Estimate, Sample
from controller.settings import FilterConfig, SensorConfig
from controller.strategies import OFF, Duties, ShiftContext, Strategy, one_chamber, synchro_brake
from controller.strategies.bang_bang import BangBang, stored_s
from controller.strategies.foresight import Foresight, Outcome
from controller.strategies.into_gear import Command, PushProgress
from controller.strategies.open_loop import OpenLoop
from controller.strategies.predictive import sequences
from controller.strategies.synchro_brake import SynchroBrake

ANYWHERE = Estimate(True, 0.003, 0.002, 0.5, ())


def context(charged: Chamber) -> ShiftContext:
    return ShiftContext(leg=Gear.BACKWARD, charged=charged, start_ns=0, attempt=0)


@pytest.mark.parametrize("name", list(strategies.NAMES))
def test_every_registered_strategy_can_be_made(name: str) -> None:
    strategy = create_strategy(FirmwareConfig(strategy=name))
    assert type(strategy) is strategies.strategy_class(name)
    assert type(strategy.parameters) is strategy.Parameters


def test_open_loop_is_the_default() -> None:
    assert type(create_strategy(FirmwareConfig())) is OpenLoop


@pytest.mark.parametrize(
    ("chamber", "duties"),
    [
        (Chamber.B, Duties(0.98, 0.0, 0.0)),
        (Chamber.N, Duties(0.0, 0.98, 0.0)),
        (Chamber.F, Duties(0.0, 0.0, 0.98)),
        (Chamber.NONE, OFF),
    ],
)
def test_one_chamber(chamber: Chamber, duties: Duties) -> None:
    assert one_chamber(chamber, 0.98) == duties


@pytest.mark.parametrize("chamber", [Chamber.B, Chamber.N, Chamber.F])
def test_open_loop_fills_the_charged_chamber_whatever_happens(chamber: Chamber) -> None:
    strategy = create_strategy(FirmwareConfig(duty=0.9))
    for now_ns in (0, 10_000_000, 10**12):
        assert strategy.command(now_ns, ANYWHERE, context(chamber)) == one_chamber(chamber, 0.9)
    strategy.reset()
    assert strategy.command(0, ANYWHERE, context(chamber)) == one_chamber(chamber, 0.9)


def test_the_blow_is_as_configured_unless_a_strategy_says_otherwise() -> None:
    strategy = create_strategy(FirmwareConfig())
    for follows in (False, True):
        assert strategy.blow_s(0.123, Gear.NEUTRAL, follows) == 0.123


MS = 1_000_000
BRAKING = ("air_cushion", "sliding_mode")


def new_strategy(name: str, **parameters: Any) -> Strategy:
    strategy = create_strategy(FirmwareConfig(strategy=name, strategy_parameters=parameters))
    strategy.reset()
    return strategy


def seen(position_m: float, velocity_m_s: float) -> Estimate:
    return Estimate(True, position_m, position_m, velocity_m_s, ())


def push(leg: Gear, attempt: int = 0) -> ShiftContext:
    charged = {Gear.BACKWARD: Chamber.B, Gear.NEUTRAL: Chamber.N, Gear.FORWARD: Chamber.F}[leg]
    return ShiftContext(leg, charged, 0, attempt)


@pytest.mark.parametrize("name", BRAKING)
def test_to_neutral_and_in_a_second_attempt_it_is_the_open_loop(name: str) -> None:
    strategy = new_strategy(name)
    fast = seen(0.012, -3.0)
    assert strategy.command(0, fast, push(Gear.NEUTRAL)) == Duties(0.0, 0.98, 0.0)
    assert strategy.command(0, fast, push(Gear.BACKWARD, attempt=1)) == Duties(0.98, 0.0, 0.0)


def test_the_burst_begins_at_the_extrapolated_position_and_lasts_its_time() -> None:
    strategy = new_strategy(
        "air_cushion", trigger_m=0.006, lead_s=0.01, burst_s=0.02, keep_charging=True
    )
    leg = push(Gear.BACKWARD)
    assert strategy.command(0, seen(0.005, 0.09), leg) == Duties(0.98, 0.0, 0.0)
    assert strategy.command(10 * MS, seen(0.005, 0.11), leg) == Duties(0.98, 0.98, 0.0)
    assert strategy.command(20 * MS, seen(0.0, 0.0), leg) == Duties(0.98, 0.98, 0.0)
    assert strategy.command(30 * MS, seen(0.012, 1.0), leg) == Duties(0.98, 0.0, 0.0)
    strategy.reset()
    assert strategy.command(40 * MS, seen(0.007, 0.0), leg).n == 0.98


Fall = tuple[float, float, float]  # difference at time 0 rad/s, its fall rad/s2, growth rad/s3


def reported(fall: Fall, at_ms: int, leg: Gear = Gear.BACKWARD) -> ShiftContext:
    """A push with a report every 10 ms of a speed difference that falls as a parabola."""
    apart, rate, growth = fall
    t_s = 0.01 * (at_ms // 10)
    left = max(0.0, apart - rate * t_s - 0.5 * growth * t_s * t_s)
    sign = -1.0 if leg is Gear.FORWARD else 1.0
    return push(leg)._replace(apart_rad_s=sign * left, apart_ns=at_ms // 10 * 10 * MS)


def commanded(strategy: Strategy, fall: Fall, leg: Gear = Gear.BACKWARD) -> list[Duties]:
    """Duties every 5 ms up to 150 ms."""
    still = seen(0.003, 0.0)
    return [strategy.command(t * MS, still, reported(fall, t, leg)) for t in range(0, 150, 5)]


def test_a_fixed_programme_acts_at_its_times_whatever_is_measured() -> None:
    times = {"rest_begin_s": 0.02, "rest_s": 0.03, "brake_begin_s": 0.04, "brake_s": 0.02}
    strategy = new_strategy("fixed_programme", **times)
    strategy.reset()
    for position_m, speed_m_s in ((0.0, 0.0), (0.012, 1.0)):
        duties_by_step = [
            strategy.command(t * MS, seen(position_m, speed_m_s), push(Gear.FORWARD))
            for t in range(0, 80, 10)
        ]
        assert [10 * k for k, duties in enumerate(duties_by_step) if duties.f == 0.0] == [
            20,
            30,
            40,
        ]
        assert [10 * k for k, duties in enumerate(duties_by_step) if duties.n > 0.0] == [40, 50]


@pytest.mark.parametrize("leg", [Gear.BACKWARD, Gear.FORWARD])
def test_the_synchro_brake_acts_before_the_speeds_are_equal(leg: Gear) -> None:
    """55 = 500 t + 1000/2 t^2 at 0.1 s: brake from 0.08 for 0.02 s, rest from 0.06 for 0.01 s."""
    times = {"brake_lead_s": 0.02, "burst_s": 0.02, "rest_lead_s": 0.04, "rest_s": 0.01}
    strategy = create_strategy(
        FirmwareConfig(
            strategy="synchro_brake",
            period_s=0.005,
            strategy_parameters={**times, "least_lead_s": 0.02, "least_fall_rad_s2": 500.0},
        )
    )
    strategy.reset()
    duties_by_step = commanded(strategy, (55.0, 500.0, 1000.0), leg)
    braked = [5 * k for k, duties in enumerate(duties_by_step) if duties.n > 0.0]
    rested = [5 * k for k, duties in enumerate(duties_by_step) if duties.b + duties.f == 0.0]
    assert braked == [80, 85, 90, 95]
    assert rested == [60, 65]
    strategy.reset()
    assert commanded(strategy, (55.0, 500.0, 1000.0), leg) == duties_by_step


@pytest.mark.parametrize(
    ("fall", "parameters"),
    [
        ((55.0, 500.0, 1000.0), {"least_lead_s": 0.09}),  # known too late: after three reports
        ((20.0, 200.0, 0.0), {}),  # too little force
        ((30.0, 0.0, 0.0), {}),  # nothing falls
    ],
)
def test_the_synchro_brake_is_the_open_loop_where_it_cannot_help(
    fall: Fall, parameters: dict[str, float]
) -> None:
    strategy = new_strategy("synchro_brake", **parameters)
    assert set(commanded(strategy, fall)) == {Duties(0.98, 0.0, 0.0)}


def test_the_synchro_brake_is_the_open_loop_without_speeds() -> None:
    strategy = new_strategy("synchro_brake")
    for t in range(0, 150, 10):
        assert strategy.command(t * MS, seen(0.003, 0.0), push(Gear.BACKWARD)).n == 0.0


def test_blow_cut_ends_the_blow_on_neutral_only_when_a_gear_follows() -> None:
    strategy = new_strategy("blow_cut")
    assert strategy.blow_s(0.15, Gear.NEUTRAL, True) == 0.0
    assert strategy.blow_s(0.15, Gear.NEUTRAL, False) == 0.15
    assert strategy.blow_s(0.15, Gear.BACKWARD, False) == 0.15
    assert new_strategy("blow_cut", neutral_s=0.03).blow_s(0.15, Gear.NEUTRAL, True) == 0.03
    assert new_strategy("blow_cut", otherwise_s=0.01).blow_s(0.15, Gear.FORWARD, False) == 0.01


@pytest.mark.parametrize(
    ("name", "parameters", "place"),
    [
        ("air_cushion", {"lead_s": 3.0}, "lead_s"),
        ("sliding_mode", {"slope_per_s": 0.0}, "slope_per_s"),
        ("synchro_brake", {"least_lead_s": -0.1}, "least_lead_s"),
        ("blow_cut", {"neutral_s": -1.0}, "neutral_s"),
        ("blow_cut", {"neutral": 0.1}, "neutral"),
    ],
)
def test_wrong_settings(name: str, parameters: dict[str, Any], place: str) -> None:
    with pytest.raises(InputError, match=place):
        strategies.parameters(name, parameters)


def test_the_burst_of_air_begins_at_its_trigger_and_lasts_its_time() -> None:
    strategy = new_strategy("air_cushion", trigger_m=0.0078125, lead_s=0.0, burst_s=0.03125)
    pushing, burst = Duties(0.98, 0.0, 0.0), Duties(0.0, 0.98, 0.0)
    start_ns = 10**9
    shift = push(Gear.BACKWARD)._replace(start_ns=start_ns)
    assert strategy.command(start_ns, seen(0.0078, 0.0), shift) == pushing
    assert strategy.command(start_ns, seen(0.0078125, 0.0), shift) == burst
    assert strategy.command(start_ns + 31_249_999, seen(0.01, 0.0), shift) == burst
    assert strategy.command(start_ns + 31_250_000, seen(0.01, 0.0), shift) == pushing


@pytest.mark.parametrize(("leg", "sign"), [(Gear.BACKWARD, 1.0), (Gear.FORWARD, -1.0)])
def test_what_a_braking_strategy_is_given_to_decide_on(
    leg: Gear, sign: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    strategy = new_strategy("air_cushion", patience_s=0.25)
    reported: list[PushProgress] = []

    def decide(seen: PushProgress) -> Command:
        reported.append(seen)
        return Command(True, True)

    monkeypatch.setattr(strategy, "decide", decide)
    late = Estimate(True, 0.5, sign * 0.003, sign * 0.75, (Sample(0.0, 0.0, 0.0),) * 2)
    into = push(leg)._replace(start_ns=100 * MS, apart_rad_s=-7.5, apart_ns=70 * MS)
    both = Duties(0.98, 0.98, 0.0) if sign > 0 else Duties(0.0, 0.98, 0.98)
    assert strategy.command(130 * MS, late, into) == both
    assert reported == [
        PushProgress(pytest.approx(0.03), 0.003, 0.75, 2, 7.5, pytest.approx(-0.03))
    ]
    assert strategy.command(350 * MS - 1, late, into) == both
    alone = Duties(0.98, 0.0, 0.0) if sign > 0 else Duties(0.0, 0.0, 0.98)
    assert strategy.command(350 * MS, late, into) == alone
    assert strategy.command(130 * MS, late, into._replace(attempt=1)) == alone
    strategy.command(130 * MS, late, into._replace(apart_rad_s=None))
    assert reported[-1].apart_rad_s is None and len(reported) == 3


def test_at_the_end_the_sliding_mode_still_presses_on() -> None:
    """slope (stroke + beyond - x) = 60 x 3 mm is above the band at the stop, half of it below."""
    strategy = new_strategy("sliding_mode")
    assert strategy.command(0, seen(0.01285, 0.0), push(Gear.BACKWARD)) == Duties(0.98, 0.0, 0.0)
    assert strategy.command(0, seen(0.01435, 0.0), push(Gear.BACKWARD)) == Duties(0.0, 0.0, 0.0)
    assert strategy.command(0, seen(0.01885, 0.0), push(Gear.BACKWARD)) == Duties(0.0, 0.98, 0.0)


def test_on_the_edges_of_its_band_the_sliding_mode_rests() -> None:
    """Powers of two, so that the surface is met exactly: 64 x 2^-9 m is the band of 1/8 m/s."""
    strategy = new_strategy("sliding_mode", slope_per_s=64.0, band_m_s=0.125, beyond_m=2.0**-9)
    for speed_m_s in (0.0, 0.125, 0.25):
        duties = strategy.command(0, seen(0.01285, speed_m_s), push(Gear.BACKWARD))
        assert duties == Duties(0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("reports", "limits", "release_s"),
    [
        # 10 rad/s a quarter second, then 12 left at 40 rad/s2
        (((0.0, 32.0), (0.25, 22.0), (0.5, 12.0)), {"least_rad_s": 10.0}, 0.5 + 12 / 40),
        (((0.0, 32.0), (0.25, 22.0), (0.5, 12.0)), {"least_fall_rad_s2": 40.0}, 0.5 + 12 / 40),
        # 4, then 8 rad/s2: growing by 16 rad/s3, now 10, so that 10 t + 8 t^2 = 48
        (
            ((0.0, 51.0), (0.25, 50.0), (0.5, 48.0)),
            {"least_fall_rad_s2": 20.0},
            0.5 + (1636**0.5 - 10) / 16,
        ),
    ],
)
def test_a_fall_as_large_as_the_least_is_one(
    reports: Any, limits: dict[str, float], release_s: float
) -> None:
    limits = {"least_rad_s": 0.0, "least_fall_rad_s2": 0.0} | limits
    forecast_s = synchro_brake.release_s(reports, SynchroBrake.Parameters(**limits))
    assert forecast_s == pytest.approx(release_s, rel=1e-9)


@pytest.mark.parametrize("late", [0, 1])
def test_the_synchro_brake_s_times_are_exact_in_steps(late: int) -> None:
    """Powers of two, so that sums are exact: rest 4 steps before the release, brake 2 before it."""
    step_s = 2.0**-8
    strategy = create_strategy(
        FirmwareConfig(
            strategy="synchro_brake",
            period_s=step_s,
            strategy_parameters={
                "rest_lead_s": 4 * step_s,
                "rest_s": 3 * step_s,
                "brake_lead_s": 2 * step_s,
                "burst_s": 2 * step_s,
                "least_lead_s": 4 * step_s,
            },
        )
    )
    strategy.reset()
    # a straight fall that ends after 8.5 steps: steps act for the half period after and before them
    for k, apart_rad_s in enumerate((34.0, 30.0, 26.0)):
        strategy.decide(PushProgress(k * step_s, 0.0, 0.0, 1, apart_rad_s, k * step_s))
    commands = {
        k: strategy.decide(PushProgress(k * step_s, 0.0, 0.0, 1, 26.0, 2 * step_s))
        for k in range(4 + late, 12)
    }
    resting, braking = ([4, 5, 6], [6, 7]) if not late else ([], [])
    assert [k for k, command in commands.items() if not command.charge] == resting
    assert [k for k, command in commands.items() if command.brake] == braking


def forecast(v: float, g: float, end_s: float, **parameters: Any) -> float | None:
    """Forecast of the release at `end_s`, from reports of a fall v + g t at 0, 10 and 20 ms."""
    apart = v * end_s + g * end_s**2 / 2
    begun_s = 0.25
    reports = [(begun_s + t, apart - v * t - g * t**2 / 2) for t in (0.0, 0.01, 0.02)]
    release_s = synchro_brake.release_s(reports, SynchroBrake.Parameters(**parameters))
    return None if release_s is None else release_s - begun_s


@pytest.mark.parametrize(
    ("v", "g"), [(1000.0, 0.0), (1000.0, 5000.0), (900.0, 2e4), (2000.0, 100.0)]
)
def test_the_release_of_a_parabola_is_forecast_exactly(v: float, g: float) -> None:
    assert forecast(v, g, 0.1) == pytest.approx(0.1, rel=1e-9)


def test_a_fall_that_slows_down_is_carried_on_straight() -> None:
    v, g, end_s = 1500.0, -4000.0, 0.1
    apart = v * end_s + g * end_s**2 / 2
    left, fall = apart - v * 0.02 - g * 0.0002, v + g * 0.015
    assert forecast(v, g, end_s) == pytest.approx(0.02 + left / fall, rel=1e-9)


def test_too_weak_a_fall_is_no_release_to_brake() -> None:
    # at the release 1500 rad/s2, and 1100 when last reported
    assert forecast(1000.0, 5000.0, 0.1, least_fall_rad_s2=1499.9) is not None
    assert forecast(1000.0, 5000.0, 0.1, least_fall_rad_s2=1500.1) is None
    # at the release 2100, but 500 when last reported: half of 1000
    assert forecast(100.0, 2e4, 0.1, least_fall_rad_s2=999.9) is not None
    assert forecast(100.0, 2e4, 0.1, least_fall_rad_s2=1000.1) is None
    # from report to report
    assert forecast(51.0, 0.0, 0.1, least_fall_rad_s2=0.0, least_rad_s=0.5) is not None
    assert forecast(49.0, 0.0, 0.1, least_fall_rad_s2=0.0, least_rad_s=0.5) is None


@pytest.mark.parametrize("gap", [None, 62.0])
def test_reports_that_stop_are_forgotten_and_begin_anew(gap: float | None) -> None:
    """Only with the report at 10 ms are there three when the release at 72 ms can be braked."""
    strategy = new_strategy("synchro_brake")
    braked = False
    for k, apart_rad_s in enumerate((72.0, gap, 52.0, 42.0, 42.0, 42.0, 42.0)):
        new = min(k, 3) * 0.01
        braked |= strategy.decide(PushProgress(0.01 * k, 0.0, 0.0, 1, apart_rad_s, new)).brake
    assert braked is (gap is not None)


@pytest.mark.parametrize("period_ns", [10 * MS, 5 * MS, 2_500_000, 2 * MS])
@pytest.mark.parametrize("periods", [1, 2, 3, 7])
def test_a_burst_of_whole_periods_lasts_them_whenever_it_begins(
    period_ns: int, periods: int
) -> None:
    burst_s = float(f"{periods * period_ns * 1e-9:.9g}")
    for begin in range(60):
        strategy = new_strategy(
            "air_cushion", trigger_m=0.006, lead_s=0.0, burst_s=burst_s, patience_s=1.0
        )
        filled = [
            strategy.command(
                tick * period_ns, seen(0.007 * (tick >= begin), 0.0), push(Gear.BACKWARD)
            ).n
            for tick in range(begin + periods + 2)
        ]
        assert filled == [0.0] * begin + [0.98] * periods + [0.0] * 2


QUICK = FirmwareConfig(
    period_s=0.0025, sensor=SensorConfig(period_s=0.0025), filter=FilterConfig(enabled=False)
)
PUSH = ShiftContext(Gear.BACKWARD, Chamber.B, 0, 0)
QUICK_VALVES = {"model": {"valve_close_s": 0.005}, "observer": {"sensor_age_s": 0.0}}

TABLE = BangBang.Parameters().table
N = math.inf  # never


def new_foresight(name: str, **parameters: Any) -> Foresight:
    import msgspec

    config = msgspec.structs.replace(QUICK, strategy=name, strategy_parameters=parameters)
    strategy = create_strategy(config)
    strategy.reset()
    return strategy


def played(strategy: Strategy) -> tuple[float, float]:
    """Run a strategy against the light model, seen without delay; impact speed and time."""
    truth = Observer(QUICK, ModelSettings(valve_close_s=0.005), ObserverSettings())
    speed_m_s, now_s = 0.0, 0.0
    for tick in range(80):
        now_s = tick * 0.0025
        while truth.time_s < now_s - 0.5 * STEP_S:
            speed_m_s = truth.motion.stay_m_s
            truth.advance(truth.time_s + STEP_S, 0.0, 0)
            if truth.motion.stay_m >= truth.model.stroke_m:
                return speed_m_s, truth.time_s
        x_m = truth.travelled_m
        sample = Sample(x_m, x_m, 0.0)
        duties = strategy.command(
            round(now_s * 1e9), Estimate(True, x_m, x_m, 0.0, (sample,)), PUSH
        )
        truth.command(duties.b > 0.5, duties.n > 0.5)
    return 0.0, now_s


@pytest.mark.parametrize("name", ["bang_bang", "predictive"])
def test_with_the_true_model_and_quick_hardware_the_stop_is_soft(name: str) -> None:
    open_loop_m_s, open_loop_s = played(create_strategy(QUICK))
    table = {"table": [[9e5, 0.025]], "brake_s": 0.015} if name == "bang_bang" else {}
    speed_m_s, time_s = played(new_foresight(name, **QUICK_VALVES, **table))
    assert open_loop_m_s > 0.7
    assert speed_m_s < 0.6 * open_loop_m_s
    assert time_s < open_loop_s + 0.04


def test_a_trial_leaves_the_observer_as_it_was() -> None:
    strategy = new_foresight("predictive", **QUICK_VALVES)
    strategy.observer.command(True, False)
    strategy.observer.advance(0.01, 0.0, 0)
    first = strategy.trial(0.0, 0.01, N, N)
    assert strategy.trial(0.0, 0.01, N, N) == first
    assert strategy.observer.time_s == pytest.approx(0.01)


def test_stored_times_lie_on_lines_between_the_entries() -> None:
    for pressure_pa, switch_s in TABLE:
        assert stored_s(TABLE, pressure_pa) == switch_s
    (low_pa, low_s), (high_pa, high_s) = TABLE[:2]
    assert stored_s(TABLE, 0.5 * (low_pa + high_pa)) == pytest.approx(0.5 * (low_s + high_s))
    assert stored_s(TABLE, 1e5) == TABLE[0][1] and stored_s(TABLE, 1e7) == TABLE[-1][1]


@pytest.mark.parametrize("wanted_m_s", [0.2, 0.5])
def test_bang_bang_brakes_as_late_as_the_wanted_speed_allows(
    wanted_m_s: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    strategy = new_foresight("bang_bang", **QUICK_VALVES, brake_s=0.015, impact_m_s=wanted_m_s)
    strategy.observer.command(True, False)
    strategy.observer.advance(0.01, 0.0, 0)

    def impact_m_s(brake_on_s: float) -> float:
        off_s = brake_on_s + 0.015
        return strategy.trial(brake_on_s, off_s, brake_on_s, off_s).speed_m_s

    strategy._moved = True
    latest_s = strategy._solved_s()
    assert 0.005 < latest_s < 0.02
    trials: list[float] = []
    with monkeypatch.context() as patched:
        patched.setattr(strategy, "_speed_m_s", lambda s: trials.append(s) or impact_m_s(s))
        assert strategy._solved_s() == latest_s
    assert len(trials) == 8
    assert impact_m_s(latest_s) <= wanted_m_s < impact_m_s(latest_s + 0.06 / 2**6)
    strategy.observer.advance(0.04, 0.0, 0)  # now even braking at once is too late
    assert strategy._solved_s() == 0.0
    assert strategy.plan(0.04).brake
    patient = new_foresight("bang_bang", **QUICK_VALVES, impact_m_s=3.0)
    assert patient._solved_s() == patient.parameters.horizon_s
    anxious = new_foresight("bang_bang", **QUICK_VALVES, impact_m_s=0.0)
    assert anxious._solved_s() == 0.0  # even what does not arrive within the horizon is too fast


def test_bang_bang_s_times_are_exact_in_steps() -> None:
    """Powers of two, so that sums are exact: motion at 2 steps, the switch half a step away."""
    step_s = 2.0**-8
    config = FirmwareConfig(
        strategy="bang_bang",
        period_s=step_s,
        strategy_parameters={
            "table": [[9e5, 2.5 * step_s]],
            "brake_s": 3 * step_s,
            "seen_m": 2.0**-11,
        },
    )
    strategy = create_strategy(config)
    strategy.reset()
    commands = [strategy.decide(PushProgress(k * step_s, 0.0, 0.0, 0)) for k in range(8)]
    assert [k for k, command in enumerate(commands) if command.brake] == [3, 4, 5]
    assert all(command.charge is not command.brake for command in commands)
    strategy.reset()
    for travelled_m, moved in ((2.0**-11 - 2.0**-20, False), (2.0**-11, True), (0.0, True)):
        strategy.decide(PushProgress(0.0, travelled_m, 0.0, 0))
        assert strategy._moved is moved


@pytest.mark.parametrize("table", [[], [[9e5, 0.0], [6e5, 0.0]], [[6e5, 0.0], [6e5, 0.1]]])
def test_a_table_out_of_order_is_refused(table: list[list[float]]) -> None:
    with pytest.raises(InputError, match="ascending supply pressures"):
        strategies.parameters("bang_bang", {"table": table})


@pytest.mark.parametrize(("name", "most_trials"), [("bang_bang", 8), ("predictive", 27)])
def test_model_steps_of_one_call_are_bounded(
    name: str, most_trials: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    counted = [0]
    step = LightModel.step

    def counting(*arguments: Any) -> None:
        counted[0] += 1
        step(*arguments)

    monkeypatch.setattr(LightModel, "step", counting)
    strategy = new_foresight(name, horizon_s=0.06)
    most = 0
    for tick in range(40):
        x_m = min(0.0003 * tick, 0.012)
        counted[0] = 0
        sample = Sample(x_m, x_m, 0.1)
        strategy.command(tick * 2_500_000, Estimate(True, x_m, x_m, 0.1, (sample,)), PUSH)
        most = max(most, counted[0])
    assert 0 < most <= most_trials * 120 + 5


@pytest.mark.parametrize(("charge", "brake"), [(True, False), (False, True)])
def test_the_observer_is_brought_up_to_now_and_told_what_was_chosen(
    charge: bool, brake: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    strategy = create_strategy(FirmwareConfig(strategy="predictive"))
    calls: list[tuple[object, ...]] = []
    monkeypatch.setattr(strategy.observer, "advance", lambda *given: calls.append(given))
    monkeypatch.setattr(strategy.observer, "command", lambda *given: calls.append(given))

    def plan(spent_s: float) -> Command:
        calls.append((spent_s,))
        return Command(charge, brake)

    monkeypatch.setattr(strategy, "plan", plan)
    assert strategy.decide(PushProgress(0.02, 0.003, 0.4, 2)) == Command(charge, brake)
    assert calls == [(0.02, 0.003, 2), (0.02,), (charge, brake)]


@pytest.mark.parametrize("horizon_s", [0.02, 0.03, 0.04, 0.08])
@pytest.mark.parametrize("late_steps", [0, 2])
@pytest.mark.parametrize(
    "sequence",
    [
        (N, N, N, N),
        (0.0, 0.002, N, N),
        (0.002, 0.004, 0.001, 0.003),
        (0.02, 0.03, 0.02, 0.03),
        (N, N, 0.0, 0.002),
    ],
)
def test_a_trial_is_the_model_with_the_commands_at_their_steps(
    sequence: tuple[float, float, float, float], late_steps: int, horizon_s: float
) -> None:
    """With valves that follow at once: the model stepped by hand."""
    quick = {"valve_open_s": 0.0, "valve_close_s": 0.0, "transport_s": late_steps * STEP_S}
    config = FirmwareConfig(
        strategy="predictive", strategy_parameters={"model": quick, "horizon_s": horizon_s}
    )
    strategy = create_strategy(config)
    strategy.reset()
    brake_on_s, brake_off_s, charge_off_s, charge_on_s = sequence
    model, motion = strategy.observer.model, copy(strategy.observer.motion)
    for step in range(round(horizon_s / STEP_S)):
        given_s = (step - late_steps) * STEP_S
        charge = given_s >= 0.0 and not charge_off_s <= given_s < charge_on_s
        brake = given_s >= 0.0 and brake_on_s <= given_s < brake_off_s
        before_m_s = motion.stay_m_s
        model.step(motion, charge, brake, STEP_S)
        if motion.stay_m >= model.stroke_m:
            outcome = (before_m_s, step * STEP_S, 0.0)
            break
    else:
        outcome = (0.0, horizon_s, model.stroke_m - motion.stay_m)
    assert strategy.trial(*sequence) == pytest.approx(outcome, rel=1e-12)
    assert strategy.observer.motion.stay_m == 0.0  # and it has moved nothing


BURSTS = [(begin, begin + lasts) for begin in range(4) for lasts in (1, 2, 4)]
CHARGED = [[(*burst, N, N), (*burst, *burst)] for burst in BURSTS]
TRIED = ((N, N, N, N), *chain(*CHARGED), (N, N, 0, 1), (N, N, 0, 2))


def test_the_sequences_that_are_tried_in_periods() -> None:
    """Brake on, off, charge off, on: doing nothing first, bursts with and without charge, pauses of it."""
    assert sequences(1.0) == TRIED
    assert sequences(0.5)[1] == (0.0, 0.5, N, N)


@pytest.mark.parametrize(
    ("best", "command"),
    [
        ((N, N, N, N), Command(True, False)),
        ((0.0, 0.02, N, N), Command(True, True)),
        ((0.0, 0.02, 0.0, 0.02), Command(False, True)),
        ((0.01, 0.02, N, N), Command(True, False)),
        ((N, N, 0.0, 0.01), Command(False, False)),
    ],
)
@pytest.mark.parametrize("by", ["speed", "time", "way"])
def test_the_first_step_of_the_cheapest_sequence_is_taken(
    best: tuple[float, ...], command: Command, by: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Cost = speed + 10 time + 300 way: each in turn is 0.1 less for one sequence."""
    strategy = create_strategy(FirmwareConfig(strategy="predictive"))
    saved = {"speed": (0.9, 0.05, 0.001), "time": (1.0, 0.04, 0.001), "way": (1.0, 0.05, 0.0002)}[
        by
    ]

    def trial(*sequence: float) -> Outcome:
        return Outcome(*(saved if sequence == pytest.approx(best) else (1.0, 0.05, 0.001)))

    monkeypatch.setattr(strategy, "trial", trial)
    assert strategy.plan(0.0) == command


def test_of_equal_sequences_the_one_that_does_least_is_taken(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    strategy = create_strategy(FirmwareConfig(strategy="predictive"))
    monkeypatch.setattr(strategy, "trial", lambda *sequence: Outcome(1.0, 0.05, 0.001))
    assert strategy.plan(0.0) == Command(True, False)

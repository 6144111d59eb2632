"""Blow cut, air cushion, sliding mode, synchro brake: their commands for given inputs."""

from __future__ import annotations

from typing import Any

import pytest

from can_dbc.errors import InputError
from can_dbc.messages import Chamber, Gear
from controller import strategies
from controller.config import FirmwareConfig, create_strategy
from controller.position import Estimate, Sample
from controller.strategies import Duties, ShiftContext, Strategy, synchro_brake
from controller.strategies.into_gear import Command, IntoGear, PushProgress
from controller.strategies.synchro_brake import SynchroBrake

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


@pytest.mark.parametrize("name", BRAKING)
@pytest.mark.parametrize(("leg", "sign"), [(Gear.BACKWARD, 1.0), (Gear.FORWARD, -1.0)])
def test_it_brakes_with_neutral_and_pushes_again_when_patience_ends(
    name: str, leg: Gear, sign: float
) -> None:
    strategy = new_strategy(name, patience_s=0.1)
    near_and_fast = seen(sign * 0.011, sign * 2.0)
    braking = strategy.command(50 * MS, near_and_fast, push(leg))
    assert braking.n == 0.98
    after = strategy.command(100 * MS, near_and_fast, push(leg))
    assert after == (Duties(0.98, 0.0, 0.0) if sign > 0 else Duties(0.0, 0.0, 0.98))


@pytest.mark.parametrize("name", BRAKING)
def test_the_two_gears_mirror_each_other(name: str) -> None:
    one, other = new_strategy(name), new_strategy(name)
    for step in range(12):
        x_m, v_m_s = 0.0011 * step, 0.15 * step
        b = one.command(step * 10 * MS, seen(x_m, v_m_s), push(Gear.BACKWARD))
        f = other.command(step * 10 * MS, seen(-x_m, -v_m_s), push(Gear.FORWARD))
        assert (b.b, b.n, b.f) == (f.f, f.n, f.b)


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


def test_the_charge_may_be_cut_during_the_burst() -> None:
    strategy = new_strategy("air_cushion", trigger_m=0.006, keep_charging=False)
    assert strategy.command(0, seen(0.007, 0.0), push(Gear.BACKWARD)) == Duties(0.0, 0.98, 0.0)


@pytest.mark.parametrize(
    ("speed_m_s", "duties"),
    [
        (0.49, Duties(0.98, 0.0, 0.0)),  # s = 50 * 0.012 - 0.49 = 0.11: above the band
        (0.51, Duties(0.0, 0.0, 0.0)),
        (0.69, Duties(0.0, 0.0, 0.0)),
        (0.71, Duties(0.0, 0.98, 0.0)),
    ],
)
def test_sliding_mode_takes_the_side_of_its_surface(speed_m_s: float, duties: Duties) -> None:
    strategy = new_strategy("sliding_mode", slope_per_s=50.0, band_m_s=0.1, beyond_m=0.0)
    assert strategy.command(0, seen(0.00085, speed_m_s), push(Gear.BACKWARD)) == duties


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


def test_blow_cut_pushes_as_the_open_loop() -> None:
    strategy = new_strategy("blow_cut")
    for leg in (Gear.BACKWARD, Gear.NEUTRAL, Gear.FORWARD):
        assert sum(strategy.command(0, seen(0.0, 0.0), push(leg))) == 0.98


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
    assert isinstance(strategy, IntoGear)
    reported: list[PushProgress] = []

    def decide(seen: PushProgress) -> Command:
        reported.append(seen)
        return Command(True, True)

    monkeypatch.setattr(strategy, "decide", decide)
    samples = (Sample(0.0, 0.0, 0.0),) * 2
    late = Estimate(True, 0.5, sign * 0.003, sign * 0.75, samples)
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
    assert isinstance(strategy, SynchroBrake)
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
    assert isinstance(strategy, IntoGear)
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

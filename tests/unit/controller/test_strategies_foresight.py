"""Bang-bang and predictive control: what they plan with the light model, and what it costs."""

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
from controller.strategies import ShiftContext, Strategy
from controller.strategies.bang_bang import BangBang, stored_s
from controller.strategies.foresight import Foresight, Outcome
from controller.strategies.into_gear import Command, PushProgress
from controller.strategies.predictive import sequences

QUICK = FirmwareConfig(
    period_s=0.0025,
    sensor=SensorConfig(period_s=0.0025),
    filter=FilterConfig(enabled=False),
)
PUSH = ShiftContext(Gear.BACKWARD, Chamber.B, 0, 0)
QUICK_VALVES = {"model": {"valve_close_s": 0.005}, "observer": {"sensor_age_s": 0.0}}

TABLE = BangBang.Parameters().table
N = math.inf  # never


def new_strategy(name: str, **parameters: Any) -> Foresight:
    import msgspec

    config = msgspec.structs.replace(QUICK, strategy=name, strategy_parameters=parameters)
    strategy = create_strategy(config)
    assert isinstance(strategy, Foresight)
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
    speed_m_s, time_s = played(new_strategy(name, **QUICK_VALVES, **table))
    assert open_loop_m_s > 0.7
    assert speed_m_s < 0.6 * open_loop_m_s
    assert time_s < open_loop_s + 0.04


def test_a_trial_is_the_observer_s_model_run_on() -> None:
    strategy = new_strategy("predictive", **QUICK_VALVES)
    strategy.observer.command(True, False)
    result = strategy.trial(N, N, N, N)
    speed_m_s = 0.0
    observer = strategy.observer
    while observer.motion.stay_m < observer.model.stroke_m:
        speed_m_s = observer.motion.stay_m_s
        observer.advance(observer.time_s + STEP_S, 0.0, 0)
    assert result.speed_m_s == speed_m_s
    assert result.left_m == 0.0
    assert result.time_s == pytest.approx(observer.time_s, abs=1.01 * STEP_S)


def test_a_trial_leaves_the_observer_as_it_was() -> None:
    strategy = new_strategy("predictive", **QUICK_VALVES)
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
    assert stored_s(TABLE, 1e5) == TABLE[0][1]
    assert stored_s(TABLE, 1e7) == TABLE[-1][1]


def test_bang_bang_switches_once_and_brakes_for_its_time() -> None:
    strategy = new_strategy("bang_bang", brake_s=0.02)
    assert isinstance(strategy, BangBang)
    still = Estimate(True, 0.0, 0.0, 0.0, ())
    braked = [strategy.command(tick * 2_500_000, still, PUSH).n > 0.5 for tick in range(40)]
    begun = braked.index(True)
    assert begun == round(stored_s(TABLE, 9e5) / 0.0025)
    assert braked == [begun <= tick < begun + 8 for tick in range(40)]


@pytest.mark.parametrize("wanted_m_s", [0.2, 0.5])
def test_bang_bang_brakes_as_late_as_the_wanted_speed_allows(
    wanted_m_s: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    strategy = new_strategy("bang_bang", **QUICK_VALVES, brake_s=0.015, impact_m_s=wanted_m_s)
    assert isinstance(strategy, BangBang)
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
    patient = new_strategy("bang_bang", **QUICK_VALVES, impact_m_s=3.0)
    assert isinstance(patient, BangBang)
    assert patient._solved_s() == patient.parameters.horizon_s
    anxious = new_strategy("bang_bang", **QUICK_VALVES, impact_m_s=0.0)
    assert isinstance(anxious, BangBang)
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
    assert isinstance(strategy, BangBang)
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


def test_sequences_are_few_and_the_first_does_nothing() -> None:
    result = sequences(0.01)
    assert len(result) == len(set(result)) == 27
    assert result[0].brake_on_s > 1.0
    assert all(
        s.brake_off_s - s.brake_on_s in (0.0, 0.01, 0.02, 0.04) or s.brake_on_s for s in result
    )


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
    strategy = new_strategy(name, horizon_s=0.06)
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
    assert isinstance(strategy, Foresight)
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
    assert isinstance(strategy, Foresight)
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
    assert isinstance(strategy, Foresight)
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
    assert isinstance(strategy, Foresight)
    monkeypatch.setattr(strategy, "trial", lambda *sequence: Outcome(1.0, 0.05, 0.001))
    assert strategy.plan(0.0) == Command(True, False)

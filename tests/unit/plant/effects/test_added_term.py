"""Terms that effects add: in single strokes, batches, fixed piston and length stroke, derivatives, runs."""

from __future__ import annotations

import numpy as np
import pytest

from plant.batch.batch import Strokes, simulate_batch
from plant.batch.prediction import Predictor
from plant.effects.added_term import MOST_ADDED, AddedTerm, Slot
from plant.effects.setup import Setup
from plant.effects.stroke_conditions import StrokeConditions
from plant.errors import InputError
from plant.integrator.loop import DONE
from plant.parameters import load
from plant.systems.setup import make_setup
from plant.systems.stroke import run_setup

VALVE = {"fixed": "1", "N-B": "B", "F-N": "N"}
TIME_S = np.linspace(0.0, 0.25, 126)


def setup_of(kind: str) -> Setup:
    return make_setup(load(), StrokeConditions(kind, 9e5, ((0.01, VALVE[kind], 0.98),)))


def spring(position_m: float, rate_n_m: float, x0_m: float) -> float:
    return -rate_n_m * (position_m - x0_m)


def drag(direction: float, force_n: float, more_n: float) -> float:
    return force_n + direction * more_n


def leak(pressure_pa: float, valve: float, per_pa: float) -> float:
    return (1.0 - 0.5 * valve) * per_pa * (pressure_pa - 101325.0)


def share(pressure_ratio: float, amount: float) -> float:
    return amount * pressure_ratio


def shifted(speed_m_s: float, amount: float) -> float:
    return amount * speed_m_s


SPRING = AddedTerm(Slot.FORCE, spring)


@pytest.mark.parametrize("kind", VALVE)
def test_a_force_that_is_a_spring_moves_as_the_spring_of_the_equations(kind) -> None:
    one, other = setup_of(kind), setup_of(kind)
    one.p.spring_k, one.p.spring_x0 = 8000.0, 0.001
    SPRING.add_to(other, rate_n_m=8000.0, x0_m=0.001)
    stroke, added = run_setup(one, TIME_S), run_setup(other, TIME_S)
    assert np.allclose(added.states, stroke.states, rtol=1e-6, atol=1e-8)
    assert added.balance.closed and np.ptp(added.position_m) > 0.003
    nominal = run_setup(setup_of(kind), TIME_S)
    assert np.abs(nominal.position_m - added.position_m).max() > 1e-4


@pytest.mark.parametrize(
    ("slot", "function", "values"),
    [
        (Slot.RESISTANCE, drag, {"force_n": 60.0, "more_n": 5.0}),
        (Slot.LEAK, leak, {"per_pa": 1e-6}),
        (Slot.FLOW_1, leak, {"per_pa": -1e-6}),
        (Slot.FLOW_2, leak, {"per_pa": 1e-6}),
        (Slot.CHARGE, share, {"amount": -0.4}),
        (Slot.DISCHARGE, share, {"amount": -0.1}),
        (Slot.EXPONENT, shifted, {"amount": 0.1}),
    ],
)
@pytest.mark.parametrize("kind", ["fixed", "N-B"])
def test_every_slot_changes_the_stroke_and_balances_close(kind, slot, function, values) -> None:
    setup = setup_of(kind)
    AddedTerm(slot, function).add_to(setup, **values)
    stroke, nominal = run_setup(setup, TIME_S), run_setup(setup_of(kind), TIME_S)
    assert stroke.balance.closed
    assert np.abs(stroke.states - nominal.states).max() > 1e-4


def test_a_batch_runs_strokes_with_and_without_terms() -> None:
    plain, changed = setup_of("N-B"), setup_of("N-B")
    SPRING.add_to(changed, rate_n_m=8000.0, x0_m=0.001)
    strokes = Strokes.from_setups([plain, changed, plain], 0.25)
    result = simulate_batch(strokes, sample_s=TIME_S)
    assert result.in_lanes.tolist() == [True, False, True] and (result.status == DONE).all()
    alone = simulate_batch(Strokes.from_setups([plain], 0.25), sample_s=TIME_S)
    assert (result.samples[0] == alone.samples[0]).all()
    single = run_setup(changed, TIME_S).position_m
    assert np.abs(result.samples[1, :, 0] - single).max() < 1e-6


def test_derivatives_by_a_value_are_those_of_wide_differences() -> None:
    def at(rate_n_m: float) -> Setup:
        setup = setup_of("fixed")
        SPRING.add_to(setup, rate_n_m=rate_n_m, x0_m=0.001)
        return setup

    predictor = Predictor((TIME_S * 1e9).astype(np.int64))
    _states, (slope,) = predictor.derivatives(at(8000.0), [at(8000.01)], [0.01], [0])
    assert slope is not None
    wide = (
        run_setup(at(8100.0), TIME_S).position_m - run_setup(at(7900.0), TIME_S).position_m
    ) / 200
    assert np.abs(slope[:, 0] - wide).max() < 0.02 * np.abs(wide).max()


def test_what_does_not_fit_is_refused() -> None:
    setup = setup_of("fixed")
    with pytest.raises(InputError, match="values force_n; expected rate_n_m, x0_m"):
        SPRING.add_to(setup, force_n=1.0)
    for _ in range(MOST_ADDED):
        SPRING.add_to(setup, rate_n_m=1.0, x0_m=0.0)
    with pytest.raises(
        InputError, match="4 added terms of 8 values on one stroke; expected at most 3"
    ):
        SPRING.add_to(setup, rate_n_m=1.0, x0_m=0.0)

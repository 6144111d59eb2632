"""The model under recorded commands gives the recorded pulses, and its derivatives are differences."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from plant.parameters import load
from sil.shift_diagnosis.linear import (
    INSTANT_S,
    TRIED_S,
    Noise,
    _kink_variance,
    estimates,
    explained,
    hidden_cost,
    linearise,
    projected,
)
from sil.shift_diagnosis.model import PlantModel, Point, catalogue
from sil.shift_diagnosis.shifts import RecordedShift, shifts_of

TICK_M = 1e-6 / 0.022


@pytest.fixture(scope="module")
def shifts(nominal_log: Path) -> list[RecordedShift]:
    return list(shifts_of(str(nominal_log), load("nominal"), None, Counter()))


def test_the_nominal_truck_gives_the_recorded_pulses(shifts: list[RecordedShift]) -> None:
    model = PlantModel(load("nominal"), mounted=True)
    x, v, done = model.predict(shifts, [Point(), Point({"rise": 0.002})])
    assert done.all()
    for k, shift in enumerate(shifts):
        n = len(shift.time_s)
        # half a timer tick, and the way of a frame on a bus with others at that speed
        allowed = 0.6 * TICK_M + 1.5e-4 * np.abs(v[k, 0, :n])
        assert (np.abs(shift.position_m - x[k, 0, :n]) < allowed).mean() > 0.97
        assert np.max(np.abs(shift.position_m - x[k, 1, :n])) > 20 * TICK_M


def test_a_linear_model_is_a_sum_over_shifts(shifts: list[RecordedShift]) -> None:
    model = PlantModel(load("nominal"), mounted=True)
    causes = [c for c in catalogue() if c.effect.id in ("valve_open_delay", "sensor_delay")]
    values = np.zeros(17)
    whole = linearise(model, shifts, values, causes)
    parts = [linearise(model, [shift], values, causes) for shift in shifts]
    assert np.allclose(whole.information, np.concatenate([p.information for p in parts]))
    assert np.allclose(whole.score, np.concatenate([p.score for p in parts]))
    information, score = projected(whole)
    assert information[0, 1] ** 2 > 0.9 * information[0, 0] * information[1, 1]
    alone = linearise(model, shifts, values, causes[:1])
    joint, covariance = estimates(alone)  # the projection is the joint estimate's
    precision = information[0, 0] + 1.0 / 9.0
    assert joint[-1] == pytest.approx(score[0] / precision, rel=1e-6, abs=1e-9)
    assert covariance[-1, -1] == pytest.approx(1.0 / precision, rel=1e-6)


def test_a_cause_is_hidden_by_what_trucks_differ_in(shifts: list[RecordedShift]) -> None:
    model = PlantModel(load("nominal"), mounted=True)
    causes = [c for c in catalogue() if c.effect.id in ("valve_open_delay", "dynamic_friction")]
    linear = linearise(model, shifts, np.zeros(17), causes, noise=Noise(scatter=0.25))
    sizes = np.array([0.5, 1.0, 2.0])
    hidden, deviation = hidden_cost(linear, sizes)
    alone = np.diag(linear.information.sum(axis=0))[17:]
    assert (np.diff(hidden, axis=1) > 0.0).all()
    assert (hidden < 0.2 * 0.5 * sizes**2 * alone[:, None]).all()
    # of normal priors it is the root of twice the cost, and less in their tails
    assert (deviation < 1.1 * np.sqrt(2.0 * hidden)).all()
    small, spread = hidden_cost(linear, np.array([0.01]))
    assert spread == pytest.approx(np.sqrt(2.0 * 7.0 / 6.0 * small), rel=0.1)
    # a usual truck needs no cause, and with one in its score the cause is found again
    _cost, point = explained(linear)
    assert np.abs(point).max() < 2.0
    k = [cause.effect.id for cause in causes].index("valve_open_delay")
    pairs = zip(linear.residuals, linear.slopes, strict=True)
    delayed = replace(linear, residuals=tuple(r + 3.0 * a[:, 17 + k] for r, a in pairs))
    best, point = explained(delayed, k)
    assert best < explained(delayed)[0] - 3.0
    assert point[-1] == pytest.approx(3.0, abs=1.0)


@pytest.mark.parametrize("name", ["sensor_gain", "sensor_delay", "valve_open_delay"])
def test_what_a_hidden_cause_costs_and_its_deviation_are_those_of_drawn_trucks(
    name: str, shifts: list[RecordedShift]
) -> None:
    model = PlantModel(load("nominal"), mounted=True)
    causes = [cause for cause in catalogue() if cause.effect.id == name]
    linear = linearise(model, shifts, np.zeros(17), causes, noise=Noise(scatter=0.25))
    size, rng = 2.0, np.random.default_rng(1)
    cost, deviation = hidden_cost(linear, np.array([0.5 * size, size]))
    noises = [np.linalg.cholesky(np.linalg.inv(w)) for w in linear.weights]
    gains = []
    for _ in range(100):
        truck = np.append(rng.normal(size=17), size)
        drawn = tuple(
            a @ truck + noise @ rng.normal(size=len(noise))
            for a, noise in zip(linear.slopes, noises, strict=True)
        )
        own = replace(linear, residuals=drawn)
        gains.append(explained(own)[0] - explained(own, 0)[0])
    # with the cause, its own prior is paid
    assert np.mean(gains) == pytest.approx(cost[0, 1] - 0.5 * (size / 3.0) ** 2, rel=0.1)
    assert np.std(gains) == pytest.approx(deviation[0, 1], rel=0.35)


def test_an_unknown_speed_is_not_simulated(shifts: list[RecordedShift]) -> None:
    model = PlantModel(load("nominal"), mounted=True)
    with pytest.raises(ValueError, match="speed difference"):
        model.predict([replace(shifts[0], difference_rad_s=float("nan"))], [Point()])


def test_kinks_that_cannot_be_simulated_add_nothing(
    shifts: list[RecordedShift], monkeypatch: pytest.MonkeyPatch
) -> None:
    model = PlantModel(load("nominal"), mounted=True)
    predict, asked = model.predict, []

    def broken(own: list[RecordedShift], points: list[Point]) -> tuple[np.ndarray, ...]:
        x, v, done = predict(own, points)
        asked.append(len(points))
        x[:, -2 * len(TRIED_S) :], done[:, -2 * len(TRIED_S) :] = np.nan, False
        return x, v, done

    whole = linearise(model, shifts[:1], np.zeros(17))
    monkeypatch.setattr(model, "predict", broken)
    found = linearise(model, shifts[:1], np.zeros(17))
    assert np.isfinite(found.weights[0]).all()
    # a kink makes a pulse count less
    with_kinks, without = (np.diag(np.linalg.inv(own.weights[0])) for own in (whole, found))
    assert (with_kinks > without - 1e-15).all() and with_kinks.max() > 2.0 * without.min()
    linearise(model, shifts[:1], np.zeros(17), noise=Noise(weights=found.weights))
    assert asked[1] == asked[0] - 2 * len(TRIED_S)


def test_a_kink_adds_the_way_that_the_speed_does_not_say() -> None:
    speed_m_s = np.array([0.5, 0.0, 0.0])  # moving, just arrived, at rest for long
    moved_m = 0.5 * TRIED_S[:, None] * np.array([1.0, 1.0, 0.0])
    apart_m = np.array([moved_m, moved_m * np.array([1.0, 0.0, 0.0])])
    found = _kink_variance(apart_m, speed_m_s, np.zeros(3))
    # 1 and 2 standard deviations of the least scatter, on one side, at their shares of a normal one
    way_m = 0.5 * INSTANT_S[0]
    assert found == pytest.approx([0.0, 0.242 * way_m**2 + 0.054 * (2.0 * way_m) ** 2, 0.0])
    later = _kink_variance(apart_m, speed_m_s, np.array([5e-4, 0.0, 0.0]))
    assert later[1] == pytest.approx(4.0 * found[1])


def test_points_of_one_motion_are_read_from_one_stroke(shifts: list[RecordedShift]) -> None:
    """Pulses that come later see the same motion: the same as by strokes of their own."""
    model = PlantModel(load("nominal"), mounted=True)
    later = [Point({"latency": by}) for by in (0.0, 1e-3, -2e-3)]
    points = [*later, Point({"rise": 1e-3, "offset": 1e-4, "gain": 0.01})]
    together = model.predict(shifts, points)
    for j, point in enumerate(points):
        alone = PlantModel(load("nominal"), mounted=True).predict(shifts, [point])
        for found, own in zip(together, alone, strict=True):
            assert np.allclose(found[:, j], own[:, 0], rtol=0.0, atol=1e-12, equal_nan=True)
    x, again = together[0], model.predict(shifts, points)[0]
    assert np.array_equal(x, again, equal_nan=True)
    assert np.nanmax(np.abs(x[:, 1] - x[:, 0])) > 1e-4

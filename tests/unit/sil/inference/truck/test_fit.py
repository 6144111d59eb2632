"""Fits of a truck: the arrow's steps, what never gets worse, scales, evidence and profiles."""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np
import pytest

from plant.parameters import load
from sil.inference.truck import fit as truck_fit
from sil.inference.truck.diagnosis import rest_noise_m
from sil.inference.truck.fit import (
    COARSE_M,
    FINE_M,
    FIRST_FACTOR,
    MIDDLE_M,
    PRIORS,
    STEPS,
    Fit,
    Fitter,
    System,
)
from sil.inference.truck.simulator import ShiftModel
from sil.log_replay.recorded_shifts import RecordedShift
from tests.unit.sil.inference.truck.test_causes import only


def drawn_system(rng: np.random.Generator) -> tuple[System, np.ndarray, np.ndarray]:
    """Return the blocks of two shifts with two quantities each and three shared, and the whole."""
    root = rng.normal(size=(7, 7))
    whole = root @ root.T + np.eye(7)
    whole[3:5, 5:7] = whole[5:7, 3:5] = 0.0
    whole += 9.0 * np.eye(7)
    gradient = rng.normal(size=7)
    own = np.array([whole[3:5, 3:5], whole[5:7, 5:7]])
    coupling = np.array([whole[:3, 3:5], whole[:3, 5:7]])
    blocks = System(whole[:3, :3], gradient[:3], coupling, own, gradient[3:].reshape(2, 2))
    return blocks, whole, gradient


def test_steps_are_those_of_the_whole_matrix() -> None:
    system, whole, gradient = drawn_system(np.random.default_rng(4))
    dampings = (0.0, 0.5)
    rows = zip(dampings, *system.steps(dampings), system.own_steps(dampings), strict=True)
    for damping, shared, own, own_alone in rows:
        step = np.linalg.solve(whole + damping * np.diag(np.diag(whole)), gradient)
        assert np.concatenate([shared, own.ravel()]) == pytest.approx(step)
        alone = whole[3:, 3:] + damping * np.diag(np.diag(whole[3:, 3:]))
        expected = np.linalg.solve(alone, system.own_gradient.ravel())
        assert own_alone.ravel() == pytest.approx(expected)


def test_the_marginal_information_is_that_of_the_whole_matrix() -> None:
    system, whole, _ = drawn_system(np.random.default_rng(5))
    assert np.linalg.inv(system.marginal) == pytest.approx(np.linalg.inv(whole)[:3, :3])


def test_no_round_and_no_scan_makes_a_fit_worse(fitter: Fitter, usual: Fit) -> None:
    coarse = fitter.evaluated(usual, COARSE_M)
    scanned = fitter.rescanned(coarse, COARSE_M, np.random.default_rng(1))
    better = fitter.improved(scanned, COARSE_M, 2)
    assert better.cost <= scanned.cost <= coarse.cost
    assert better.cost == pytest.approx(fitter.evaluated(better, COARSE_M).cost)


def test_slopes_that_follow_the_steps_lead_there_by_fewer_strokes(
    fitter: Fitter, usual: Fit
) -> None:
    unit = usual.unit.copy()
    unit[[fitter.layout.at[name] for name in ("supply", "mass", "linkage")]] = -2.0, 2.0, 1.5
    begun = fitter.evaluated(replace(usual, unit=unit), MIDDLE_M)
    strokes = []
    for followed in (0, 2):
        before = fitter.model.strokes
        assert fitter.improved(begun, MIDDLE_M, 4, followed=followed).cost < 0.7 * begun.cost
        strokes.append(fitter.model.strokes - before)
    assert strokes[1] < 0.8 * strokes[0]
    assert fitter.improved(begun, MIDDLE_M, 20, followed=2).cost < 0.05 * begun.cost


@pytest.fixture(scope="module")
def good(fitter: Fitter, usual: Fit) -> Fit:
    """A truck fitted to them, in which no shift is stuck."""
    rng = np.random.default_rng(3)
    fit = fitter.improved(fitter.rescanned(usual, COARSE_M, rng), COARSE_M, 4)
    fit = fitter.improved(replace(fit, noise_factor=FIRST_FACTOR), FINE_M, 8)
    assert fit.per_shift is not None and fit.per_shift.max() < 5.0
    return fit


@pytest.fixture(scope="module")
def stuck(fitter: Fitter, good: Fit) -> tuple[Fit, int]:
    """The same with impossible loads in one shift, and which."""
    loads = np.flatnonzero(fitter.layout.is_load)
    into_gear = int(np.flatnonzero(fitter.mask[:, loads[1]])[0])
    each = good.each.copy()
    each[into_gear, loads] = -4.0 * fitter.mask[into_gear, loads]
    fit = fitter.evaluated(replace(good, each=each), FINE_M)
    assert fit.per_shift is not None and fit.per_shift[into_gear] > 10.0
    return fit, into_gear


def test_a_shift_stuck_in_a_minimum_of_its_own_begins_anew(
    fitter: Fitter, stuck: tuple[Fit, int]
) -> None:
    fit, into_gear = stuck
    freed = fitter.freed(fit, np.random.default_rng(3))
    assert freed.per_shift is not None
    assert freed.cost < fit.cost - 5.0 and freed.per_shift[into_gear] < 5.0


def test_a_stuck_shift_tries_the_loads_of_the_likeliest_truck(
    fitter: Fitter, good: Fit, stuck: tuple[Fit, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    fit, into_gear = stuck

    def where_it_was(self: Fitter, there: Fit, rng: object) -> Fit:
        return replace(there, each=np.tile(fit.each[into_gear], (len(self.model), 1)))

    monkeypatch.setattr(Fitter, "drawn", where_it_was)
    # nor does it move from there
    monkeypatch.setattr(truck_fit, "STEPS", replace(STEPS, settling=0))
    known = copy.copy(fitter)
    costs = []
    for known.likeliest in (None, good):
        freed = known.freed(fit, np.random.default_rng(3))
        assert freed.per_shift is not None
        costs.append(freed.per_shift[into_gear])
    assert costs[0] > 10.0 and costs[1] < 5.0


def test_a_stuck_shift_tries_the_quantities_of_others(
    fitter: Fitter, stuck: tuple[Fit, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    fit, into_gear = stuck
    monkeypatch.setattr(truck_fit, "STEPS", replace(STEPS, of_others=1.0, passing=0.0))
    scanned = fitter.rescanned(fit, FINE_M, np.random.default_rng(3))
    assert fit.per_shift is not None and scanned.per_shift is not None
    assert scanned.per_shift[into_gear] < 0.5 * fit.per_shift[into_gear]
    others = np.delete(fit.each, into_gear, axis=0) * fitter.mask[into_gear]
    assert (scanned.each[into_gear] == others).all(axis=1).any()


def test_what_no_shift_is_stuck_in_is_left_as_it_is(fitter: Fitter, usual: Fit) -> None:
    fit = fitter.evaluated(replace(usual, noise_factor=1e3), FINE_M)
    assert fitter.freed(fit, np.random.default_rng(1)).each is fit.each


def test_a_shift_alone_in_its_trip_begins_anew_at_any_supply(
    shifts: list[RecordedShift], good: Fit
) -> None:
    trips = [replace(shift, source="other" if k == 1 else "one") for k, shift in enumerate(shifts)]
    of_two = Fitter(ShiftModel(trips, load("nominal")), rest_noise_m(trips))
    supply = int(np.flatnonzero(of_two.layout.differing == of_two.layout.at["supply"])[0])
    fit = replace(good, unit=np.append(good.unit, np.zeros(2)))
    alone, among = (of_two._free_spread(fit, np.array([k]))[supply] for k in (1, 2))
    assert among == PRIORS.spreads[1]
    sd = of_two.layout.unit_sd[of_two.layout.at["supply_1"]]
    assert alone * of_two.layout.shift_sd[supply] == pytest.approx(sd)
    fit.unit[of_two.layout.at["supply_1"]] = 3.0  # 30 % too much
    fit = of_two.evaluated(fit, MIDDLE_M)
    each = of_two.begun_anew(fit, MIDDLE_M, np.random.default_rng(3))
    assert each is not None and fit.per_shift is not None
    after = of_two.evaluated(replace(fit, each=each), MIDDLE_M)
    assert after.per_shift is not None
    assert after.per_shift[1] < 0.2 * fit.per_shift[1] and each[1, supply] < -3.5
    assert (np.delete(each, 1, axis=0) == np.delete(fit.each, 1, axis=0)).all()


def test_how_much_a_load_differs_is_no_evidence_where_it_does_not_act(
    shifts: list[RecordedShift],
) -> None:
    bare = Fitter(ShiftModel(shifts, load("nominal"), mounted=False), rest_noise_m(shifts))
    acts = bare.mask.any(axis=0)
    fit = bare.start()
    narrow = replace(fit, spread=np.where(acts, 1.0, 0.02))
    assert not acts.all()
    evidence = [bare.with_evidence(each).evidence for each in (fit, narrow)]
    assert evidence[1] == pytest.approx(evidence[0], abs=1e-6)


def test_what_shifts_have_in_common_is_the_trucks(fitter: Fitter, usual: Fit) -> None:
    fit = fitter.evaluated(replace(usual, each=usual.each - 1.5 * fitter.mask), COARSE_M)
    centred = fitter.centred(fit)
    again = fitter.evaluated(centred, COARSE_M)
    assert again.cost == pytest.approx(centred.cost) and centred.cost < fit.cost - 5.0
    assert again.position_m == pytest.approx(fit.position_m, abs=1e-12)
    assert np.abs(centred.each).max() < 0.8 < np.abs(centred.unit).max()
    kept = fitter.centred(fit, kept=fitter.layout.differing)
    assert (kept.unit == fit.unit).all() and (kept.each == fit.each).all()


def test_a_trial_may_keep_the_loads_of_gears(fitter: Fitter, usual: Fit) -> None:
    trial = replace(usual, unit=usual.unit + 0.7, each=usual.each + 0.4 * fitter.mask)
    kept = fitter.with_loads_of(usual, trial)
    loads = fitter.layout.differing[fitter.layout.of_gears]
    moved = fitter.layout.amounts(kept.unit, kept.each) - fitter.layout.amounts(
        usual.unit, usual.each
    )
    acting = fitter.model.acts
    assert np.abs(moved[:, loads][acting[:, loads]]).max() < 1e-9
    assert np.abs(moved[:, fitter.layout.at["friction"]]).min() > 0.0
    variance, size = fitter.variance(COARSE_M), np.array([usual.size])
    both = [fitter._tried(usual, t.unit[None], t.each[None], size, variance) for t in (trial, kept)]
    joined = both[0].joined(both[1]).best(usual)
    assert joined.cost <= min(trials.cost[0] for trials in both)
    assert joined.cost == pytest.approx(fitter.evaluated(joined, COARSE_M).cost)


def test_a_cone_has_its_slope_where_it_stops_the_stay(fitter: Fitter, usual: Fit) -> None:
    cone, passing = fitter._passing(usual)
    into_gear = int(np.flatnonzero(fitter.mask[:, cone])[0])
    each = usual.each.copy()
    each[into_gear, cone] = passing[into_gear]
    through = fitter.evaluated(replace(usual, each=each), COARSE_M)
    each = each.copy()
    each[into_gear, cone] -= 1.0
    assert fitter.evaluated(replace(usual, each=each), COARSE_M).cost > through.cost
    weaker = fitter.evaluated(replace(usual, each=each), COARSE_M)
    assert weaker.position_m == pytest.approx(through.position_m)
    each = each.copy()
    each[into_gear, cone] = passing[into_gear] + 0.1
    stopped = fitter.evaluated(replace(usual, each=each), COARSE_M)
    assert np.abs(stopped.position_m - through.position_m)[into_gear].max() > 1e-4
    slopes = fitter.derivatives(through, 0.1, (-1.0,))[into_gear, :, fitter.layout.at["cone"]]
    assert np.abs(slopes).max() > 1e-4


def test_a_fit_ends_where_its_cost_is_low_enough(fitter: Fitter, usual: Fit) -> None:
    shifted = fitter.evaluated(replace(usual, unit=usual.unit + 0.5), COARSE_M)
    shifted = fitter.centred(shifted)
    enough = shifted.cost + 1e-6
    assert fitter.improved(shifted, COARSE_M, 4, enough=enough).cost == pytest.approx(shifted.cost)
    better = fitter.improved(shifted, COARSE_M, 4)
    assert better.cost <= fitter.improved(shifted, COARSE_M, 4, enough=better.cost + 1.0).cost


def test_the_scale_of_the_noise_is_the_likeliest(fitter: Fitter) -> None:
    sd = np.sqrt(fitter.variance(FINE_M))
    off = 5.0 * sd * np.random.default_rng(2).standard_t(4.0, sd.shape)
    # beyond the rounding of the timer
    off += 0.5 * fitter.model.tick_m * np.sign(off)
    assert fitter.factor_of(fitter.position_m + off) == pytest.approx(5.0, rel=0.15)
    assert fitter.factor_of(fitter.position_m) == 1.0


def test_a_shift_that_cannot_be_simulated_costs_much(fitter: Fitter, usual: Fit) -> None:
    x = usual.position_m
    which = np.arange(len(fitter.model))
    costs = fitter._misfit(x, which > 0, which, fitter.variance(FINE_M))
    assert costs[0] == 1e6 and (costs[1:] < 1e5).all()


@pytest.fixture(scope="module")
def late(fitter: Fitter) -> Fit:
    """A coil 20 K warm, fitted to a healthy truck's shifts."""
    rng = np.random.default_rng(1)
    fit = fitter.rescanned(fitter.start(only("sensor_temperature"), 0.5), COARSE_M, rng)
    fit = fitter.improved(fit, COARSE_M, 6)
    fit = replace(
        fitter.improved(fitter.rescanned(fit, 1e-4, rng), 1e-4, 8), noise_factor=FIRST_FACTOR
    )
    return fitter.finished(fitter.improved(fit, FINE_M, 8), rng)


@pytest.mark.slow
def test_a_cause_that_is_not_there_has_no_size(fitter: Fitter, late: Fit) -> None:
    assert late.noise_factor < 1.5
    low, high = fitter.profile(late)
    assert low <= late.size <= high
    assert low <= 0.0 <= high or abs(late.size) < 3.0 * late.size_sd
    # a normal posterior rises by 2 at two standard deviations
    assert high - low == pytest.approx(4.0 * late.size_sd, rel=0.6)

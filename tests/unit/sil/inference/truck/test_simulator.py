"""Recorded shifts simulated: delays shift the motion, what a shift lacks changes nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from plant.parameters import load
from sil.inference.truck.fit import Fitter
from sil.inference.truck.quantities import Layout, quantities
from sil.inference.truck.simulator import ShiftModel
from sil.log_replay.recorded_shifts import RecordedShift
from tests.unit.sil.inference.truck.test_causes import only


def positions(model: ShiftModel, **amounts: float) -> np.ndarray:
    every = np.arange(len(model))
    there = np.zeros((len(model), len(model.layout)))
    for name, by in amounts.items():
        there[:, model.layout.at[name]] = by
    x, done = model.positions(every, there)
    assert done.all()
    return np.where(model.recorded, x, 0.0)


def test_the_usual_truck_moves_as_recorded(fitter: Fitter) -> None:
    model = fitter.model
    off = positions(model)[model.recorded] - model.position_m[model.recorded]
    assert np.sqrt(np.mean(off**2)) < 1.5e-3  # the nominal one, barriers and impulses guessed


def test_a_later_valve_is_a_later_motion(fitter: Fitter) -> None:
    # far more than the step within which the moves of the valves are kept
    rise, latency = positions(fitter.model, rise=0.0023), positions(fitter.model, latency=0.0023)
    usual = positions(fitter.model)
    first = np.argmax(np.abs(usual - usual[:, :1]) > 1e-4, axis=1)
    rows = np.arange(len(usual))
    assert (np.abs(rise - usual)[rows, first] > 1e-5).all()
    assert rise[rows, first] == pytest.approx(latency[rows, first], abs=1e-4)


def test_the_moves_of_valves_are_exact_between_steps(fitter: Fitter) -> None:
    near = positions(fitter.model, rise=0.00049)
    beyond = positions(fitter.model, rise=0.00051)
    assert np.max(np.abs(near - beyond)) < 2e-4  # 20 us at 1 m/s, and a kink


def test_a_truck_in_proportion_moves_nearly_as_before(fitter: Fitter) -> None:
    model, layout = fitter.model, fitter.model.layout
    unit = layout.in_proportion(np.zeros(len(layout)), 1.05)
    there = {item.name: unit[k] * item.unit_sd for k, item in enumerate(layout.own) if unit[k]}
    assert set(there) == {"supply", "mass", "linkage", "cone", "mesh", "pull"}
    usual, alone = positions(model), positions(model, supply=there["supply"])
    moved = np.abs(positions(model, **there) - usual)[model.recorded]
    assert np.sqrt(np.mean(moved**2)) < 0.5 * np.sqrt(np.mean((alone - usual)[model.recorded] ** 2))


def test_barriers_act_on_their_shifts_alone(fitter: Fitter) -> None:
    changed = np.abs(positions(fitter.model, mesh=300.0) - positions(fitter.model)).max(axis=1)
    into = np.array([shift.end in "BF" for shift in fitter.model.shifts])
    assert (changed[into] > 1e-4).all() and (changed[~into] == 0.0).all()


def test_a_stay_that_rebounds_meets_the_barrier_out_of_gear_on_its_way_in(fitter: Fitter) -> None:
    model = fitter.model
    into = np.flatnonzero([shift.end in "BF" for shift in model.shifts])
    amounts = np.zeros((2, len(into), len(model.layout)))
    amounts[1, :, model.layout.at["pull"]] = 300.0
    rows = np.tile(into, 2)

    def apart(size: float) -> np.ndarray:
        cause = only("end_stop_bounce")
        x, _ = model.positions(rows, amounts.reshape(len(rows), -1), cause, size)
        return np.abs(x[: len(into)] - x[len(into) :]).max(axis=1)

    assert apart(0.0).max() == 0.0 and apart(2.4).min() > 5e-6


def test_a_chamber_vented_slowly_still_pushes_in_the_next_shift(
    shifts: list[RecordedShift],
) -> None:
    later = next(shift for shift in shifts if max(shift.off_s) > -np.inf)
    model = ShiftModel([later, replace(later, off_s=(-np.inf,) * 3)], load("nominal"))
    rows, usual = np.arange(2), np.zeros((2, len(model.layout)))
    x, done = model.positions(rows, usual)
    clogged, _ = model.positions(rows, usual, only("exhaust_clog"), -7.6)
    assert done.all() and x[0] == pytest.approx(x[1], abs=1e-7)
    assert np.abs(clogged[0] - clogged[1]).max() > 1e-3


def test_a_delay_by_the_supply_is_that_of_each_shifts(shifts: list[RecordedShift]) -> None:
    pair = [replace(shifts[0], supply_pa=by) for by in (9e5, 7e5)]
    model = ShiftModel(pair, load("nominal"))
    rows, usual = np.arange(2), np.zeros((2, len(model.layout)))
    cause = only("valve_delay_pressure")
    x, _ = model.positions(rows, usual, cause, -1.0)
    alone, _ = model.positions(rows, usual)
    assert x[0] == pytest.approx(alone[0], abs=1e-7)
    usual[:, model.layout.at["rise"]] = cause.value(-1.0) * -2e5
    late, _ = model.positions(rows, usual)
    assert x[1] == pytest.approx(late[1], abs=1e-7)  # delays are whole nanoseconds
    assert np.abs(x[1] - alone[1]).max() > 1e-4


def test_at_equal_speeds_a_cone_usually_stops_nothing(shifts: list[RecordedShift]) -> None:
    into = next(shift for shift in shifts if shift.end in "BF")
    pair = [replace(into, difference_rad_s=by) for by in (0.2, 8.0)]
    model = ShiftModel(pair, load("nominal"))
    assert model.passing[0] > 0.0 > model.passing[1]


def test_offset_and_gain_act_on_the_report(fitter: Fitter) -> None:
    usual = positions(fitter.model)
    shown = positions(fitter.model, offset=1e-4, gain=0.01)
    recorded = fitter.model.recorded
    assert shown[recorded] == pytest.approx(1.01 * usual[recorded] + 1e-4)


def test_a_cause_of_no_size_is_a_healthy_actuator(fitter: Fitter) -> None:
    every = np.arange(len(fitter.model))
    amounts = np.zeros((len(every), len(fitter.layout)))
    sizes = np.where(every == 0, 2.0, 0.0)
    x, _ = fitter.model.positions(every, amounts, only("external_force"), sizes)
    healthy, _ = fitter.model.positions(every, amounts)
    # strokes of one call share steps: equal within the integrator's tolerance
    assert x[1:] == pytest.approx(healthy[1:], abs=1e-6)
    assert np.max(np.abs(x[0] - healthy[0])) > 1e-4


def test_a_line_too_wide_to_be_seen_is_none(fitter: Fitter) -> None:
    which, line = np.arange(len(fitter.model)), only("hose_droop")
    usual = fitter.layout.amounts(fitter.start().unit, fitter.start().each)
    healthy, wide, narrower = (
        fitter.model.positions(which, usual, line, size)[0] for size in (0.0, 0.29, 0.31)
    )
    assert np.array_equal(wide, healthy)
    assert 0.0 < np.abs(narrower - healthy).max() < 25e-6  # noise of a pulse as it moves: 70 um


def test_without_a_gearbox_its_quantities_do_not_act(shifts: list[RecordedShift]) -> None:
    model = ShiftModel(shifts, load("nominal"), mounted=False)
    usual = positions(model)
    assert np.array_equal(positions(model, mesh=200.0, mass=0.3, linkage=0.5, cone=1.0), usual)


def test_a_known_supply_has_a_narrower_prior() -> None:
    known, unknown = (Layout(quantities(load("nominal"), is_known)) for is_known in (True, False))
    column = known.at["supply"]
    assert known.unit_sd[column] < unknown.unit_sd[column]
    amounts = known.amounts(np.ones(len(known)), np.ones((2, len(known.differing))))
    assert amounts[0, column] == pytest.approx(known.unit_sd[column] + 0.02)

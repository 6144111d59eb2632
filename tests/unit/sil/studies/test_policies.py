"""Policies are simulated as the plant does it, and use no more than what they may know."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest

from plant.devices.valve import ValveTiming, switch_schedule
from plant.effects.stroke_conditions import FULL_DUTY
from plant.parameters import load as load_parameters
from plant.systems.stroke import simulate
from sil.studies.bound_search import Search
from sil.studies.policies import (
    FAMILIES,
    GEARBOX,
    LABORATORY,
    NOT_ARRIVED,
    Family,
    FamilyModel,
    Layout,
)
from sil.studies.pulses import changes, plunger_moves

PARAMETERS = load_parameters("nominal")
LAYOUT = Layout("BNF", 2, 1)
NO_PULSES = np.array([[[0.0, -1.0, 0.0, -1.0]] * 3])


def test_a_policy_is_the_stroke_that_the_plant_makes() -> None:
    stem = NO_PULSES.copy()
    stem[0, 0, :2], stem[0, 1, :2] = (9.0, 1.0), (8.0, 3.0)  # B off 90 to 100 ms, N on 80 to 110
    found = FamilyModel(PARAMETERS, GEARBOX, 0.0, 0.1).fly(stem, None, LAYOUT)
    commands = (
        (0.0, "B", FULL_DUTY),
        (0.08, "N", FULL_DUTY),
        (0.09, "B", 0.0),
        (0.1, "B", FULL_DUTY),
        (0.11, "N", 0.0),
    )
    stroke = simulate(
        PARAMETERS,
        replace(GEARBOX.cases[2], commands=commands),
        np.array([0.0, 0.3]),
        internal=False,
    )
    assert stroke.impact is not None
    revealed = next(event.time_s for event in stroke.events if event.name == "unblock")
    assert found.impact_stay_m_s[0, 0, 2] == pytest.approx(stroke.impact.speed_m_s, rel=1e-3)
    assert found.arrival_s[0, 0, 2] == pytest.approx(stroke.impact.time_s, abs=2e-6)
    assert found.revealed_s[0, 0, 2] == pytest.approx(revealed, abs=2e-6)


def test_a_late_arrival_costs_more_than_any_impact() -> None:
    stem = NO_PULSES.copy()
    stem[0, 0, :2] = 0.0, 4.5  # B comes 45 ms late
    found = FamilyModel(PARAMETERS, LABORATORY, 0.0, 0.03).fly(stem, None, LAYOUT)
    assert (found.cost_m_s > NOT_ARRIVED).all() and np.isinf(found.impact_stay_m_s).all()


def test_plungers_move_as_the_valve_does() -> None:
    rng = np.random.default_rng(1)
    timing = ValveTiming.from_parameters(PARAMETERS)
    given = np.sort(rng.uniform(0.0, 0.2, (50, 8)), axis=1)
    given[::3, 5:] = np.inf
    time_s, position = plunger_moves(given, 0.008, 0.035)
    for row, times, positions in zip(given, time_s, position, strict=True):
        commands = [(t, 0, FULL_DUTY * (k % 2 == 0)) for k, t in enumerate(row[np.isfinite(row)])]
        expected = switch_schedule(commands, timing, 1)
        assert [u for _, _, u in expected] == list(positions[np.isfinite(times)])
        found_ns = np.round(1e9 * times[np.isfinite(times)])
        assert np.abs(found_ns - [at_ns for at_ns, _, _ in expected]).max(initial=0.0) <= 1.0


def test_the_union_of_pulses_begins_and_ends_in_turn() -> None:
    begin = np.array([[0.1, 0.05, 0.3, 0.5, 0.4], [1.0, 1.0, 1.0, 1.0, 1.0]])
    end = np.array([[0.2, 0.1, 0.35, 0.4, 0.45], [0.0, 0.0, 0.0, 0.0, 0.0]])
    found = changes(begin, end)
    assert list(found[0][np.isfinite(found[0])]) == [0.05, 0.2, 0.3, 0.35, 0.4, 0.45]
    assert np.isinf(found[1]).all()


@pytest.mark.parametrize("family", FAMILIES.values(), ids=list(FAMILIES))
def test_before_it_is_revealed_a_load_moves_like_the_others(family: Family) -> None:
    plain = FamilyModel(PARAMETERS, family, 0.0, 0.0).plain
    revealed_s = list(plain.revealed_s[0, 0])
    assert revealed_s == sorted(revealed_s, reverse=family is LABORATORY)
    times = np.linspace(0.0, min(revealed_s) - 1e-4, 50)
    positions_m = [
        simulate(PARAMETERS, case, times, internal=False).position_m for case in family.cases
    ]
    assert max(np.abs(each - positions_m[0]).max() for each in positions_m) < 1e-6


@pytest.mark.parametrize("delay_s", [0.0, 0.012])
def test_a_load_that_is_not_revealed_yet_does_not_act_on_the_commands(delay_s: float) -> None:
    """Until two loads' branches begin their plungers move alike, coils switched early included."""
    model = FamilyModel(PARAMETERS, GEARBOX, delay_s, 0.03)
    search = Search(model, "BNF", 2, 1, 3)
    layout, (stems, _revealed_s) = search.layout, search.stems(search.random_segments(6))
    branches = np.stack([search.random_branches(6, 6) for _ in search.order], axis=2)
    found = model.fly(stems, branches, layout)
    begin_s = np.minimum(found.revealed_s, model.limit_s) + delay_s
    coils = model.changes(layout, *model.spans(layout, stems, branches, begin_s))
    for valve, coil in enumerate(coils):
        start = np.zeros((len(coil), 1 if valve == 0 else 0))
        times, positions = plunger_moves(np.hstack([start, coil]), *model.valve_s)
        times = times.reshape(*begin_s.shape, -1)
        positions = positions.reshape(times.shape)
        for n, t in np.ndindex(begin_s.shape[:2]):
            for a, b in itertools.pairwise(range(model.loads)):
                if found.cost_m_s[n, t, [a, b]].max() >= 2.0 * NOT_ARRIVED:
                    continue  # coils switched early met the stem's: such policies are refused
                until_s = begin_s[n, t, [a, b]].min() - 1e-9
                moves = [
                    [(round(1e9 * s), u) for s, u in zip(times[n, t, k], positions[n, t, k], strict=True)
                     if s <= until_s]
                    for k in (a, b)
                ]  # fmt: skip
                assert moves[0] == moves[1]


def test_a_blow_of_a_piston_counts_though_the_stay_stops_softly() -> None:
    model = FamilyModel(PARAMETERS, LABORATORY, 0.0, 0.03)
    search = Search(model, "BNF", 4, 0, 4)
    stems, _revealed_s = search.stems(search.random_segments(100))
    found = model.fly(stems, None, search.layout)
    arrived = np.isfinite(found.impact_worst_m_s)
    hidden = arrived & (found.impact_worst_m_s > found.impact_stay_m_s + 0.1)
    assert hidden.any()
    worst_m_s = np.maximum(found.impact_worst_m_s, found.impact_stay_m_s)
    assert np.array_equal(found.cost_m_s[arrived], worst_m_s[arrived])

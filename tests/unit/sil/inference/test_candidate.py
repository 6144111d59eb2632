"""The catalogue as candidates: complete, neutral at rest, signs."""

from __future__ import annotations

import pickle
from dataclasses import replace
from math import log

import numpy as np
import pytest

from can_dbc.errors import InputError
from plant.batch.prediction import Predictor
from plant.effects import CATALOGUE
from plant.effects.term import FORMS, TermForm, term
from plant.errors import IntegrationError
from plant.kernel.layout import LengthState, Parameters
from plant.parameters import load
from plant.systems.setup import make_setup
from plant.systems.stroke import run_setup
from sil.inference.candidate import candidates, compatible, term_candidate
from tests.support.made_campaign import conditions_of

INERT = (Parameters.bump_x, Parameters.bump_width, Parameters.detent_width, Parameters.alpha_v0)
ALL = candidates(("damper", "internal position", "length stroke", "process exponents"))


def test_every_named_cause_stands_in_the_search() -> None:
    assert {item.id for item in ALL} == set(CATALOGUE) - {"unnamed"}
    assert len({item.name for item in ALL}) == len(ALL)


@pytest.mark.parametrize("item", ALL, ids=lambda item: item.name)
def test_neutral_changes_nothing_and_starts_are_within_bounds(item) -> None:
    if item.id != "hose_droop":
        setup = make_setup(load(), conditions_of("N-B", 900000.0))
        changed = setup.copy()
        item.change(changed, {p.name: p.neutral for p in item.parameters})
        acting = [k for k in range(Parameters.size) if k not in INERT]
        assert np.array_equal(changed.p.array[acting], setup.p.array[acting])
    for start in item.starts:
        assert len(start) == len(item.parameters)
        for value, parameter in zip(start, item.parameters, strict=True):
            assert parameter.low <= value <= parameter.high
        assert item.physical(dict(zip([p.name for p in item.parameters], start, strict=True)))


def test_a_value_at_which_the_plant_does_not_exist_is_one_that_a_fit_leaves_out() -> None:
    delay = next(item for item in ALL if item.id == "sensor_delay")
    setup = make_setup(load(), conditions_of("N-B", 900000.0))
    with pytest.raises(IntegrationError, match=r"latency: -0\.0159; expected"):
        delay.change(setup, {"delay_s": -0.02})


def test_candidates_travel_by_name_and_variants_exclude_each_other() -> None:
    assert pickle.loads(pickle.dumps(ALL[0])) == ALL[0]
    variants = [item for item in ALL if item.id == "residual_pressure"]
    assert len(variants) > 1 and not compatible(variants[1], (variants[0],))
    assert compatible(variants[1], (ALL[0],))


def test_fewer_channels_mean_fewer_candidates() -> None:
    few = {item.id for item in candidates(())}
    assert not few & {"oil_aeration", "sensor_gain", "clock_skew", "free_play"}


def test_a_clock_may_be_off_without_drifting_at_half_the_prior() -> None:
    """As simple as the sensor's delay that looks the same: neither is preferred for its form."""
    clock = [item for item in candidates(("internal position",)) if item.id == "clock_skew"]
    assert [len(item.parameters) for item in clock] == [2, 1]
    assert sum(item.prior for item in clock) == 1.0


SAMPLES = (np.arange(1, 400) * 500_000).astype(np.int64)


def form_named(name: str) -> TermForm:
    return next(form for form in FORMS if form.name == name)


def states(change, kind: str = "N-B") -> np.ndarray:
    setup = make_setup(load(), conditions_of(kind, 900000.0))
    change(setup)
    return Predictor(SAMPLES, 1e-9).states(setup)


@pytest.mark.parametrize("form", FORMS, ids=lambda form: form.name)
@pytest.mark.parametrize("kind", ["fixed", "B-N"])
def test_zero_nodes_change_nothing(form, kind: str) -> None:
    candidate = term_candidate(form)
    zero = {p.name: 0.0 for p in candidate.parameters}
    same = states(lambda setup: candidate.change(setup, zero), kind)
    assert np.allclose(same, states(lambda setup: None, kind), rtol=1e-6, atol=5e-8)


@pytest.mark.parametrize(
    ("name", "level", "effect", "values"),
    [
        ("charge flow of pressure", -0.2, "inlet_clog", {"factor": 0.8}),
        ("discharge flow of pressure", -0.3, "exhaust_clog", {"factor": 0.7}),
        ("force of position", 60.0, "external_force", {"force_n": 60.0}),
        ("force of time", 60.0, "external_force", {"force_n": 60.0}),
        ("charge flow of valve", log(0.8), "inlet_clog", {"factor": 0.8}),
        ("supply of progress", log(0.9), "supply_low", {"deficit": 0.1}),
        ("opening delay of rest", 0.004, "valve_open_delay", {"delay_s": 0.004}),
        ("opening delay of progress", 0.004, "valve_open_delay", {"delay_s": 0.004}),
        ("opening delay of valve", 0.004, "valve_open_delay", {"delay_s": 0.004}),
    ],
)
@pytest.mark.parametrize("kind", ["fixed", "N-B"])
def test_constant_nodes_are_a_named_effect(name, level, effect, values, kind) -> None:
    candidate = term_candidate(form_named(name))
    nodes = {p.name: level for p in candidate.parameters}
    found = states(lambda setup: candidate.change(setup, nodes), kind)
    named = states(lambda setup: CATALOGUE[effect].apply(setup, values), kind)
    nominal = states(lambda setup: None, kind)
    assert np.allclose(found, named, rtol=1e-5, atol=1e-8)
    assert not np.allclose(found, nominal, rtol=1e-3, atol=1e-6)


@pytest.mark.parametrize(
    ("name", "same", "other"),
    [
        ("opening delay of rest", {"rest_s": 30.0}, {"rest_s": 600.0}),
        ("opening delay of progress", {"progress": 0.0}, {"progress": 1.0}),
        ("opening delay of valve", {}, {"kind": "F-N"}),
    ],
)
def test_a_level_holds_for_the_strokes_it_is_of(name: str, same: dict, other: dict) -> None:
    candidate = term_candidate(form_named(name))
    names = [p.name for p in candidate.parameters]
    reached = []
    for changed in (same, other):
        conditions = replace(conditions_of(changed.get("kind", "N-B"), 900000.0), rest_s=30.0)
        plain = {k: v for k, v in changed.items() if k != "kind"}
        setup = make_setup(load(), replace(conditions, **plain))
        before = setup.timing.rise_ns
        # rises towards long rests, the campaign's end, the valve F
        candidate.change(setup, {n: 1e-3 * k for k, n in enumerate(names)})
        reached.append(setup.timing.rise_ns - before)
    assert 0 <= reached[0] < reached[1]


def test_errors_of_sensors_are_added_to_what_they_measure() -> None:
    for name, level in (("internal position", 3e-4), ("gauge of pressure", 4e3)):
        candidate = term_candidate(form_named(name))
        setup = make_setup(load(), conditions_of("N-B", 900000.0))
        time_s = np.arange(1500) * 1e-4
        plain = run_setup(setup, time_s)
        candidate.change(setup, {p.name: level for p in candidate.parameters})
        wrong = run_setup(setup, time_s)
        more_m = wrong.internal_m - plain.internal_m
        more_pa = (
            wrong.states[:, LengthState.p_b : LengthState.p_f + 1]
            - plain.states[:, LengthState.p_b : LengthState.p_f + 1]
        )
        if name == "internal position":
            assert np.allclose(more_m, level, atol=1e-9) and not np.any(more_pa)
        else:
            assert np.allclose(more_pa, level, atol=1e-6) and not np.any(more_m)


@pytest.mark.parametrize("name", ["friction of rest", "friction of progress"])
def test_a_level_of_friction_is_more_of_all_friction(name: str) -> None:
    candidate = term_candidate(form_named(name))
    nodes = {p.name: log(2.0) for p in candidate.parameters}

    def doubled(setup) -> None:
        for effect in ("dynamic_friction", "static_friction"):
            CATALOGUE[effect].apply(setup, {"factor": 2.0})

    for kind in ("fixed", "F-N"):
        found = states(lambda setup: candidate.change(setup, nodes), kind)
        assert np.allclose(found, states(doubled, kind), rtol=1e-6, atol=5e-8)


def test_a_level_of_something_that_changes_during_a_stroke_is_refused() -> None:
    setup = make_setup(load(), conditions_of("N-B", 900000.0))
    values = {"equation": 10.0, "variable": 1.0, "low": 0.0, "step": 1.0, "nodes": (0.0, 1.0)}
    with pytest.raises(InputError, match="one level a stroke"):
        term.apply(setup, values)


@pytest.mark.parametrize("name", ["friction of position", "friction of speed"])
def test_constant_resistance_is_coulomb_friction(name: str) -> None:
    candidate = term_candidate(form_named(name))
    nodes = {p.name: 40.0 for p in candidate.parameters}

    def more(setup) -> None:
        setup.p.f_linkage += 40.0

    for kind in ("fixed", "F-N"):
        found = states(lambda setup: candidate.change(setup, nodes), kind)
        assert np.allclose(found, states(more, kind), rtol=1e-6, atol=5e-8)

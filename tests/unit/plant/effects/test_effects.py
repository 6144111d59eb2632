"""Effects: the catalogue is complete and consistent, and no other module names an effect."""

from __future__ import annotations

import ast
from pathlib import Path

import numpy as np
import pytest

from can_dbc.errors import InputError
from plant.effects import CATALOGUE, effect, look_alikes
from plant.effects.stroke_conditions import StrokeConditions
from plant.effects.term import FORMS, LEVELLED, LEVELS, term
from plant.node import PlantConfig, PlantNode
from plant.parameters import Parameter, ParameterSet, load
from plant.systems.length_stroke import LengthStroke
from plant.systems.stroke import simulate

ROOT = Path(__file__).resolve().parents[4]
ELSEWHERE = {
    ("plant/batch/lane_steps.py", "alpha_speed"),  # a field of the parameters
}
ORDINARY = {"stribeck", "detent", "unnamed"}
"""Identifiers that are words: they are names of effects only where they are the whole string."""


def named_in(file: Path) -> set[str]:
    """Return the effects that the strings of a module name, docstrings left out."""
    tree = ast.parse(file.read_text(encoding="utf-8"))
    docs = {
        id(node.body[0].value)
        for node in ast.walk(tree)
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef)
        and node.body
        and isinstance(node.body[0], ast.Expr)
    }
    mentions = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in docs:
            words = set("".join(c if c.isalnum() or c == "_" else " " for c in node.value).split())
            mentions |= {name for name in CATALOGUE if name == node.value}
            mentions |= (words & set(CATALOGUE)) - ORDINARY
    return mentions


def test_no_module_outside_the_effects_names_one() -> None:
    mentions = set()
    for package in ("can_dbc", "controller", "plant", "sil"):
        for file in (ROOT / package).rglob("*.py"):
            path = file.relative_to(ROOT).as_posix()
            if not path.startswith("plant/effects/"):
                mentions |= {(path, name) for name in named_in(file)}
    assert mentions == ELSEWHERE


def test_the_search_for_names_finds_them() -> None:
    assert "exhaust_clog" in named_in(ROOT / "plant/effects/flow.py")


@pytest.mark.parametrize("item", CATALOGUE.values(), ids=lambda item: item.id)
def test_an_effect_is_stated_consistently(item) -> None:
    names = [p.name for p in item.parameters]
    assert len(set(names)) == len(names)
    for parameter in item.parameters:
        assert parameter.low <= parameter.neutral <= parameter.high and parameter.typical > 0.0
    fixable = {p.name for p in item.parameters if p.optional or not p.fitted}
    for variant in item.variants:
        assert set(variant.fixed) <= fixable
    assert len({variant.name for variant in item.variants}) == len(item.variants)
    for other in look_alikes(item.id):
        assert other != item.id and item.id in look_alikes(other)
    assert set(item.look_alikes) <= set(CATALOGUE)
    assert item.scope_of({p.name: p.neutral for p in item.parameters}) in (
        "unit",
        "run",
        "stroke",
        "instrument",
    )


def test_every_named_effect_but_a_few_has_look_alikes() -> None:
    alone = {name for name, item in CATALOGUE.items() if not look_alikes(name)}
    assert alone == {term.id}


def test_terms_of_levels_depend_on_what_has_a_level() -> None:
    for form in FORMS:
        assert (form.slot in LEVELLED) == (form.over in LEVELS), form.name


def test_an_unknown_effect_is_named_with_the_nearest() -> None:
    with pytest.raises(InputError, match=r"expected one of .*exhaust_clog"):
        effect("exhaust_clogged")


def extended(name: str, **values: tuple[float, str]) -> ParameterSet:
    base = load()
    table = {key: Parameter(value, unit, "test") for key, (value, unit) in values.items()}
    return ParameterSet(base.name, base.entries, {name: table})


def test_a_run_moves_as_the_stroke_of_the_same_model() -> None:
    model = extended("dynamic_friction", factor=(3.0, "-"))
    conditions = StrokeConditions("N-B", 900000.0, ((0.002, "B", 0.98),))
    time_s = np.arange(1, 601) * 1e-4
    stroke = simulate(model, conditions, np.concatenate([[0.0], time_s]), internal=False)
    run = LengthStroke(model, supply_pressure_pa=900000.0)
    states = run.advance(60_000_000, [(10_000_000, 0, 1.0)], np.rint(time_s * 1e9).astype(np.int64))
    assert states[:, 0] == pytest.approx(stroke.position_m[1:], abs=1e-7)
    plain = LengthStroke(load(), supply_pressure_pa=900000.0)
    free = plain.advance(60_000_000, [(10_000_000, 0, 1.0)], np.rint(time_s * 1e9).astype(np.int64))
    assert np.max(free[:, 0] - states[:, 0]) > 1e-3


def test_valve_delays_reach_the_valves() -> None:
    model = extended("valve_open_delay", delay_s=(0.004, "s"))
    node = PlantNode(PlantConfig(), model)
    plain = PlantNode(PlantConfig(), load())
    late, prompt = (each.valve_group.valves[0].timing for each in (node, plain))
    assert late.rise_ns == prompt.rise_ns + 4_000_000
    assert late.fall_ns == prompt.fall_ns


@pytest.mark.parametrize(
    ("name", "values", "reported"),
    [
        ("residual_pressure", {"pressure_pa": (3e3, "Pa")}, "single stroke"),
        ("dead_volume_charge", {"volume_m3": (5e-6, "m^3")}, "single stroke"),
        ("sensor_gain", {"gain": (0.02, "-")}, "instruments"),
        ("dynamic_friction", {"factor": (30.0, "-")}, "expected 0.2 to 10"),
    ],
)
def test_what_a_run_cannot_apply_is_refused(name, values, reported) -> None:
    with pytest.raises(InputError, match=reported):
        LengthStroke(extended(name, **values))


def test_volumes_of_named_chambers_are_applied() -> None:
    model = extended("dead_volume_passive", volume_m3=(5e-6, "m^3"), where=(1.0, "-"))

    assert LengthStroke(model).packed.vol_n == pytest.approx(
        LengthStroke(load()).packed.vol_n + 5e-6
    )

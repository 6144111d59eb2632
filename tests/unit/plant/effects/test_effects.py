"""Effects: the catalogue is complete and consistent, and no other module names an effect."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

from can_dbc.errors import InputError
from plant.effects import CATALOGUE, effect, look_alikes
from plant.effects.term import FORMS, LEVELLED, LEVELS, term

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

"""Candidate extensions of the model: what each changes, in which equation, within which bounds.

An effect changes a stroke's `Setup`; at its neutral parameters the stroke is the nominal one.
Identifiers and classes are those of the vocabulary of causes. Everything about an effect is in its
file here; no other module names one.
"""

from __future__ import annotations

import difflib
from collections.abc import Mapping

from plant.effects import damper, flow, friction, mechanics, sensors, term, thermal, valves
from plant.effects.effect import Effect, EffectParameter
from plant.effects.setup import Setup
from plant.errors import InputError
from plant.parameters import Parameter, ParameterSet

__all__ = ["CATALOGUE", "Effect", "EffectParameter", "apply_effects", "effect", "look_alikes"]

CATALOGUE: dict[str, Effect] = {
    item.id: item
    for module in (friction, flow, valves, thermal, damper, mechanics, sensors, term)
    for item in module.EFFECTS
}


def effect(name: str) -> Effect:
    """Return the effect of that id; raises InputError with the nearest names if there is none."""
    try:
        return CATALOGUE[name]
    except KeyError:
        near = difflib.get_close_matches(name, CATALOGUE, n=3, cutoff=0.3) or list(CATALOGUE)
        raise InputError(f"effect {name!r}: no such effect; nearest: {', '.join(near)}") from None


def look_alikes(name: str) -> tuple[str, ...]:
    """Return the effects that are hard to tell from this one, in the order of the catalogue."""
    item = effect(name)
    return tuple(
        other.id
        for other in CATALOGUE.values()
        if other.id in item.look_alikes or name in other.look_alikes
    )


def check_effects(effects: Mapping[str, Mapping[str, Parameter]], name: str) -> None:
    """Check the effects of an extended model.

    Raises InputError for unknown effects, parameters and units, and values outside the bounds.
    """
    for identifier, table in effects.items():
        try:
            item = effect(identifier)
        except InputError as error:
            raise InputError(f"{name}: {error}") from None
        item.check(table, f"{name}: [effect.{identifier}]")


def apply_effects(setup: Setup, parameters: ParameterSet) -> None:
    """Apply every effect of an extended model to a stroke's setup.

    Raises InputError as `check_effects` does.
    """
    check_effects(parameters.effects, parameters.name)
    for identifier, table in parameters.effects.items():
        effect(identifier).apply(setup, {key: item.value for key, item in table.items()})

"""Candidate extensions of the model, each stated in its file here alone: what changes, where, within which bounds.

An effect changes a stroke's `Setup`; at its neutral parameters the stroke is the nominal one.
"""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from can_dbc.errors import nearest
from plant.devices.sensors import InternalChain
from plant.devices.valve import ValveTiming
from plant.effects.effect import Effect, EffectParameter
from plant.effects.setup import Setup
from plant.effects.stroke_conditions import StrokeConditions
from plant.errors import InputError
from plant.kernel.layout import Parameters
from plant.kernel.packing import Floats
from plant.parameters import Parameter, ParameterSet, number

__all__ = [
    "CATALOGUE",
    "Effect",
    "EffectParameter",
    "apply_effects",
    "effect",
    "look_alikes",
    "overridden",
]

CATALOGUE: dict[str, Effect] = {
    item.id: item
    for module in sorted(info.name for info in pkgutil.iter_modules(__path__))
    for item in vars(importlib.import_module(f"{__name__}.{module}")).values()
    if isinstance(item, Effect)
}
"""All effects by id: those of every file in this folder, and of the users' files that were loaded."""


def effect(name: str) -> Effect:
    """Return the effect of that id; raises InputError with the nearest names if there is none."""
    try:
        return CATALOGUE[name]
    except KeyError:
        near = nearest(name, CATALOGUE, cutoff=0.3) or list(CATALOGUE)
        raise InputError(
            f"effect {name!r}: no such effect; expected one of {', '.join(near)}, ...; "
            "a file of your own effects is given with --effects"
        ) from None


def look_alikes(name: str) -> tuple[str, ...]:
    """Return the effects that are hard to distinguish from this one, in the order of the catalogue."""
    item = effect(name)
    return tuple(
        other.id
        for other in CATALOGUE.values()
        if other.id in item.look_alikes or name in other.look_alikes
    )


def check_effects(effects: Mapping[str, Mapping[str, Parameter]], name: str) -> None:
    """Check an extended model. Raises InputError for unknown effects, parameters, units, and values out of bounds."""
    for identifier, table in effects.items():
        try:
            item = effect(identifier)
        except InputError as error:
            raise InputError(f"{name}: {error}") from None
        item.check(table, f"{name}: [effect.{identifier}]")


def apply_effects(setup: Setup, parameters: ParameterSet) -> None:
    """Apply every effect of an extended model to a stroke's setup. Raises InputError as `check_effects` does."""
    check_effects(parameters.effects, parameters.name)
    for identifier, table in parameters.effects.items():
        effect(identifier).apply(setup, {key: item.value for key, item in table.items()})


def overridden(parameters: ParameterSet, changes: Mapping[str, Any]) -> ParameterSet:
    """Replace values of a set; effect.<id>.<parameter> adds an effect. Raises InputError for unknown paths, wrong values."""
    effects = {name: dict(table) for name, table in parameters.effects.items()}
    for path, value in changes.items():
        if not path.startswith("effect."):
            continue
        parts = path.split(".")
        if len(parts) != 3:
            raise InputError(f"{path}: expected effect.<id>.<parameter> = number")
        units = {item.name: item.unit for item in effect(parts[1]).parameters}
        effects.setdefault(parts[1], {})[parts[2]] = Parameter(
            number(value, path), units.get(parts[2], "-"), "set by the user"
        )
    numbers = {path: value for path, value in changes.items() if not path.startswith("effect.")}
    extended = replace(parameters.override(numbers), effects=effects)
    check_effects(effects, parameters.name)
    return extended


def apply_to_run(
    parameters: ParameterSet, p: Parameters, c: Floats, supply_pa: float, damped: bool
) -> Setup:
    """Return the packed parameters `p` of a run changed by the set's effects, as part of a setup.

    c: flow map [FlowMap.size], no unit.  Raises InputError for unknown effects, bad values, and effects that a run
    cannot apply.
    """
    check_effects(parameters.effects, parameters.name)
    given = {
        name: {key: item.value for key, item in table.items()}
        for name, table in parameters.effects.items()
    }
    for name, values in given.items():
        why = {
            "instrument": "of the instruments; on a run set the sensor's own values instead "
            "(opc4 simulate applies it)",
            "stroke": "belongs to a single stroke; a run cannot apply it (opc4 simulate can)",
        }.get(CATALOGUE[name].scope_of(values))
        if why:
            raise InputError(f"{parameters.name}: [effect.{name}]: {why}")
    conditions = StrokeConditions(
        kind="N-B", supply_pressure_pa=supply_pa, commands=(), load="damper" if damped else "none"
    )
    setup = Setup(
        conditions,
        p,
        c,
        ValveTiming.from_parameters(parameters),
        InternalChain.from_parameters(parameters),
    )
    for name, values in given.items():
        CATALOGUE[name].apply(setup, CATALOGUE[name].on_run(values))
    return setup

"""The setup of a stroke from a parameter set and the stroke's conditions."""

from __future__ import annotations

from plant.effects import apply_effects
from plant.effects.setup import Setup
from plant.effects.stroke_conditions import StrokeConditions
from plant.parameters import ParameterSet


def make_setup(parameters: ParameterSet, conditions: StrokeConditions) -> Setup:
    """Return the setup of a stroke, with the effects of an extended model applied."""
    setup = Setup.of(parameters, conditions)
    if parameters.effects:
        apply_effects(setup, parameters)
    return setup

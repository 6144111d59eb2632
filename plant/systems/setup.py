"""The setup of a stroke from a parameter set and the stroke's conditions."""

from __future__ import annotations

from plant.devices.sensors import InternalChain
from plant.devices.valve import ValveTiming
from plant.effects import apply_effects
from plant.effects.setup import Setup
from plant.effects.stroke_conditions import StrokeConditions
from plant.kernel.packing import flow_coefficients, pack
from plant.parameters import ParameterSet


def make_setup(parameters: ParameterSet, conditions: StrokeConditions) -> Setup:
    """Return the setup of a stroke, with the effects of an extended model applied."""
    timing = ValveTiming.from_parameters(parameters)
    setup = Setup(
        conditions=conditions,
        p=pack(
            parameters,
            conditions.system,
            supply_pressure_pa=conditions.supply_pressure_pa,
            atmosphere_pa=conditions.atmosphere_pa,
            load=conditions.loads(),
            theoretical_flow=conditions.theoretical_flow,
        ),
        c=flow_coefficients(parameters),
        timing=timing,
        chain=InternalChain.from_parameters(parameters),
    )
    if parameters.effects:
        apply_effects(setup, parameters)
    return setup

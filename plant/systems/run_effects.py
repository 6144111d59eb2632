"""An extended model on a run: its effects applied where no single stroke is meant.

Checked by: tests/unit/plant/systems/test_run_effects.py
"""

from __future__ import annotations

from plant.devices.sensors import InternalChain
from plant.devices.valve import ValveTiming
from plant.effects import CATALOGUE, check_effects
from plant.effects.setup import Setup
from plant.effects.stroke_conditions import StrokeConditions
from plant.errors import InputError
from plant.kernel.layout import Parameters
from plant.kernel.packing import Floats
from plant.parameters import ParameterSet


def applied(
    parameters: ParameterSet, p: Parameters, c: Floats, supply_pa: float, damped: bool
) -> Setup:
    """Return the packed parameters `p` of a run changed by the set's effects, as part of a setup.

    c: flow map [FlowMap.size], no unit.  Raises InputError for unknown effects, bad values, and effects that a run cannot apply.
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

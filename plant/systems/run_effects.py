"""An extended model on a run: its effects applied where no single stroke is meant.

Checked by: tests/unit/plant/systems/test_run_effects.py
"""

from __future__ import annotations

from plant.devices.sensors import InternalChain
from plant.devices.valve import ValveTiming
from plant.effects import CATALOGUE, check_effects
from plant.effects.setup import Setup
from plant.effects.stroke_conditions import StrokeConditions
from plant.effects.term import LEVELS, OF_SENSORS
from plant.errors import InputError
from plant.kernel.packing import Floats
from plant.parameters import ParameterSet

OF_INSTRUMENTS = {
    "sensor_temperature",
    "sensor_gain",
    "sensor_delay",
    "clock_skew",
    "gauge_line_lag",
}
OF_ONE_STROKE = {"residual_pressure", "valve_creep"}
DIRECTED = {"dead_volume_charge": "where", "dead_volume_passive": "where"}
"""Volumes on "the driving chamber": on a run only where they are given for chambers by name."""


def refuse(parameters: ParameterSet) -> None:
    """Refuse, in one line, effects that a run has no place for."""
    for identifier, table in parameters.effects.items():
        place = f"{parameters.name}: [effect.{identifier}]"
        given = {name: item.value for name, item in table.items()}
        if identifier in OF_INSTRUMENTS or given.get("equation") in OF_SENSORS:
            raise InputError(
                f"{place}: of the instruments; on a run set the sensor's own values instead "
                "(opc4 simulate applies it)"
            )
        directed = identifier in DIRECTED and given.get(DIRECTED[identifier], 0.0) != 1.0
        timed = identifier == "unnamed" and given.get("variable") in (0.0, *LEVELS)
        mirrored = identifier == "friction_bump" and given.get("mirrored", 0.0) == 1.0
        if identifier in OF_ONE_STROKE or directed or timed or mirrored:
            raise InputError(
                f"{place}: belongs to a single stroke; a run cannot apply it (opc4 simulate can)"
            )


def applied(
    parameters: ParameterSet, p: Floats, c: Floats, supply_pa: float, damped: bool
) -> Setup:
    """The packed parameters `p` of a run changed by the set's effects, as part of a setup.

    Raises InputError for unknown effects, bad values, and effects that a run has no place for.
    """
    check_effects(parameters.effects, parameters.name)
    refuse(parameters)
    conditions = StrokeConditions(
        kind="N-B",
        supply_pressure_pa=supply_pa,
        commands=(),
        load="damper" if damped else "none",
    )
    setup = Setup(
        conditions,
        p,
        c,
        ValveTiming.from_parameters(parameters),
        InternalChain.from_parameters(parameters),
    )
    for identifier, table in parameters.effects.items():
        values = {key: item.value for key, item in table.items()}
        if identifier == "leak_to_atmosphere" and values.get("where") == 1.0:
            values["where"] = 0.0  # on a run the chamber that drives is the one on supply
        CATALOGUE[identifier].apply(setup, values)
    return setup

"""An extended model on a run: the actuator changes, what a run cannot apply is refused."""

from __future__ import annotations

import numpy as np
import pytest

from can_dbc.errors import InputError
from plant.effects.stroke_conditions import StrokeConditions
from plant.node import PlantConfig, PlantNode
from plant.parameters import Parameter, ParameterSet, load
from plant.systems.length_stroke import LengthStroke
from plant.systems.stroke import simulate


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

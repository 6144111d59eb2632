"""A scenario written as a file loads as the same scenario."""

from __future__ import annotations

import tomllib

import msgspec
import pytest

from sil.simulation.expectations import Expectations
from sil.simulation.load_scenario import from_table, load, shipped
from sil.simulation.scenario import scenario_toml


@pytest.mark.parametrize("name", sorted(shipped()))
def test_every_shipped_scenario_survives(name: str) -> None:
    before = load(name)
    again = from_table(tomllib.loads(scenario_toml(before.scenario)), "text")
    without = msgspec.structs.replace(before.scenario, expect=Expectations())
    assert again.scenario == without
    values = [{path: p[path].value for path in p} for p in (again.parameters, before.parameters)]
    assert values[0] == values[1]


def test_settings_faults_and_strategy_parameters_survive() -> None:
    settings = {
        "valve.D_fall": 0.0123,
        "controller.strategy": "air_cushion",
        "controller.strategy_parameters.patience_s": 0.05,
        "controller.filter": False,
        "effect.added_mass.mass_kg": 0.25,
    }
    before = load("bus_off", settings=settings)
    text = scenario_toml(before.scenario)
    again = from_table(tomllib.loads(text), "text")
    assert again.scenario.model == {"valve.D_fall": 0.0123, "effect.added_mass.mass_kg": 0.25}
    assert again.scenario == msgspec.structs.replace(before.scenario, expect=Expectations())
    assert again.scenario.fault and "[[fault]]" in text


def test_only_what_differs_is_written() -> None:
    text = scenario_toml(load("lab_n_b").scenario)
    assert "bitrate" not in text and "expect" not in text and len(text.splitlines()) < 25

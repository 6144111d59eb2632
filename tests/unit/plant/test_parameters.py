"""Values that a parameter cannot have are refused by name; the shipped ones, and unusual ones, are not."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from can_dbc.errors import InputError
from plant.parameters import load
from plant.parameters.bounds import BY_PATH, BY_UNIT, bounds

NOMINAL = load()


@pytest.mark.parametrize("path", list(NOMINAL))
def test_every_parameter_has_bounds_and_its_shipped_value_lies_within(path: str) -> None:
    item = NOMINAL[path]
    assert path in BY_PATH or item.unit in BY_UNIT
    low, high = bounds(path, item.unit)
    values = NOMINAL.values(path)
    assert all(low <= value <= high for value in values)
    many = isinstance(item.value, tuple)
    for value in (low, high):
        kept = NOMINAL.override({path: [value] * len(values) if many else value})
        assert kept.values(path)[0] == value
    for value in (1e305, -1e305):
        with pytest.raises(InputError, match=rf"nominal: {path}: .*expected "):
            NOMINAL.override({path: [value] * len(values) if many else value})


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("length.m_s", -0.9),
        ("friction_length.F_rf_s", -1.0),
        ("gas.gamma", 0.9),
        ("alpha.alpha_m1", 1e9),
        ("stops.restitution", 1.5),
        ("gas.T", -20.0),
        ("valve.D_rise", -0.001),
    ],
)
def test_what_no_actuator_has_is_refused(tmp_path, path: str, value: float) -> None:
    with pytest.raises(InputError, match=re.escape(f"{path}: {value:g}; expected ")):
        NOMINAL.override({path: value})
    section, key = path.split(".")
    file = tmp_path / "model.toml"
    unit = NOMINAL[path].unit
    file.write_text(
        f'[base]\nmodel = "nominal"\n[{section}]\n'
        f'{key} = {{ value = {value!r}, unit = "{unit}", source = "made" }}\n'
    )
    with pytest.raises(InputError, match=re.escape(f"{key}.value: {value:g}; expected ")):
        load(file)


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        (
            '{ value = "a", unit = "s", source = "x" }',
            "value: 'a' is wrong; expected number or list",
        ),
        ('{ value = 0.01, unit = "s" }', "source: missing; expected a value"),
        ('{ value = 0.01, unit = "s", source = " " }', "source: ' ' is wrong; expected a text"),
        ('{ value = 0.01, unit = "ms", source = "x" }', "unit 'ms'; expected 's'"),
        ("3", "3 is wrong; expected table"),
    ],
)
def test_wrong_entries_of_a_model_file_are_named(tmp_path: Path, entry: str, message: str) -> None:
    path = tmp_path / "model.toml"
    path.write_text(f'[base]\nmodel = "nominal"\n[valve]\nD_rise = {entry}\n', encoding="utf-8")
    with pytest.raises(InputError, match=rf"model.toml: valve.D_rise[.:] ?{re.escape(message)}"):
        load(path)

"""Values that a parameter cannot have are refused by name; the shipped ones, and unusual ones, are not."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
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
        ("length.m_s", -0.9),             ("friction_length.F_rf_s", -1.0),
        ("gas.gamma", 0.9),               ("alpha.alpha_m1", 1e9),
        ("stops.restitution", 1.5),       ("gas.T", -20.0),
        ("valve.D_rise", -0.001),
    ],
)  # fmt: skip
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
        ('{ value = 0.01, unit = "s" }', "source: missing; expected text"),
        ('{ value = 0.01, unit = "s", source = " " }', "source: ' ' is wrong; expected a text"),
        ('{ value = 0.01, unit = "ms", source = "x" }', "unit 'ms'; expected 's'"),
        ("3", "3 is wrong; expected a table with the keys value, unit, source"),
    ],
)
def test_wrong_entries_of_a_model_file_are_named(tmp_path: Path, entry: str, message: str) -> None:
    path = tmp_path / "model.toml"
    path.write_text(f'[base]\nmodel = "nominal"\n[valve]\nD_rise = {entry}\n', encoding="utf-8")
    with pytest.raises(InputError, match=rf"model.toml: valve.D_rise[.:] ?{re.escape(message)}"):
        load(path)


def test_the_second_truck_reproduces_the_window_of_the_thesis() -> None:
    """40 ms from the release to the stop, 70 to 120 ms into gear, 40 to 100 ms to neutral (4.2.1)."""
    from plant.effects.stroke_conditions import StrokeConditions
    from plant.systems.stroke import simulate

    truck = load("truck_40ms")

    def stroke(kind: str, valve: str, force_n: float, impulse_n_s: float) -> tuple[float, float]:
        conditions = StrokeConditions(
            kind, 900000.0, ((0.0, valve, 0.98),), mounted=True,
            mesh_force_n=force_n, sync_impulse_n_s=impulse_n_s,
        )  # fmt: skip
        events = simulate(truck, conditions, np.arange(0.0, 0.4, 1e-3), internal=False).events
        at = {name: next((e.time_s for e in events if e.name == name), 0.0) for name in ("stop", "unblock")}  # fmt: skip
        contact = min(e.time_s for e in events if e.name.endswith("contact"))
        return at["stop"] - at["unblock"], at["stop"] - contact

    mesh, impulse = (truck.values(f"synchronizer.{n}_typ") for n in ("F_mesh", "impulse"))
    for force_n, impulse_n_s in zip(mesh, impulse, strict=True):
        last, together = stroke("N-B", "B", force_n, impulse_n_s)
        assert last == pytest.approx(0.040, abs=0.003)
        assert 0.070 <= together <= 0.120
    for force_n in truck.values("synchronizer.F_pull_typ"):
        assert 0.040 <= stroke("B-N", "N", force_n, 0.0)[1] <= 0.1005


def test_a_base_is_found_next_to_its_file_and_may_not_lead_back(tmp_path: Path) -> None:
    (tmp_path / "first.toml").write_text('[base]\nmodel = "second.toml"\n')
    (tmp_path / "second.toml").write_text('[base]\nmodel = "nominal"\n')
    assert load(tmp_path / "first.toml").value("valve.D_fall") == 0.035
    (tmp_path / "second.toml").write_text('[base]\nmodel = "first.toml"\n')
    with pytest.raises(InputError, match=r"first\.toml: base\.model: leads back to this file"):
        load(tmp_path / "first.toml")

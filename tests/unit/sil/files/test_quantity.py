"""Values in words: units from names, few digits, but never two equal numbers that differ."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from can_dbc.errors import InputError
from sil import simulate
from sil.campaign.campaign import load_campaign
from sil.files.quantity import comparison, in_unit, quantity, unit_of
from sil.simulation.load_scenario import load
from sil.studies.load_study import load_study


@pytest.mark.parametrize(
    ("name", "value", "limit", "text"),
    [
        ("position_lag_90_s", 0.012760103618673246, {"min": 0.038, "max": 0.046},
         "position_lag_90_s: 12.76 ms, expected 38 ms to 46 ms"),
        ("air_used_kg", 0.00081234, {"max": 0.0007}, "air_used_kg: 0.8123 g, expected at most 0.7 g"),
        ("frames", 1, {"min": 400}, "frames: 1, expected at least 400"),
        ("shift 1: requested to arrived", None, {"max": 0.2},
         "shift 1: requested to arrived: none, expected at most 0.2"),
        ("faults reported", ["A"], [], "faults reported: A, expected none"),
        ("valves off at the end", False, True, "valves off at the end: no, expected yes"),
        ("shift_time_s", 0.05000001, {"max": 0.05},
         "shift_time_s: 50.00001 ms, expected at most 50 ms"),
        ("valve_switchings", 3, {"min": 2, "max": 2}, "valve_switchings: 3, expected 2"),
    ],
)  # fmt: skip
def test_a_check_in_words(name: str, value: Any, limit: Any, text: str) -> None:
    assert comparison(name, value, limit, unit_of(name)) == text


def test_units_follow_from_names() -> None:
    assert [unit_of(n) for n in ("impulse_n_s", "speed_m_s", "late_m_s2", "duty", "delay_s")] == [
        "N s", "m/s", "m/s²", "", "s",
    ]  # fmt: skip
    assert [unit_of(n) for n in ("supply_fill_pa_s", "drag_n_m", "supply_v", "resistance_ohm")] == [
        "Pa/s", "N m", "V", "Ω",
    ]  # fmt: skip
    assert quantity(26_312.0, "N") == "26312 N"
    assert quantity(900_000.0, "Pa") == "9 bar" and quantity(2.0, "s") == "2 s"


@pytest.mark.parametrize(
    ("text", "unit", "value"),
    [
        ("7bar", "Pa", 7e5),
        ("700 kPa", "Pa (absolute)", 7e5),
        ("1.1ms", "s", 0.0011),
        ("-.5e1 mm", "m", -0.005),
        ("3ms", "ns", 3e6),
        ("600rpm", "rad/s", 62.83185307179586),
        ("40 Ns", "N s", 40.0),
        ("8 N s/m", "N s/m", 8.0),
    ],
)
def test_a_number_with_a_unit_is_exactly_the_number_in_the_unit_of_its_key(
    text: str, unit: str, value: float
) -> None:
    assert in_unit(text, unit, "x") == value


@pytest.mark.parametrize("text", ["neutral", "own.py", "2020-01-01", "1.5", "1e5", "3 5"])
def test_other_texts_stay(text: str) -> None:
    assert in_unit(text, "s", "x") == text


@pytest.mark.parametrize(
    ("path", "value", "said"),
    [
        ("plant.supply_pressure_pa", "7ms", "a unit of time; expected one of pressure: Pa, kPa"),
        ("valve.D_fall", "2bar", "a unit of pressure; expected one of time: s, ms"),
        ("sensor.delay_s", "3 parsec", "an unknown unit; expected one of time: s, ms"),
        ("controller.filter.order", "3ms", "'3ms' is wrong; expected whole number"),
    ],
)
def test_a_wrong_dimension_names_the_key_and_the_units(path: str, value: str, said: str) -> None:
    with pytest.raises(InputError) as refused:
        load("lab_n_b", settings={path: value})
    assert f"--set: {path}: " in str(refused.value) and said in str(refused.value)


def test_scenarios_settings_models_and_studies_take_units(tmp_path: Path) -> None:
    plain = load("lab_n_b", settings={"sensor.delay_s": 0.03, "valve.D_fall": 0.002})
    assert load("lab_n_b", settings={"sensor.delay_s": "30ms", "valve.D_fall": "2 ms"}) == plain
    file = tmp_path / "mine.toml"
    file.write_text(
        'name = "mine"\nduration_s = "0.5s"\nrequest = [{ at_s = "100ms", gear = "forward" }]\n'
        'sensor.delay_s = "30ms"\nmodel.valve.D_fall = "2ms"\n'
        'expect.metrics.shift_time_s.max = "80ms"\n'
    )
    loaded = load(str(file))
    assert loaded.scenario.request[0].at_s == 0.1 and loaded.scenario.duration_s == 0.5
    assert loaded.scenario.expect.metrics["shift_time_s"].max == 0.08
    assert loaded.parameters.value("valve.D_fall") == 0.002
    file.write_text(
        'name = "s"\nscenario = "lab_n_b"\n'
        'sweep = [{ path = "valve.D_fall", values = ["5ms", 0.02] },\n'
        '  { path = "sensor.delay_s", low = "1ms", high = "2ms", steps = 2 }]\n'
        'load = [{ name = "6 bar", set = { "plant.supply_pressure_pa" = "6bar" } }]\n'
    )
    study = load_study(str(file)).file
    assert study.sweep[0].values == [0.005, 0.02] and study.sweep[1].ends == (0.001, 0.002)
    assert study.load[0].set == {"plant.supply_pressure_pa": 6e5}
    file.with_name("campaign.toml").write_text(
        'name = "c"\nrig = "length"\natmosphere_pa = "1.01325bar"\ntemperature_k = 293.0\n'
        'sample_rate_hz = "2kHz"\n[columns]\nposition_m = "2 mm"\n'
        '[[stroke]]\nfile = "a.csv"\nkind = "N-B"\nsupply_pressure_pa = "9bar"\ncommands = []\n'
    )
    campaign = load_campaign(tmp_path)
    assert campaign.sample_rate_hz == 2000.0 and campaign.atmosphere_pa == 101325.0
    assert campaign.strokes[0].conditions.supply_pressure_pa == 9e5
    with pytest.raises(InputError, match=r"--set: valve\.D_rise: 1 N has a unit of force"):
        simulate("nowhere", {"valve.D_rise": "1 N"})

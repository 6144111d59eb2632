"""Scenario files: what is read, what is refused, and what every complaint says."""

from __future__ import annotations

import copy
import json
import tomllib
from pathlib import Path
from typing import Any

import msgspec
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from can_dbc import typed_toml
from can_dbc.errors import InputError
from sil.files import overrides
from sil.files.overrides import parse_setting
from sil.simulation import load_scenario, scenario
from sil.simulation.expectations import Expectations
from sil.simulation.load_scenario import from_table, shipped
from sil.simulation.scenario import Scenario, scenario_toml

GOOD = """\
name = "example"
duration_s = 0.5
[[request]]
at_s = 0.1
gear = "backward"
"""


def load(tmp_path: Path, text: str, **options: Any) -> load_scenario.Loaded:
    file = tmp_path / "s.toml"
    file.write_text(text)
    return load_scenario.load(str(file), **options)


def refused(tmp_path: Path, text: str, **options: Any) -> str:
    with pytest.raises(InputError) as caught:
        load(tmp_path, text, **options)
    message = str(caught.value)
    assert "\n" not in message
    return message


def test_defaults_are_those_of_the_parts(tmp_path: Path) -> None:
    loaded = load(tmp_path, GOOD)
    assert loaded.scenario.controller.period_s == 0.01
    assert loaded.scenario.bus.bitrate == 500_000
    assert loaded.parameters.value("valve.D_fall") == 0.035
    expanded = scenario.expanded(loaded.scenario)
    assert expanded["controller"]["filter"]["fc_hz"] == 22.0
    assert load_scenario.from_table(expanded, "x").scenario == loaded.scenario


def test_a_list_of_an_expanded_scenario_is_changed_by_index(tmp_path: Path) -> None:
    raw = scenario.expanded(load(tmp_path, GOOD + '[plant]\ncharged = ["N"]\n').scenario)
    changed = load_scenario.from_table(raw, "x", settings={"plant.charged[0]": "B"})
    assert changed.scenario.plant.charged == ("B",)
    with pytest.raises(InputError, match=r"plant\.charged\[1\]"):
        load_scenario.from_table(raw, "x", settings={"plant.charged[1]": "B"})


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("", "s.toml: name: missing; expected text"),
        ("nam = 1\n" + GOOD, "s.toml: nam: unknown; expected one of name"),
        (GOOD.replace('"backward"', '"backwards"'), "request[0].gear: 'backwards' is unknown; "),
        (GOOD.replace("example", "a\\u0001b"), "name: 'a\\\\x01b'; expected printable characters"),
        (GOOD.replace("0.5", "-1"), "s.toml: duration_s: -1 is wrong; expected number > 0.0"),
        (GOOD.replace("0.5", "nan"), "s.toml: duration_s: nan is wrong; expected a finite number"),
        (GOOD.replace("0.5", "inf"), "s.toml: duration_s: inf is wrong; expected a finite number"),
        (GOOD.replace("0.5", "'x'"), "s.toml: duration_s: 'x' is wrong; expected number"),
        (GOOD.replace("0.5", "0.1"), "request[0].at_s: 0.1; expected before the end, 0.1 s"),
        (GOOD.replace("at_s = 0.1\n", ""), "request[0].at_s: missing; expected number"),
        (GOOD.replace('gear = "backward"', ""), "gear: missing; expected one of neutral, backward"),
        (GOOD + GOOD[GOOD.index("[[") :], "request[1].at_s: 0.1; expected later than"),
        ("a = [", "expected TOML"),
        ("[[[", "expected TOML"),
    ],
)
def test_complaint(tmp_path: Path, text: str, complaint: str) -> None:
    assert complaint in refused(tmp_path, text)


@pytest.mark.parametrize(
    ("table", "complaint"),
    [
        ("[expect.metrics]\nlag={}", "expect.metrics.lag: unknown; expected one of"),
        ("[plant]\nmounted=1", "plant.mounted: 1 is wrong; expected true or false"),
        (
            "[expect]\nmetrics = { shift_time_s = { min = 2, max = 1 } }\n",
            "expect.metrics.shift_time_s: from 2.0 to 1.0; expected the smallest value first",
        ),
        (
            '[[expect.timing]]\nto = "arrived"\n',
            "expect.timing[0]: neither a smallest nor a largest value; expected one of them",
        ),
        (
            "[vehicle]\ngear_backward = 0\ngear_forward = 1\nratio_backward = 2\nratio_forward = 1\n",
            "vehicle.gear_backward, gear_forward: 0, 1; expected two different gears, none of them 0",
        ),
        ("[controller]\nperiod = 1\n", "controller.period: unknown; expected one of period_s"),
        ("[controller]\nperiod_s = 9.0\n", "controller.period_s: 9.0 is wrong; expected"),
        ("[controller.filter]\nfc_hz = 60.0\n", "controller.filter.fc_hz: 60.0 is wrong"),
        (
            "[driveline]\nengine_ramp_rad_s2 = 0\n",
            "driveline.engine_ramp_rad_s2: 0 is wrong; expected",
        ),
        ("[[fault]]\nkind = 'los'\n", "fault[0].kind: 'los' is unknown; "),
        ("[[fault]]\nkind = 'gremlin'\n", "fault[0].kind: 'gremlin' is unknown; expected one"),
        ("[[fault]]\nkind = 'dead'\nnode = 'plant'\n", "fault[0].node: 'plant' is unknown"),
        (
            "[[fault]]\nkind = 'stalled'\nnode = 'driver'\n",
            "s.toml: fault[0].end_s: missing; expected a time",
        ),
        ("[[sensor_fault]]\nkind = 'sticky'\n", "'sticky' is unknown; expected one of"),
        ("[[sensor_fault]]\nkind = 'off'\nstart_s = 1e308\n", "sensor_fault[0].start_s: 1e+308"),
        (
            "[model]\n'valve.D_fal' = 0.1\n",
            "valve.D_fal: no such parameter; expected one of valve.D_fall",
        ),
        ("[model]\n'valve.D_fall' = 'x'\n", "model.valve.D_fall: 'x' is wrong"),
        ("[bus]\nbitrate = 300000\n", "bus.bitrate: 300000 is unknown; expected one of"),
        ("[expect.metrics]\nshift_tim_s = {max = 1}\n", "shift_tim_s"),
        ("[plant]\ncharged = ['N', 'N']\n", "plant.charged: a chamber twice"),
        ("[plant]\nsupply_pressure_pa = 1\n", "plant.supply_pressure_pa: 1 is wrong"),
    ],
)
def test_complaint_of_a_table(tmp_path: Path, table: str, complaint: str) -> None:
    assert complaint in refused(tmp_path, GOOD + table)


def test_places_of_files(tmp_path: Path) -> None:
    for where in ("no/such.toml", "lab_n_x", "x" * 5000, "a\0b"):
        with pytest.raises(InputError):
            load_scenario.load(where)
    with pytest.raises(InputError, match=r"expected one of lab_n_[bf]"):
        load_scenario.load("lab_n_x")
    (tmp_path / "latin.toml").write_bytes(b'name = "\xe9"')
    with pytest.raises(InputError, match="byte 8: not UTF-8"):
        load_scenario.load(str(tmp_path / "latin.toml"))
    (tmp_path / "r.json").write_text("[]")
    with pytest.raises(InputError, match="no scenario in it"):
        load_scenario.load(str(tmp_path / "r.json"))
    with pytest.raises(InputError):
        load_scenario.load(str(tmp_path))


@pytest.mark.parametrize(
    ("setting", "path", "value"),
    [
        ("valve.D_fall=0.02", None, 0.02),
        ("controller.period_s=0.005", "controller.period_s", 0.005),
        ("controller.filter=false", "controller.filter.enabled", False),
        ("controller.filter.order=2", "controller.filter.order", 2),
        ("sensor.delay_s=0.003", "sensor.delay_s", 0.003),
        ("bus.bitrate=250000", "bus.bitrate", 250_000),
        ("request[0].gear=forward", "request.0.gear", "forward"),
        ("plant.damper=compressible", "plant.damper", "compressible"),
        ('plant.charged=["N"]', "plant.charged", ["N"]),
        ("driveline.residual_rad_s=5", "driveline.residual_rad_s", 5.0),
        ("expect.final_gear=neutral", "expect.final_gear", "neutral"),
    ],
)
def test_set(tmp_path: Path, setting: str, path: str | None, value: object) -> None:
    loaded = load(tmp_path, GOOD, settings=dict([parse_setting(setting)]))
    if path is None:
        assert loaded.parameters.value(setting.split("=")[0]) == value
        return
    at: Any = scenario.expanded(loaded.scenario)
    for step in path.split("."):
        at = at[int(step)] if step.isdigit() else at[step]
    assert at == value


def test_sensor_period_sets_the_firmwares_too(tmp_path: Path) -> None:
    loaded = load(tmp_path, GOOD, settings={"sensor.period_s": 0.005})
    assert loaded.scenario.controller.sensor.period_s == 0.005
    apart = "[sensor]\nperiod_s = 0.005\n[controller.sensor]\nperiod_s = 0.01\n"
    loaded = load(tmp_path, GOOD + apart)
    assert loaded.scenario.controller.sensor.period_s == 0.01
    loaded = load(tmp_path, GOOD + apart, settings={"sensor.period_s": 0.02})
    assert loaded.scenario.controller.sensor.period_s == 0.02


@pytest.mark.parametrize(
    ("setting", "complaint"),
    [
        ("valve.D_fal=1", "--set valve.D_fal: no such value; expected one of valve.D_fall"),
        ("controller.perod_s=1", "expected one of controller.period_s"),
        ("sensor.dely_s=1", "expected one of sensor.delay_s"),
        ("valve.D_fall", "no value; expected PATH=VALUE"),
        ("=1", "no value; expected PATH=VALUE"),
        ("valve.D_fall=abc", "--set: model.valve.D_fall: 'abc' is wrong; expected"),
        ("controller.period_s=abc", "--set: controller.period_s: 'abc' is wrong; expected number"),
        (
            "controller.filter=False",
            "--set controller.filter: False; expected true or false, as TOML",
        ),
        ("controller.filter=no", "'no' is wrong; expected true or false, or a table"),
        ("controller.filter=3", "3 is wrong; expected true or false, or a table"),
        ("valve.D_fall=-1", "--set: nominal: valve.D_fall: -1; expected 0 to 10 s"),
        ("controller.period_s=nan", "--set: controller.period_s: nan is wrong"),
        ("request[3].gear=neutral", "no such value"),
        ("name.x=1", "no such value"),
        ("plant.damper=wet", "--set: plant.damper: 'wet' is unknown; expected one of"),
    ],
)
def test_set_is_refused(tmp_path: Path, setting: str, complaint: str) -> None:
    with pytest.raises(InputError) as caught:
        load(tmp_path, GOOD, settings=dict([parse_setting(setting)]))
    assert complaint in str(caught.value)


def test_periods_that_contradict_each_other_are_named_with_the_cause(tmp_path: Path) -> None:
    both = load(tmp_path, GOOD, settings={"sensor.period_s": 0.0025})
    assert scenario.contradictions(both.scenario) == []
    apart = load(tmp_path, GOOD, settings={"controller.sensor.period_s": 0.0025})
    (line,) = scenario.contradictions(apart.scenario)
    assert "controller.sensor.period_s is 2.5 ms, but the sensor sends every 10 ms" in line


def test_model_file_and_seed(tmp_path: Path) -> None:
    model = tmp_path / "m.toml"
    model.write_text(
        '[base]\nmodel = "nominal"\n[valve]\nD_fall = {value = 0.01, unit = "s", source = "test"}\n'
    )
    loaded = load(tmp_path, GOOD, model=str(model), seed=9)
    assert loaded.parameters.value("valve.D_fall") == 0.01
    assert loaded.scenario.seed == 9
    assert "no such parameter set; expected nominal" in refused(tmp_path, GOOD, model="nominl")
    assert refused(tmp_path, GOOD, seed=-1).startswith("--seed: seed: -1 is wrong")
    assert refused(tmp_path, GOOD, model="no").startswith("--model: model 'no': no such")
    near = load(tmp_path, 'model_set = "m.toml"\n' + GOOD)
    assert near.parameters.value("valve.D_fall") == 0.01


@pytest.mark.parametrize("name", ["lost_frames", "truck_torque_to_torque"])
def test_every_settable_path_of_a_scenario_can_be_set_to_what_it_is(name: str) -> None:
    raw = scenario.expanded(load_scenario.load(name).scenario)
    absent = [key for key, value in raw.items() if value is None]
    found = list(overrides.leaf_paths(Scenario, raw))
    paths = [path for path in found if path.split(".")[0] not in absent]
    assert len(paths) > 80
    for path in paths:
        before = copy.deepcopy(raw)
        at: Any = raw
        for step in path.replace("]", "").replace("[", ".").split("."):
            at = at[int(step)] if isinstance(at, list) else at.get(step)
        assert overrides.set_value(raw, Scenario, path, at), path
        assert raw == before, path


def test_a_limit_that_is_no_number_is_refused_in_a_result_and_a_table(tmp_path: Path) -> None:
    table = tomllib.loads(GOOD) | {"expect": {"metrics": {"shift_time_s": {"max": float("nan")}}}}
    (tmp_path / "result.json").write_text(json.dumps({"scenario": table}))
    complaint = r"expect\.metrics\.shift_time_s\.max: nan is wrong; expected a finite number"
    with pytest.raises(InputError, match=complaint):
        load_scenario.load(str(tmp_path / "result.json"))
    with pytest.raises(InputError, match=f"^x: {complaint}"):
        from_table(table, "x")


# --- files mutated at random ---------------------------------------------------------------------

SHIPPED = [tomllib.loads(p.read_text()) for p in load_scenario.shipped().values()]
NAMES = st.sampled_from(
    ["name", "request", "gear", "at_s", "controller", "filter", "fault", "kind", "model", "expect"]
) | st.text(max_size=6)
VALUES: st.SearchStrategy[Any] = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(10**25), 10**25)
    | st.floats()
    | st.text(max_size=8)
    | st.sampled_from(["neutral", "B", "loss", "controller", "", "PUSH"]),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(NAMES, inner, max_size=3),
    max_leaves=6,
)


def places(value: Any, steps: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    found = [steps] if steps else []
    if isinstance(value, dict):
        for key, inner in value.items():
            found += places(inner, (*steps, key))
    elif isinstance(value, list):
        for index, inner in enumerate(value):
            found += places(inner, (*steps, index))
    return found


@st.composite
def mutated(draw: st.DrawFn) -> dict[str, Any]:
    table = copy.deepcopy(draw(st.sampled_from(SHIPPED)))
    for _ in range(draw(st.integers(1, 3))):
        candidates = places(table)
        if not candidates:
            break
        steps = draw(st.sampled_from(candidates))
        at: Any = table
        for step in steps[:-1]:
            at = at[step]
        action = draw(st.sampled_from(["replace", "delete", "rename"]))
        if action == "replace":
            at[steps[-1]] = draw(VALUES)
        elif action == "delete":
            del at[steps[-1]]
        elif isinstance(at, dict):
            at[draw(NAMES)] = at.pop(steps[-1])
    return table


def check_taken_or_refused(table: dict[str, Any]) -> None:
    try:
        taken = load_scenario.from_table(table, "s.toml").scenario
    except InputError as error:
        line = str(error)
        assert "\n" not in line and line.startswith("s.toml: ") and len(line) < 1000
    else:
        assert load_scenario.from_table(scenario.expanded(taken), "x").scenario == taken


@settings(max_examples=300, deadline=None, suppress_health_check=list(HealthCheck))
@given(table=mutated())
def test_a_mutated_scenario_is_taken_or_refused_in_one_line(table: dict[str, Any]) -> None:
    check_taken_or_refused(table)


@pytest.mark.slow
@settings(max_examples=12_000, deadline=None, suppress_health_check=list(HealthCheck))
@given(table=mutated())
def test_very_many_mutated_scenarios(table: dict[str, Any]) -> None:
    check_taken_or_refused(table)


def test_a_model_parameter_with_a_line_break_is_refused_in_one_line() -> None:
    table = {**tomllib.loads(GOOD), "model": {"\n": 0.005}}
    with pytest.raises(InputError, match=r"^s.toml: model: nominal: \\n: no such parameter"):
        load_scenario.from_table(table, "s.toml")


@settings(max_examples=200, deadline=None)
@given(raw=st.binary(max_size=200) | st.sampled_from([b"[" * 5000, b"a=" + b"[" * 3000]))
def test_any_bytes_are_refused_in_one_line(raw: bytes) -> None:
    try:
        typed_toml.parse_toml(raw, "s.toml")
    except InputError as error:
        assert "\n" not in str(error)


@settings(max_examples=150, deadline=None)
@given(path=st.text(max_size=30), value=st.text(max_size=20))
def test_any_setting_is_taken_or_refused_in_one_line(path: str, value: str) -> None:
    table = tomllib.loads(GOOD)
    try:
        load_scenario.from_table(table, "s.toml", settings=dict([parse_setting(f"{path}={value}")]))
    except InputError as error:
        assert "\n" not in str(error)


def test_a_strategy_s_own_settings_are_set_by_path() -> None:
    plain = load_scenario.load("strategy_bang_bang").scenario.controller.strategy_parameters
    own = "controller.strategy_parameters"
    settings = {f"{own}.brake_s": 0.011, f"{own}.model.valve_close_s": 0.007}
    loaded = load_scenario.load("strategy_bang_bang", settings=settings)
    found = loaded.scenario.controller.strategy_parameters
    assert found == {**plain, "brake_s": 0.011, "model": {**plain["model"], "valve_close_s": 0.007}}
    for bad in ("break_s", "model.valve_clos_s", "brake_s.x", "brake_s"):
        with pytest.raises(InputError, match=r"strategy_parameters.*expected"):
            load_scenario.load("strategy_bang_bang", settings={f"{own}.{bad}": -1})


@pytest.mark.parametrize("name", sorted(shipped()))
def test_every_shipped_scenario_survives(name: str) -> None:
    before = load_scenario.load(name)
    again = from_table(tomllib.loads(scenario_toml(before.scenario)), "text")
    assert again.scenario == msgspec.structs.replace(before.scenario, expect=Expectations())
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
    before = load_scenario.load("bus_off", settings=settings)
    text = scenario_toml(before.scenario)
    again = from_table(tomllib.loads(text), "text")
    assert again.scenario.model == {"valve.D_fall": 0.0123, "effect.added_mass.mass_kg": 0.25}
    assert again.scenario == msgspec.structs.replace(before.scenario, expect=Expectations())
    assert again.scenario.fault and "[[fault]]" in text


def test_only_what_differs_is_written() -> None:
    text = scenario_toml(load_scenario.load("lab_n_b").scenario)
    assert "bitrate" not in text and "expect" not in text and len(text.splitlines()) < 25

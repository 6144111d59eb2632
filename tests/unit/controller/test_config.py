"""Settings: defaults, bounds, cross checks, the lines that say what is wrong, and the struct in C."""

from __future__ import annotations

import json
import math
import re
import struct
import subprocess
import sys
from typing import Any

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from can_dbc.errors import InputError
from can_dbc.messages import Chamber, Gear
from can_dbc.typed_toml import convert
from controller.c_settings import content, declaration
from controller.config import FirmwareConfig, load_config
from controller.filters import butterworth
from controller.light_model import ModelSettings, ObserverSettings
from controller.settings import (
    BlowConfig,
    BroadcastConfig,
    E2eConfig,
    FilterConfig,
    SensorConfig,
    Settings,
    ShiftConfig,
    WindowConfig,
    nanoseconds,
)
from controller.strategies import NAMES, OFF, ShiftContext, parameters
from controller.strategies.foresight import ForesightParameters
from controller.strategies.into_gear import BRAKE, PUSH, REST, IntoGearParameters, PushProgress
from tests.conftest import ROOT

RECORDS = [
    SensorConfig, FilterConfig, WindowConfig, BlowConfig, ShiftConfig, E2eConfig, FirmwareConfig,
]  # fmt: skip


def test_defaults_agree_with_each_other() -> None:
    """Windows wider than the filter's overshoot; interlock and hold longer than the valve."""
    config = FirmwareConfig()
    assert config.windows.neutral_tolerance_m > 0.1705 * config.windows.stroke_m
    assert config.windows.gear_tolerance_m > 0.095 * config.windows.stroke_m  # the swing back
    assert config.shift.interlock_s > 0.035 and config.shift.hold_s > 0.035
    assert config.shift.reversal_settle_s > 0.035 + 0.04 + 0.01


def test_whole_table() -> None:
    config = load_config(
        {
            "period_s": 0.0025,
            "sensor": {"period_s": 0.0025},
            "filter": {"order": 2, "fc_hz": 100.0},
            "blow": {"cut": "none"},
        },
        "s.toml",
    )
    assert config.period_ns == 2_500_000 and config.sensor == SensorConfig(period_s=0.0025)
    assert config.filter == FilterConfig(order=2, fc_hz=100.0) and config.blow.cut == "none"


@pytest.mark.parametrize("enabled", [True, False])
def test_filter_as_a_switch(enabled: bool) -> None:
    assert load_config({"filter": enabled}, "s.toml").filter == FilterConfig(enabled=enabled)


def bounds(kind: type[msgspec.Struct]) -> list[tuple[str, Any]]:
    schema = msgspec.json.schema(kind)["$defs"][kind.__name__]["properties"]
    return [(name, field) for name, field in schema.items() if "minimum" in field]


@pytest.mark.parametrize("kind", RECORDS)
def test_every_bound_holds_however_the_record_is_made(kind: type[msgspec.Struct]) -> None:
    assert bounds(kind)
    for name, field in bounds(kind):
        low, high, unit = field["minimum"], field["maximum"], field.get("description", "")
        for wrong in (low - 1, high + 1, math.nan):
            said = f"{name}: {wrong!r} is wrong; expected {low:g} to {high:g} {unit}".rstrip()
            with pytest.raises(InputError) as caught:
                kind(**{name: wrong})
            assert str(caught.value) == said
            with pytest.raises(InputError, match=f"^x[.]{name}: .* is wrong; expected "):
                convert({name: wrong}, kind, key="x")


@pytest.mark.parametrize("kind", RECORDS)
def test_every_number_has_bounds(kind: type[msgspec.Struct]) -> None:
    named = {name for name, _ in bounds(kind)}
    for field in msgspec.structs.fields(kind):
        if isinstance(field.default, (int, float)) and not isinstance(field.default, bool):
            assert field.name in named


LINES = [
    ({"perid_s": 0.01}, "perid_s: unknown; expected one of period_s, ..."),
    ({"filter": {"ordr": 2}}, "filter.ordr: unknown; expected one of order, enabled, fc_hz"),
    ({"period_s": 0.03}, "period_s: 0.03 is wrong; expected number <= 0.02"),
    ({"filter": 3}, "filter: 3 is wrong; expected a table with the keys enabled, order, fc_hz"),
    (
        {"blow": {"cut": "early"}},
        "blow.cut: 'early' is unknown; expected one of none, sync, confirmation",
    ),
    (
        {"filter": {"fc_hz": 50.0}},
        "filter.fc_hz: 50.0 is wrong; expected below 50 Hz, half the rate of the sensor",
    ),
    (
        {"period_s": 1 / 300},
        "period_s: 0.0033333333333333335 is wrong; expected a whole number of nanoseconds",
    ),
    ({"computation_s": 0.01}, "computation_s: 0.01 is wrong; expected below period_s, 0.01 s"),
    (
        {"e2e": {"position_timeout_s": 0.01}},
        "e2e.position_timeout_s: 0.01 is wrong; expected above sensor.period_s, 0.01 s",
    ),
    (
        {"sensor": {"temperature_min_k": 400.0, "temperature_max_k": 400.0}},
        "sensor.temperature_min_k: 400.0 is wrong; expected below temperature_max_k, 400.0 K",
    ),
    (
        {"sensor": {"temp_coeff_per_k": -0.005, "t_ref_k": 200.0, "temperature_max_k": 400.0}},
        "sensor.temp_coeff_per_k: -0.005 is wrong; expected a pulse longer than zero at 400.0 K",
    ),
    (
        {"sensor": {"temp_coeff_per_k": 0.005, "t_ref_k": 450.0, "temperature_min_k": 250.0}},
        "sensor.temp_coeff_per_k: 0.005 is wrong; expected a pulse longer than zero at 250.0 K",
    ),
    (
        {"windows": {"neutral_tolerance_m": 0.0125, "gear_tolerance_m": 0.0015}},
        "windows.neutral_tolerance_m: 0.0125 is wrong; expected windows that do not "
        "overlap: below stroke_m - gear_tolerance_m, 0.01135 m",
    ),
    (
        {
            "windows": {
                "stroke_m": 0.0625,
                "neutral_tolerance_m": 0.03125,
                "gear_tolerance_m": 0.03125,
            }
        },
        "windows.neutral_tolerance_m: 0.03125 is wrong; expected windows that do not "
        "overlap: below stroke_m - gear_tolerance_m, 0.03125 m",
    ),
    (
        {"strategy": "open_lop"},
        "strategy: 'open_lop' is unknown; expected one of open_loop, blow_cut, air_cushion, "
        "synchro_brake, fixed_programme, sliding_mode, bang_bang, predictive",
    ),
    ({"strategy_parameters": {"gain": 1}}, "strategy_parameters.gain: unknown; expected none"),
]


@pytest.mark.parametrize(("table", "line"), LINES)
def test_lines(table: dict[str, Any], line: str) -> None:
    with pytest.raises(InputError) as caught:
        load_config(table, "s.toml")
    assert str(caught.value) == f"s.toml: {line}"


def test_limits_themselves_are_allowed() -> None:
    FirmwareConfig(period_s=0.002)
    FirmwareConfig(period_s=0.02)
    FirmwareConfig(duty=0.35, duty_closed=0.35)
    assert FirmwareConfig(filter=FilterConfig(fc_hz=49.9)).filter.fc_hz == 49.9
    assert FirmwareConfig(computation_s=0.0099).computation_ns == 9_900_000
    SensorConfig(temperature_min_k=399.9, temperature_max_k=400.0)
    E2eConfig(position_timeout_s=0.011)
    SensorConfig(temp_coeff_per_k=-0.005, t_ref_k=200.0, temperature_max_k=399.9)


LEAVES = st.one_of(
    st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=5), st.lists(st.floats())
)


@given(
    st.dictionaries(
        st.sampled_from([f.name for f in msgspec.structs.fields(FirmwareConfig)])
        | st.text(max_size=4),
        LEAVES | st.dictionaries(st.text(max_size=9), LEAVES, max_size=2),
        max_size=4,
    )
)
@settings(max_examples=300, deadline=None)
def test_any_table_is_settings_or_one_clear_line(table: dict[str, Any]) -> None:
    try:
        config = load_config(table, "s.toml")
    except InputError as error:
        assert str(error).startswith("s.toml: ")
        assert "expected" in str(error)
    else:
        assert isinstance(config, FirmwareConfig)


def test_nanoseconds_are_rounded() -> None:
    assert nanoseconds(0.0025) == 2_500_000 and nanoseconds(0.3e-9) == 0


def test_import_is_light() -> None:
    """The firmware needs no number crunching package."""
    code = (
        "import sys, controller.firmware as f; f.Firmware(f.FirmwareConfig());"
        "heavy = {'numpy', 'scipy', 'numba', 'can', 'cantools'} & set(sys.modules);"
        "sys.exit(', '.join(heavy) or None)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


DEFAULTS = json.loads((ROOT / "tests/data/firmware_defaults.json").read_text())


def plain(settings: msgspec.Struct) -> Any:
    return json.loads(msgspec.json.encode(settings))


def test_the_firmware() -> None:
    assert plain(FirmwareConfig()) == DEFAULTS["firmware"]


def test_the_light_model() -> None:
    assert plain(ModelSettings()) == DEFAULTS["model"]
    assert plain(ObserverSettings()) == DEFAULTS["observer"]


@pytest.mark.parametrize("name", list(NAMES))
def test_a_strategy(name: str) -> None:
    defaults = plain(parameters(name, {}))
    for part in ("model", "observer"):
        assert defaults.pop(part, DEFAULTS[part]) == DEFAULTS[part]
    assert defaults == DEFAULTS["strategies"][name]


KINDS = (
    *(Settings, FirmwareConfig, SensorConfig, FilterConfig, WindowConfig, BlowConfig, ShiftConfig),
    *(BroadcastConfig, E2eConfig, ModelSettings, ObserverSettings, ForesightParameters),
    *(IntoGearParameters, *(type(parameters(name, {})) for name in NAMES)),
)


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__qualname__)
def test_settings_cannot_be_changed_and_take_no_strangers(kind: type[msgspec.Struct]) -> None:
    assert kind.__struct_config__.frozen and kind.__struct_config__.forbid_unknown_fields


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: ObserverSettings(sensor_age_s=1.0),
            "sensor_age_s: 1.0 is wrong; expected 0 to 0.05 s",
        ),
        (lambda: ModelSettings(stay_kg=0.0), "stay_kg: 0.0 is wrong; expected 0.05 to 100 kg"),
        (lambda: BlowConfig(duration_s=9.0), "duration_s: 9.0 is wrong; expected 0 to 0.25 s"),
        (lambda: FilterConfig(order=9), "order: 9 is wrong; expected 1 to 8"),
        (
            lambda: type(parameters("air_cushion", {}))(lead_s=3.0),
            "lead_s: 3.0 is wrong; expected 0 to 0.1 s",
        ),
        (
            lambda: parameters("bang_bang", {"table": [[7e5, 0.1], [6e5, 0.1]]}),
            "strategy_parameters.table: wrong order; expected ascending supply pressures",
        ),
    ],
)
def test_the_message_of_a_value_out_of_bounds_has_its_unit(make: Any, message: str) -> None:
    with pytest.raises(InputError) as caught:
        make()
    assert str(caught.value) == message


def test_commands_and_defaults_of_a_push() -> None:
    assert (PUSH, BRAKE, REST) == ((True, False), (False, True), (False, False))
    assert PushProgress(0.0, 0.0, 0.0, 0) == (0.0, 0.0, 0.0, 0, None, 0.0)
    assert ShiftContext(Gear.NEUTRAL, Chamber.N, 0, 0)[-2:] == (None, 0)
    assert OFF == (0.0, 0.0, 0.0)


def members() -> list[str]:
    """The names of all members, with the structs that they are in."""
    inside: list[str] = []
    names: list[str] = []
    for line in declaration().partition("struct opc4_settings {\n")[2].splitlines():
        if line.endswith("struct {"):
            inside.append("")
        elif end := re.match(r" +\} (\w+);", line):
            inside.pop()
            names = [name.replace("?", f"{end[1]}.", 1) if "?" in name else name for name in names]
        elif member := re.match(r" +(?:double|int64_t) (\w+)((?:\[\d\])*);", line):
            count = eval(member[2].replace("][", "*").strip("[]") or "1")
            names += ["?" * len(inside) + member[1]] * count
    return names


@pytest.mark.parametrize(
    ("table", "member", "value"),
    [
        ({"period_s": 0.005}, "period_s", 0.005),
        ({"filter": False}, "filter.enabled", 0),
        ({"sensor": {"still_ticks": 7}}, "sensor.still_ticks", 7),
        ({"blow": {"cut": "confirmation"}}, "blow.cut", 2),
        ({"broadcast": {"gear_forward": -3}}, "broadcast.gear_forward", -3),
        ({"strategy": "sliding_mode", "strategy_parameters": {"band_m_s": 0.3}},
         "sliding_mode.band_m_s", 0.3),
    ],
)  # fmt: skip
def test_a_setting_changes_its_own_bytes_alone(table: dict, member: str, value: float) -> None:
    before, after = content(FirmwareConfig()), content(load_config(table, "test"))
    assert len(after) == 8 * len(members())
    changed = {
        k for k in range(len(members())) if before[8 * k : 8 * k + 8] != after[8 * k : 8 * k + 8]
    }
    k = members().index(member)
    kind = "d" if isinstance(value, float) else "q"
    assert struct.unpack_from(f"<{kind}", after, 8 * k)[0] == value
    assert changed - {members().index("strategy")} == {k}


def test_the_filter_comes_as_its_coefficients() -> None:
    numbers = [x for section in butterworth(6, 22.0, 100.0) for x in section]
    at = 8 * members().index("section_count")
    assert struct.unpack_from("<q15d", content(FirmwareConfig()), at) == (3, *numbers)

"""Settings: defaults, bounds, cross checks, and the lines that say what is wrong."""

from __future__ import annotations

import math
import subprocess
import sys
from typing import Any

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from can_dbc.errors import InputError
from can_dbc.typed_toml import convert
from controller.config import FirmwareConfig, load_config
from controller.settings import (
    BlowConfig,
    E2eConfig,
    FilterConfig,
    SensorConfig,
    ShiftConfig,
    WindowConfig,
    nanoseconds,
)

RECORDS = [
    SensorConfig,
    FilterConfig,
    WindowConfig,
    BlowConfig,
    ShiftConfig,
    E2eConfig,
    FirmwareConfig,
]


def test_defaults_agree_with_each_other() -> None:
    """Windows wider than the filter's overshoot; interlock and hold longer than the valve."""
    config = FirmwareConfig()
    assert config.windows.neutral_tolerance_m > 0.1705 * config.windows.stroke_m
    assert config.windows.gear_tolerance_m > 0.095 * config.windows.stroke_m  # the swing back
    assert config.shift.interlock_s > 0.035
    assert config.shift.hold_s > 0.035
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
    assert config.period_ns == 2_500_000
    assert config.sensor == SensorConfig(period_s=0.0025)
    assert config.filter == FilterConfig(order=2, fc_hz=100.0)
    assert config.blow.cut == "none"


@pytest.mark.parametrize("enabled", [True, False])
def test_filter_as_a_switch(enabled: bool) -> None:
    config = load_config({"filter": enabled}, "s.toml")
    assert config.filter == FilterConfig(enabled=enabled)


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
    ({"perid_s": 0.01}, "s.toml: perid_s: unknown; expected one of period_s, ..."),
    (
        {"filter": {"ordr": 2}},
        "s.toml: filter.ordr: unknown; expected one of order, enabled, fc_hz",
    ),
    ({"period_s": 0.03}, "s.toml: period_s: 0.03 is wrong; expected number <= 0.02"),
    (
        {"filter": 3},
        "s.toml: filter: 3 is wrong; expected a table with the keys enabled, order, fc_hz",
    ),
    (
        {"blow": {"cut": "early"}},
        "s.toml: blow.cut: 'early' is unknown; expected one of none, sync, confirmation",
    ),
    (
        {"filter": {"fc_hz": 50.0}},
        "s.toml: filter.fc_hz: 50.0 is wrong; expected below 50 Hz, half the rate of the sensor",
    ),
    (
        {"period_s": 1 / 300},
        "s.toml: period_s: 0.0033333333333333335 is wrong; expected a whole number of nanoseconds",
    ),
    (
        {"computation_s": 0.01},
        "s.toml: computation_s: 0.01 is wrong; expected below period_s, 0.01 s",
    ),
    (
        {"e2e": {"position_timeout_s": 0.01}},
        "s.toml: e2e.position_timeout_s: 0.01 is wrong; expected above sensor.period_s, 0.01 s",
    ),
    (
        {"sensor": {"temperature_min_k": 400.0, "temperature_max_k": 400.0}},
        "s.toml: sensor.temperature_min_k: 400.0 is wrong; expected below temperature_max_k, "
        "400.0 K",
    ),
    (
        {"sensor": {"temp_coeff_per_k": -0.005, "t_ref_k": 200.0, "temperature_max_k": 400.0}},
        "s.toml: sensor.temp_coeff_per_k: -0.005 is wrong; expected a pulse longer than zero at "
        "400.0 K",
    ),
    (
        {"sensor": {"temp_coeff_per_k": 0.005, "t_ref_k": 450.0, "temperature_min_k": 250.0}},
        "s.toml: sensor.temp_coeff_per_k: 0.005 is wrong; expected a pulse longer than zero at "
        "250.0 K",
    ),
    (
        {"windows": {"neutral_tolerance_m": 0.0125, "gear_tolerance_m": 0.0015}},
        "s.toml: windows.neutral_tolerance_m: 0.0125 is wrong; expected windows that do not "
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
        "s.toml: windows.neutral_tolerance_m: 0.03125 is wrong; expected windows that do not "
        "overlap: below stroke_m - gear_tolerance_m, 0.03125 m",
    ),
    (
        {"strategy": "open_lop"},
        "s.toml: strategy: 'open_lop' is unknown; expected one of open_loop, blow_cut, air_cushion, "
        "synchro_brake, fixed_programme, sliding_mode, bang_bang, predictive",
    ),
    (
        {"strategy_parameters": {"gain": 1}},
        "s.toml: strategy_parameters.gain: unknown; expected none",
    ),
]


@pytest.mark.parametrize(("table", "line"), LINES)
def test_lines(table: dict[str, Any], line: str) -> None:
    with pytest.raises(InputError) as caught:
        load_config(table, "s.toml")
    assert str(caught.value) == line


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
    assert nanoseconds(0.0025) == 2_500_000
    assert nanoseconds(0.3e-9) == 0


def test_import_is_light() -> None:
    """The firmware needs no number crunching package."""
    code = (
        "import sys, controller.firmware as f; f.Firmware(f.FirmwareConfig());"
        "heavy = {'numpy', 'scipy', 'numba', 'can', 'cantools'} & set(sys.modules);"
        "sys.exit(', '.join(heavy) or None)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr

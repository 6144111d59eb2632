"""Every default, word for word: today's control unit, and each strategy as it was tuned.

A default that changes changes every scenario that does not state it, so it has to be changed here too.
"""

from __future__ import annotations

from typing import Any

import msgspec
import pytest

from can_dbc.errors import InputError
from can_dbc.messages import Chamber, Gear
from controller.config import FirmwareConfig, create_strategy
from controller.estimator import ObserverSettings
from controller.light_model import ModelSettings
from controller.settings import (
    BlowConfig,
    E2eConfig,
    FilterConfig,
    SensorConfig,
    Settings,
    ShiftConfig,
    WindowConfig,
)
from controller.strategies import NAMES, OFF, ShiftContext, Strategy, parameters
from controller.strategies.foresight import ForesightParameters
from controller.strategies.into_gear import BRAKE, PUSH, REST, IntoGearParameters, Progress

FIRMWARE: dict[str, Any] = {
    "period_s": 0.01,
    "computation_s": 0.0001,
    "duty": 0.98,
    "duty_closed": 0.33,
    "sensor": {
        "period_s": 0.01,
        "t_mid_s": 0.0009,
        "slope_s_per_m": 0.022,
        "temp_coeff_per_k": 0.0012,
        "t_ref_k": 293.15,
        "timer_resolution_s": 1e-06,
        "temperature_min_k": 233.15,
        "temperature_max_k": 423.15,
        "overtravel_m": 0.003,
        "max_speed_m_s": 4.0,
        "travel_limit_m": 0.035,
        "travel_leak_m_s": 0.3,
        "bad_limit": 6,
        "still_ticks": 2,
    },
    "filter": {"enabled": True, "order": 6, "fc_hz": 22.0},
    "windows": {
        "stroke_m": 0.01285,
        "neutral_tolerance_m": 0.0025,
        "gear_tolerance_m": 0.0015,
        "samples": 2,
    },
    "blow": {"duration_s": 0.15, "cut": "sync"},
    "shift": {
        "push_timeout_s": 1.0,
        "retries": 1,
        "retry_pause_s": 0.1,
        "no_motion_s": 0.4,
        "reversal_settle_s": 0.12,
        "hold_s": 0.04,
        "vent_s": 0.11,
        "interlock_s": 0.04,
        "sync_tolerance_rad_s": 2.0,
        "wait_for_sync": False,
        "sync_wait_s": 1.0,
        "init_settle_s": 0.04,
        "init_timeout_s": 0.3,
    },
    "e2e": {
        "position_timeout_s": 0.05,
        "request_timeout_s": 0.1,
        "speeds_timeout_s": 0.05,
        "startup_s": 0.2,
    },
    "strategy": "open_loop",
    "strategy_parameters": {},
}

MODEL: dict[str, Any] = {
    "supply_pa": 900000.0,
    "atmosphere_pa": 101325.0,
    "valve_open_s": 0.008,
    "valve_close_s": 0.035,
    "transport_s": 0.00038,
    "stay_kg": 0.9,
    "piston_kg": 0.2,
    "stay_friction_n": 22.0,
    "piston_friction_n": 29.0,
    "stay_damping_n_s_m": 17.0,
    "piston_damping_n_s_m": 22.0,
    "piston_m2": 0.00251327412,
    "stay_m2": 0.000314159265,
    "gap_m": 0.013,
    "driving_m3": 2.8e-05,
    "braking_m3": 9.2968e-05,
    "filling_alpha_flow": 0.94,
    "filling_alpha_volume": 0.87,
    "venting_alpha_flow": 1.5,
    "venting_alpha_volume": 1.05,
    "flow_in": 2.27e-06,
    "flow_in_critical": -0.605,
    "flow_out": 2.42e-06,
    "flow_out_critical": 0.281,
}

OBSERVER: dict[str, Any] = {
    "sensor_age_s": 0.00455,
    "position_gain": 0.5,
    "speed_gain_per_s": 20.0,
    "load_gain_n_m": 30000.0,
    "most_load_n": 2200.0,
}

STRATEGIES: dict[str, Any] = {
    "open_loop": {},
    "blow_cut": {"neutral_s": 0.0, "otherwise_s": 0.25},
    "air_cushion": {
        "patience_s": 0.35,
        "trigger_m": 0.006,
        "lead_s": 0.012,
        "burst_s": 0.015,
        "keep_charging": False,
    },
    "synchro_brake": {
        "patience_s": 0.35,
        "brake_lead_s": 0.03,
        "burst_s": 0.005,
        "rest_lead_s": 0.04,
        "rest_s": 0.005,
        "least_lead_s": 0.03,
        "least_rad_s": 0.5,
        "least_fall_rad_s2": 600.0,
    },
    "sliding_mode": {"patience_s": 0.35, "slope_per_s": 60.0, "band_m_s": 0.1, "beyond_m": 0.003},
    "bang_bang": {
        "patience_s": 0.35,
        "horizon_s": 0.06,
        "table": ((600000.0, 0.002), (700000.0, 0.004), (800000.0, 0.002), (900000.0, 0.002)),
        "impact_m_s": 0.2,
        "brake_s": 0.02,
        "seen_m": 0.0005,
    },
    "predictive": {
        "patience_s": 0.35,
        "horizon_s": 0.06,
        "time_weight_m_s2": 10.0,
        "way_weight_per_s": 300.0,
    },
}


def test_the_firmware() -> None:
    assert msgspec.to_builtins(FirmwareConfig()) == FIRMWARE


def test_the_light_model() -> None:
    assert msgspec.to_builtins(ModelSettings()) == MODEL
    assert msgspec.to_builtins(ObserverSettings()) == OBSERVER


@pytest.mark.parametrize("name", list(NAMES))
def test_a_strategy(name: str) -> None:
    found = msgspec.to_builtins(parameters(name, {}))
    assert found.pop("model", MODEL) == MODEL
    assert found.pop("observer", OBSERVER) == OBSERVER
    assert found == STRATEGIES[name]


KINDS = (
    *(Settings, FirmwareConfig, SensorConfig, FilterConfig, WindowConfig, BlowConfig, ShiftConfig),
    *(E2eConfig, ModelSettings, ObserverSettings, Strategy.Parameters, ForesightParameters),
    *(IntoGearParameters, *(type(parameters(name, {})) for name in NAMES)),
)


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__qualname__)
def test_settings_cannot_be_changed_and_take_no_strangers(kind: type[msgspec.Struct]) -> None:
    assert kind.__struct_config__.frozen
    assert kind.__struct_config__.forbid_unknown_fields


@pytest.mark.parametrize(
    ("make", "told"),
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
def test_what_is_out_of_bounds_is_told_with_its_unit(make: Any, told: str) -> None:
    with pytest.raises(InputError) as caught:
        make()
    assert str(caught.value) == told


def test_the_plain_wishes_and_what_is_not_known() -> None:
    assert (PUSH, BRAKE, REST) == ((True, False), (False, True), (False, False))
    assert Progress(0.0, 0.0, 0.0, 0) == (0.0, 0.0, 0.0, 0, None, 0.0)
    nobody = ShiftContext(
        Gear.NEUTRAL, Gear.NEUTRAL, Chamber.N, Chamber.B, 0, 0, (None, None, None)
    )
    assert nobody[-2:] == (None, 0)
    assert OFF == (0.0, 0.0, 0.0)


@pytest.mark.parametrize("name", list(NAMES))
def test_a_strategy_knows_its_name(name: str) -> None:
    assert create_strategy(FirmwareConfig(strategy=name)).name == name

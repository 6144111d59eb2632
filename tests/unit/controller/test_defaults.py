"""Every default, word for word: today's control unit, and each strategy as it was tuned.

A default that changes changes every scenario that does not state it, so it has to be changed in
tests/data/firmware_defaults.json too.
"""

from __future__ import annotations

import json
from typing import Any

import msgspec
import pytest

from can_dbc.errors import InputError
from can_dbc.messages import Chamber, Gear
from controller.config import FirmwareConfig
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
)
from controller.strategies import NAMES, OFF, ShiftContext, parameters
from controller.strategies.foresight import ForesightParameters
from controller.strategies.into_gear import BRAKE, PUSH, REST, IntoGearParameters, PushProgress
from tests.conftest import ROOT

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
    assert kind.__struct_config__.frozen
    assert kind.__struct_config__.forbid_unknown_fields


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

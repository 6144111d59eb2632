"""Where the settings of a replay are from."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from can_dbc.errors import InputError
from sil.files.overrides import Settings
from sil.log_replay.options import find_settings
from sil.log_replay.tick_grid import survey
from sil.simulation import load_scenario, scenario
from tests.support.golden_logs import arrivals

FOUND = survey(arrivals("firmware_2500us"))


def result(folder: Path, name: str) -> Path:
    path = folder / "result.json"
    path.write_text(json.dumps({"scenario": scenario.expanded(load_scenario.load(name).scenario)}))
    return folder / "bus.log"


def test_without_a_run_the_periods_are_those_of_the_log(tmp_path: Path) -> None:
    found = find_settings(str(tmp_path / "a.log"), FOUND)
    config = found.loaded.scenario.controller
    assert (config.period_ns, config.sensor.period_s) == (2_500_000, 0.0025)
    assert config.filter.enabled and not found.own_run
    assert found.description == "defaults, period 2.5 ms and sensor period 2.5 ms from the log"


def test_the_run_beside_the_log_gives_its_settings(tmp_path: Path) -> None:
    log = result(tmp_path, "strategy_predictive")
    found = find_settings(str(log), FOUND, settings={"controller.period_s": 0.005})
    assert found.own_run
    assert found.loaded.scenario.controller.strategy == "predictive"
    assert found.loaded.scenario.controller.period_ns == 5_000_000
    assert found.description.endswith("result.json with controller.period_s=0.005")


@pytest.mark.parametrize(
    "text",
    [
        "filter = false\n",
        "[controller]\nfilter = false\n",
        "controller = { filter = { enabled = false } }",
    ],
)
def test_a_file_gives_the_settings_and_the_log_the_period(tmp_path: Path, text: str) -> None:
    file = tmp_path / "f.toml"
    file.write_text(text)
    config = find_settings(
        str(tmp_path / "a.log"), FOUND, firmware=str(file)
    ).loaded.scenario.controller
    assert not config.filter.enabled and config.period_ns == 2_500_000


def test_another_runs_result_gives_its_firmware(tmp_path: Path) -> None:
    result(tmp_path, "filter_off")
    found = find_settings("elsewhere/a.log", FOUND, firmware=str(tmp_path / "result.json"))
    config = found.loaded.scenario.controller
    assert not config.filter.enabled and config.period_ns == 10_000_000


@pytest.mark.parametrize(
    ("settings", "complaint"),
    [
        ({"valve.D_fall": 0.01}, "valve.D_fall: not of the firmware"),
        ({"controller.filtre": False}, "expected one of controller.filter"),
        ({"controller.period_s": 1.0}, "controller.period_s"),
    ],
)
def test_settings_that_cannot_be_are_refused(settings: Settings, complaint: str) -> None:
    with pytest.raises(InputError) as refused:
        find_settings("a.log", FOUND, settings=settings)
    assert complaint in str(refused.value)


def test_a_file_without_settings_is_refused(tmp_path: Path) -> None:
    (tmp_path / "f.json").write_text("[]")
    with pytest.raises(InputError, match="no firmware settings"):
        find_settings("a.log", FOUND, firmware=str(tmp_path / "f.json"))
    (tmp_path / "f.toml").write_text("controller = 1\n")
    with pytest.raises(InputError, match="not a table"):
        find_settings("a.log", FOUND, firmware=str(tmp_path / "f.toml"))
    (tmp_path / "g.toml").write_text("periode_s = 1\n")
    with pytest.raises(InputError, match="period_s"):
        find_settings("a.log", FOUND, firmware=str(tmp_path / "g.toml"))
    with pytest.raises(InputError, match=r"none\.toml"):
        find_settings("a.log", FOUND, firmware=str(tmp_path / "none.toml"))

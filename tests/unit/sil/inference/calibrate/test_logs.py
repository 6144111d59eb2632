"""A truck calibrated on the logs of its healthy trips: its gearbox, and what a later diagnosis sees."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from can_dbc.errors import InputError
from plant.parameters import ParameterSet, load
from sil.inference.calibrate.logs import TruckCalibration, calibrate_truck, shifts_figure
from sil.inference.calibrate.output import model_text
from sil.inference.truck.diagnosis import shifts_of_truck
from sil.inference.truck.quantities import quantities
from sil.log_replay.recorded_shifts import RecordedShift
from tests.conftest import run_opc4
from tests.support.truck_logs import drawn_trips, write_trips

SEED = 1


@pytest.fixture(scope="module")
def truck() -> dict[str, float]:
    """The truck's own values, in truth."""
    _, settings = drawn_trips(np.random.default_rng([SEED, 11]), 14)
    return settings


@pytest.fixture(scope="module")
def logs(truck: dict[str, float], tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    trips, _ = drawn_trips(np.random.default_rng([SEED, 21]), 14)
    return write_trips(tmp_path_factory.mktemp("logs"), trips, truck, SEED)


@pytest.fixture(scope="module")
def shifts(logs: list[str]) -> list[RecordedShift]:
    return shifts_of_truck(logs, load("nominal"), (None, None), Counter())[0]


@pytest.fixture(scope="module")
def calibrated(shifts: list[RecordedShift]) -> TruckCalibration:
    return calibrate_truck(shifts, load("nominal"), "trips")


@pytest.fixture(scope="module")
def mine(calibrated: TruckCalibration, tmp_path_factory: pytest.TempPathFactory) -> ParameterSet:
    path = tmp_path_factory.mktemp("calibrated") / "mine.toml"
    path.write_text(model_text(calibrated), encoding="utf-8")
    return load(str(path))


def test_the_intervals_hold_the_truth(
    calibrated: TruckCalibration, truck: dict[str, float]
) -> None:
    true = {path: value for path, value in truck.items() if path != "controller.filter"}
    items = {path: calibrated.values[path] for path in true}
    assert all(item.low is not None and item.high is not None for item in items.values())
    outside = [path for path, item in items.items() if not item.low < true[path] < item.high]
    assert len(items) > 10 and len(outside) <= 1, outside  # of 95 %
    for path, item in items.items():  # within three standard deviations
        assert abs(true[path] - item.value) < 0.75 * (item.high - item.low), path
    mass = calibrated.values["truck.m_gearbox"]
    assert mass.value == pytest.approx(truck["truck.m_gearbox"], rel=0.06)


def test_noise_explains_shifts_that_the_fit_did_not_use(
    calibrated: TruckCalibration, shifts: list[RecordedShift]
) -> None:
    assert calibrated.good and calibrated.content == f"{len(shifts)} shifts"
    held_out = calibrated.channels["position_m"]
    assert 0.05 < held_out.misfit.rms < 1.25
    assert held_out.misfit.count == sum(len(shift.time_s) for shift in shifts)
    assert "mass" not in calibrated.undetermined
    assert len(shifts_figure(calibrated).stacks) == len(shifts)


def test_the_file_stands_alone_and_tightens_a_later_diagnosis(
    calibrated: TruckCalibration, mine: ParameterSet
) -> None:
    assert mine.value("truck.m_gearbox") == calibrated.values["truck.m_gearbox"].value
    before, after = (
        {item.name: item.unit_sd for item in quantities(parameters, False)}
        for parameters in (load("nominal"), mine)
    )
    assert after["mass"] < 0.3 * before["mass"]
    assert after["linkage"] < 0.7 * before["linkage"]
    assert after["supply"] == before["supply"]  # of the day, not of the truck


@pytest.mark.slow
def test_by_the_command(logs: list[str], tmp_path: Path) -> None:
    out = tmp_path / "mine.toml"
    done = run_opc4(tmp_path, "calibrate", *logs, "--out", "mine.toml", "--json")
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    assert result["good"] and set(result["channels"]) == {"position_m"}
    assert result["values"]["truck.m_gearbox"]["low"] > 0.0
    page = out.with_suffix(".html").read_text(encoding="utf-8")
    assert all(Path(log).name in page for log in logs)
    assert load(str(out)).value("truck.m_gearbox") == result["values"]["truck.m_gearbox"]["value"]


def test_too_few_shifts_and_failed_ones_are_refused(shifts: list[RecordedShift]) -> None:
    with pytest.raises(InputError, match=r"few: 3 shifts; expected at least 6"):
        calibrate_truck(shifts[:3], load("nominal"), "few")
    failed = [*shifts[:-1], replace(shifts[-1], failed=True)]
    with pytest.raises(InputError, match=r"bad: 1 shift did not reach the gear"):
        calibrate_truck(failed, load("nominal"), "bad")


@pytest.mark.parametrize(
    ("more", "what"),
    [(["healthy"], "a second campaign"), (["--map", "m.toml"], "not together with a campaign")],
)
def test_campaigns_and_logs_do_not_mix(more: list[str], what: str, tmp_path: Path) -> None:
    (tmp_path / "healthy").mkdir()
    done = run_opc4(tmp_path, "calibrate", "healthy", *more, "--out", "mine.toml")
    assert done.returncode == 2 and what in done.stderr

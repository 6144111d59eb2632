"""Calibration of cylinders of other simulators, with a wrong data sheet."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from plant.batch.prediction import Predictor
from plant.parameters import ParameterSet, load
from sil.campaign.campaign import load_campaign
from sil.cli import main
from sil.inference.calibrate.calibration import StrokeCalibration, calibrate
from sil.inference.calibrate.output import model_text, strokes_figure, write_page
from sil.inference.campaign.checks import observed
from sil.inference.campaign.model import model_of
from sil.inference.spread import Spread
from tests.conftest import ROOT, run_opc4
from tests.support.second_cylinder import drawn, faulty, write_campaign, write_sheet

EXAMPLE = ROOT / "sil" / "examples" / "cylinder"
TRUTH = {
    "cylinder.coulomb": 18.0,
    "cylinder.viscous": 25.0,
    "cylinder.valve_c_in": 4.6e-6 / 502.4,
    "cylinder.dead_volume_1": 6.5e-6,
    "valve.D_rise": 9e-3,
    "valve.D_fall": 30e-3,
}


@pytest.fixture(scope="module")
def calibrated() -> StrokeCalibration:
    return calibrate(load_campaign(EXAMPLE / "healthy"), load(str(EXAMPLE / "data_sheet.toml")))


@pytest.fixture(scope="module")
def mine(calibrated: StrokeCalibration, tmp_path_factory: pytest.TempPathFactory) -> ParameterSet:
    return load_model(calibrated, tmp_path_factory.mktemp("calibrated"))


def load_model(result: StrokeCalibration, folder: Path) -> ParameterSet:
    """Write what was calibrated, and load it."""
    path = folder / "mine.toml"
    path.write_text(model_text(result), encoding="utf-8")
    return load(str(path))


@pytest.mark.slow
def test_values_come_near_the_truth_from_a_wrong_data_sheet(calibrated: StrokeCalibration) -> None:
    for path, true in TRUTH.items():
        assert calibrated.values[path].value == pytest.approx(true, rel=0.06), path
    assert "flow_in" not in calibrated.undetermined


@pytest.mark.slow
def test_what_is_left_of_held_out_strokes_is_in_the_verdict_and_the_file(
    calibrated: StrokeCalibration, mine: ParameterSet
) -> None:
    assert calibrated.good and "wider" in calibrated.headline
    left = calibrated.channels["position_m"]
    assert 1.25 < left.misfit.rms < 1.5 and left.discrepancy > 0.5 * left.noise
    assert mine.value("discrepancy.position_m") == pytest.approx(left.discrepancy)


@pytest.mark.slow
def test_the_file_stands_alone_and_keeps_how_well_each_value_is_known(
    calibrated: StrokeCalibration, mine: ParameterSet
) -> None:
    assert mine.value("cylinder.coulomb") == calibrated.values["cylinder.coulomb"].value
    names = tuple(name for name, *_ in calibrated.changes if f"posterior.{name}" in mine)
    spread = Spread.of(mine)
    assert tuple(spread.unit) == (*names, "supply") and spread.unit["supply"] == 0.01
    covariance = spread.root @ spread.root.T
    for k, (name, _, after, _) in enumerate(calibrated.changes[: len(names)]):
        assert np.sqrt(covariance[k, k]) == pytest.approx(after), name
        rows = calibrated.posterior[f"posterior.{name}"].value
        assert covariance[k, : k + 1] == pytest.approx(rows, rel=1e-6, abs=1e-12)
    assert spread.unit["flow_in"] < 0.1 * Spread.of(calibrated.parameters).unit["flow_in"]


@pytest.mark.slow
def test_the_page_holds_every_stroke(calibrated: StrokeCalibration, tmp_path: Path) -> None:
    figure = strokes_figure(calibrated)
    write_page(calibrated, figure, tmp_path / "mine.html", "opc4 calibrate healthy --out mine.toml")
    page = (tmp_path / "mine.html").read_text(encoding="utf-8")
    assert all(stroke.entry.file in page for stroke in calibrated.model.strokes)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["healthy"], "--out missing: expected the name of a .toml file"),
        (["healthy", "--out", "mine.json"], "--out mine.json: expected the name of a .toml file"),
        (
            ["data_sheet.toml", "--out", "mine.toml"],
            "data_sheet.toml: is a .toml file; expected a campaign folder",
        ),
    ],
)
def test_wrong_arguments_are_one_line(arguments, message, tmp_path) -> None:
    words = [str(EXAMPLE / arguments[0]), *arguments[1:]]
    done = run_opc4(tmp_path, "calibrate", *words)
    assert done.returncode == 2 and message in done.stderr and not list(tmp_path.iterdir())
    assert len(done.stderr.strip().splitlines()) == 1


@pytest.mark.slow
def test_a_leak_is_found_with_the_calibrated_model(
    calibrated: StrokeCalibration, tmp_path: Path
) -> None:
    (tmp_path / "mine.toml").write_text(model_text(calibrated), encoding="utf-8")
    done = run_opc4(
        tmp_path, "diagnose", str(EXAMPLE / "today"), "--model", "mine.toml", "--out", "d"
    )
    assert done.returncode == 1, done.stderr
    first = json.loads((tmp_path / "d" / "diagnosis.json").read_text(encoding="utf-8"))["causes"][0]
    size = first["parameters"]["cda_m2"]
    assert first["id"] == "piston_leak" and size["low"] < 0.06 * 4.6e-6 < size["high"]


@pytest.mark.slow
@pytest.mark.parametrize("seed", [7, 11, 17])
def test_walls_of_one_time_constant_are_fitted_from_a_data_sheet_that_is_a_third_off(
    seed: int, tmp_path: Path
) -> None:
    """Valves of 11 close 17 ms sooner than usual; two strokes of 17 jump with what they depend on."""
    rng = np.random.default_rng(seed)
    unit = drawn(rng)
    healthy = write_campaign(unit, tmp_path / "healthy", rng)
    sheet = write_sheet(unit, tmp_path / "sheet.toml", rng, 0.3)
    result = calibrate(load_campaign(healthy), load(str(sheet)))
    # the position's noise is 1.4 to 1.5 times the usual one
    assert all(channel.misfit.rms < 1.6 for channel in result.channels.values())
    values = {path.partition(".")[2]: item.value for path, item in result.values.items()}
    assert values["wall_ends"] < 0.05 and values["wall_density"] == pytest.approx(1.0, abs=0.03)
    assert values["mass"] == pytest.approx(unit.mass, rel=0.01)
    assert values["kappa"] == pytest.approx(1.4, abs=0.005)
    truth = {"dead_volume_1": unit.dead_1, "dead_volume_2": unit.dead_2, "valve_cda_in": unit.c_in}
    for name, true in truth.items():
        assert values[name] == pytest.approx(true, rel=0.01), name
    Spread.of(load_model(result, tmp_path))


def test_a_number_that_jumps_has_no_slope(monkeypatch: pytest.MonkeyPatch) -> None:
    sheet = load(str(EXAMPLE / "data_sheet.toml"))
    strokes, _findings = observed(load_campaign(EXAMPLE / "healthy"), sheet)
    model = model_of(strokes[:1], Spread.of(sheet))
    shared, scatter = np.zeros(len(model.layout(()).names)), np.zeros(len(model.scatter))
    plain = model.linearise(0, shared, scatter, ())
    moves = Predictor.derivatives

    def jumping(self, setup, moved, steps, columns=None, tolerance=1e-6):  # type: ignore[no-untyped-def]
        states, rates = moves(self, setup, moved, steps, columns, tolerance)
        rates[0][-1] += 0.01 / steps[0]  # m: as if the stroke ended elsewhere
        return states, rates

    monkeypatch.setattr(Predictor, "derivatives", jumping)
    jumped = model.linearise(0, shared, scatter, ())
    (changed,) = np.flatnonzero((jumped.shared != plain.shared).any(axis=0))
    assert plain.shared[:, changed].any() and not jumped.shared[:, changed].any()


@pytest.mark.parametrize("row", ["[2e-4, 1e-4]", "[1e-4]"])
def test_rows_that_are_no_covariance_are_one_line(row: str, tmp_path: Path) -> None:
    rows = f"""
[posterior]
friction = {{ value = [1e-4], unit = "1", source = "covariance with friction" }}
mass = {{ value = {row}, unit = "1", source = "covariance with friction, mass" }}
"""
    sheet = (EXAMPLE / "data_sheet.toml").read_text(encoding="utf-8")
    (tmp_path / "mine.toml").write_text(sheet + rows, encoding="utf-8")
    words = [str(EXAMPLE / "today"), "--model", "mine.toml", "--out", "d", "--quiet"]
    done = run_opc4(tmp_path, "diagnose", *words)
    assert done.returncode == 2 and not (tmp_path / "d").exists()
    assert done.stderr == (
        "opc4 diagnose: mine.toml: posterior: no covariance; expected its rows to the diagonal, "
        "as opc4 calibrate writes them\n"
    )


@pytest.mark.slow
def test_lines_to_the_gauges_that_lag_are_fitted_and_no_later_cause(tmp_path: Path) -> None:
    """Without them the position was off by 25 times its noise."""
    rng = np.random.default_rng(41)
    unit = drawn(rng)
    healthy = write_campaign(unit, tmp_path / "healthy", rng, lag_s=1.2e-3)
    sheet = write_sheet(unit, tmp_path / "sheet.toml", rng, 0.3)
    again = write_campaign(unit, tmp_path / "again", rng, lag_s=1.2e-3)
    model, out = tmp_path / "mine.toml", tmp_path / "out"
    assert main(["calibrate", str(healthy), "--model", str(sheet), "--out", str(model)]) == 0
    assert load(str(model)).value("cylinder.gauge_lag") == pytest.approx(1.2e-3, abs=3e-5)
    assert main(["diagnose", str(again), "--model", str(model), "--out", str(out)]) == 0
    assert json.loads((out / "diagnosis.json").read_text())["verdict"] == "consistent"


@pytest.mark.slow
def test_more_friction_is_named_with_the_calibrated_model(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    unit = drawn(rng)
    healthy = write_campaign(unit, tmp_path / "healthy", rng)
    sheet = write_sheet(unit, tmp_path / "sheet.toml", rng, 0.1)
    worn, factor = faulty(unit, "dynamic_friction", 2.2)
    today = write_campaign(worn, tmp_path / "today", rng)
    model, out = tmp_path / "mine.toml", tmp_path / "out"
    assert main(["calibrate", str(healthy), "--model", str(sheet), "--out", str(model)]) == 0
    assert main(["diagnose", str(today), "--model", str(model), "--out", str(out)]) == 1
    diagnosis = json.loads((out / "diagnosis.json").read_text())
    first = diagnosis["causes"][0]
    size = first["parameters"]["factor"]
    assert diagnosis["verdict"] == "named" and first["id"] == "dynamic_friction"
    assert size["low"] <= factor <= size["high"]
    assert size["value"] == pytest.approx(factor, rel=0.1)

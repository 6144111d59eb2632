"""Campaigns made with hidden effects, spoilt ones, and blindness to them."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from plant.effects import CATALOGUE
from plant.parameters import load
from sil.campaign.campaign import load_campaign
from sil.inference.campaign.diagnosis import diagnose
from tests.hidden_effects import effects
from tests.hidden_effects.campaign import CASES, drawn, hide, write_campaign
from tests.reference.actuator import Case, actuator
from tests.reference.changed import changed
from tests.reference.instruments import control_unit
from tests.reference.parts import nominal

TIME_S = np.arange(0, 1001) * 1e-4
FIXED = Case("fixed", 9e5, ((0.01, "1", 0.98),))


def motion(case: Case, change: dict[str, float]) -> np.ndarray:
    return changed(case, change).solve(TIME_S, rtol=1e-7, max_step=2e-3).states


def test_nothing_hidden_is_the_judge() -> None:
    plain = actuator(FIXED).solve(TIME_S, rtol=1e-7, max_step=2e-3).states
    assert np.abs(motion(FIXED, {}) - plain).max(axis=0) == pytest.approx(0.0, abs=1e-3)


@pytest.mark.parametrize(
    "name",
    [
        "dynamic_friction",
        "seal_pressure_friction",
        "piston_leak",
        "hose_droop",
        "valve_creep",
        "alpha_speed",
        "added_mass",
        "drag of speed squared",
        "inlet by pressure",
        "centring spring",
    ],
)
def test_what_is_hidden_moves_the_stroke(name) -> None:
    change = effects.draw(name, "easy", np.random.default_rng(4))
    difference = motion(FIXED, change)[:, 0] - motion(FIXED, {})[:, 0]
    assert np.abs(difference).max() > 1e-4


def test_draws_are_their_numbers_and_of_every_case() -> None:
    first, second = drawn(17), drawn(17)
    assert first == second
    assert {drawn(k)[0] for k in range(80)} == set(CASES)
    assert {name for k in range(1000) for name in drawn(k)[1].names} >= set(effects.FOREIGN)


def test_a_campaign_repeats_from_its_seed(tmp_path) -> None:
    hidden = hide(("sensor_gain",), "easy", 5)
    one, two = (write_campaign(tmp_path / name / "c", hidden, 5, 2) for name in "ab")
    for file in ("campaign.toml", "stroke_001.csv", "stroke_002.csv"):
        assert (one / file).read_bytes() == (two / file).read_bytes()


def test_the_reported_position_is_late_and_settles() -> None:
    time_s = np.arange(0, 5001) * 1e-4
    true = np.where(time_s > 0.1, 0.0128, 0.0)
    reported = control_unit(time_s, true, 0.003, nominal())
    half = time_s[np.argmax(reported > 0.0064)] - 0.1
    assert 0.025 < half < 0.045
    assert reported[-1] == pytest.approx(0.0128, abs=1e-4)
    warm = control_unit(time_s, true, 0.003, nominal(), warmer_k=20.0)
    assert warm[-1] > reported[-1] + 5e-4


OF_STROKES = {
    "warming friction": "position_m",
    "sticky plunger": "position_m",
    "one late valve": "position_m",
    "emptying tank": "pressure",
    "bent sensor": "position_internal_m",
    "gauge gain": "pressure",
}


@pytest.mark.slow
@pytest.mark.parametrize(("name", "column"), OF_STROKES.items())
def test_what_differs_from_stroke_to_stroke_is_in_the_files(tmp_path, name, column) -> None:
    hidden = hide((name,), "easy", 8)
    clean = write_campaign(tmp_path / "clean", replace(hidden, change={}), 8, 4)
    wrong = write_campaign(tmp_path / "wrong", hidden, 8, 4)
    differ = set()
    for file in sorted(path.name for path in clean.glob("*.csv")):
        with (clean / file).open() as lines:
            columns = lines.readline().strip().split(",")
        one, two = (np.loadtxt(f / file, delimiter=",", skiprows=1) for f in (clean, wrong))
        differ |= {c for k, c in enumerate(columns) if np.abs(two - one)[:, k].max() > 0.0}
    assert any(c.startswith(column) for c in differ)
    if name == "bent sensor":
        assert differ == {"position_internal_m"}
    if name == "gauge gain":
        assert all(c.startswith("pressure") for c in differ)


Table = dict[str, np.ndarray]


def gauges(table: Table) -> list[str]:
    return [name for name in table if name.startswith("pressure_") and "oil" not in name]


def swapped(table: Table) -> None:
    one, two = gauges(table)[:2]
    table[one], table[two] = table[two], table[one]


def shifted(table: Table) -> None:
    for name, values in table.items():
        if name != "time_s" and not name.startswith("cmd_"):
            table[name] = np.concatenate([np.full(80, values[0]), values[:-80]])


def saturated(table: Table) -> None:
    for name in gauges(table):
        table[name] = np.minimum(table[name], 450000.0)


def without_gauges(table: Table) -> None:
    for name in [*gauges(table), "pressure_oil2_pa", "position_internal_m"]:
        table.pop(name, None)


def spoil(folder: Path, change: Callable[[Table], None]) -> Path:
    for path in sorted(folder.glob("stroke_*.csv")):
        header = path.read_text(encoding="ascii").splitlines()[0].split(",")
        rows = np.loadtxt(path, delimiter=",", skiprows=1)
        table = {name: rows[:, k] for k, name in enumerate(header)}
        change(table)
        text = ",".join(table)
        np.savetxt(
            path, np.column_stack(list(table.values())), "%.6f", ",", header=text, comments=""
        )
    return folder


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (swapped, "channels are swapped"),
        pytest.param(saturated, "saturated at 450000 Pa", marks=pytest.mark.slow),
    ],
)
def test_spoilt_records_are_found_and_are_no_cause(tmp_path, change, expected) -> None:
    folder = spoil(write_campaign(tmp_path / "c", hide((), "easy", 61), 61, 4), change)
    found = diagnose(load_campaign(folder), load(), workers=1)
    texts = [str(item) for item in found.findings]
    for number in range(1, 5):
        assert any(f"stroke_{number:03d}.csv" in text and expected in text for text in texts), texts
    assert found.verdict.kind == "consistent", [c.evidence for c in found.causes]


def test_with_the_position_alone_nothing_is_claimed(tmp_path) -> None:
    folder = spoil(write_campaign(tmp_path / "c", hide((), "easy", 62), 62, 3), without_gauges)
    found = diagnose(load_campaign(folder), load(), workers=1)
    assert found.verdict.kind == "consistent"


@pytest.mark.slow
def test_a_shift_of_all_records_is_a_cause_not_taken_off(tmp_path) -> None:
    folder = spoil(write_campaign(tmp_path / "c", hide((), "easy", 61), 61, 4), shifted)
    found = diagnose(load_campaign(folder), load(), workers=1)
    assert found.verdict.kind != "consistent"
    assert not any("taken off" in str(item) for item in found.findings)


STORED = Path(__file__).resolve().parents[1] / "data" / "blind"


def test_there_are_twelve() -> None:
    assert sorted(p.name for p in STORED.iterdir()) == [f"blind_{k:02d}" for k in range(1, 13)]


@pytest.mark.parametrize("number", range(1, 13))
def test_a_stored_diagnosis_is_in_the_format(number: int) -> None:
    name = f"blind_{number:02d}"
    diagnosis = json.loads((STORED / name / "diagnosis.json").read_text(encoding="utf-8"))
    assert diagnosis["format"] == 1 and diagnosis["campaign"] == name
    assert diagnosis["verdict"] in ("consistent", "named", "ambiguous", "unnamed")
    assert bool(diagnosis["causes"]) == (diagnosis["verdict"] != "consistent")
    assert (diagnosis["extended_model"] is None) == (not diagnosis["causes"])
    order = [cause["probability"] for cause in diagnosis["causes"]]
    assert order == sorted(order, reverse=True) and all(0.0 < p <= 1.0 for p in order)
    for cause in diagnosis["causes"]:
        assert cause["id"] in CATALOGUE
        for item in cause["parameters"].values():
            assert item["low"] <= item["value"] <= item["high"]
    standard = diagnosis["gain"]["standardised"]
    assert standard["after"] <= standard["before"] and standard["after"] < 1.1

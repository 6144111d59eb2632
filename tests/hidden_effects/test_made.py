"""The makers of hidden effects: nothing hidden is the judge itself, everything hidden shows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.hidden_effects import effects
from tests.hidden_effects.campaign import hide, write_campaign
from tests.hidden_effects.draws import CASES, drawn
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

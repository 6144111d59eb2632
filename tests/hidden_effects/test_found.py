"""Effects hidden by another implementation are found, clean campaigns are left alone.

The full study: python -m tests.bench hidden_effects.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from plant.parameters import load
from sil.campaign.campaign import load_campaign
from sil.inference.campaign.diagnosis import diagnose
from tests.hidden_effects.campaign import hide, write_campaign
from tests.hidden_effects.draws import drawn
from tests.support.hidden_study import STROKES, Row, row_of


def diagnosed(folder: Path, names: tuple[str, ...], seed: int, strokes: int, level="easy") -> Row:
    hidden = hide(names, level, seed)
    written = write_campaign(folder / f"campaign_{seed}", hidden, seed, strokes)
    found = diagnose(load_campaign(written), load(), workers=1)
    return row_of(seed, "one" if names else "none", hidden, found.as_json(), 0.0)


@pytest.mark.parametrize("seed", [31, 32])
def test_a_clean_campaign_is_left_alone(tmp_path, seed) -> None:
    assert diagnosed(tmp_path, (), seed, 5).verdict == "consistent"


def test_a_sensor_error_is_named_and_another_answer_would_be_wrong(tmp_path) -> None:
    row = diagnosed(tmp_path, ("sensor_gain",), 33, 5, "medium")
    assert row.verdict == "named" and row.right_first == 1.0
    assert row.on_truth > 0.8 and row.after < 1.1
    shuffled = replace(row, names=("exhaust_clog",))
    assert shuffled.right_first == 0.0 and shuffled.on_truth == 0.0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "seed"),
    [("exhaust_clog", 41), ("external_force", 42), ("valve_open_delay", 43)],
)
def test_a_hidden_effect_is_named(tmp_path, name, seed) -> None:
    row = diagnosed(tmp_path, (name,), seed, 6)
    assert row.right_first == 1.0, row
    assert row.on_truth > 0.8 and row.after < 1.1


@pytest.mark.slow
def test_a_drag_that_no_cause_describes_gets_no_wrong_name(tmp_path) -> None:
    row = diagnosed(tmp_path, ("drag of speed squared",), 51, 6)
    assert row.verdict != "consistent"
    assert row.wrong_name <= 0.5, row


def judged(folder: Path, number: int) -> Row:
    """A campaign of the study."""
    case, hidden = drawn(number)
    written = write_campaign(folder / "campaign", hidden, number, STROKES)
    found = diagnose(load_campaign(written), load(), workers=1).as_json()
    return row_of(number, case, hidden, found, 0.0)


@pytest.mark.slow
def test_a_delay_next_to_a_large_volume_is_not_taken_for_another_one(tmp_path) -> None:
    row = judged(tmp_path, 3105)
    assert row.names == ("valve_open_delay", "dead_volume_charge")
    assert row.on_truth > 0.9 and row.wrong_name < 0.1, row


@pytest.mark.slow
def test_a_bent_sensor_is_not_taken_for_its_gain(tmp_path) -> None:
    row = judged(tmp_path, 3085)
    assert row.names == ("bent sensor",) and row.verdict == "unnamed"
    assert row.found[0][1] == "internal sensor" and row.wrong_name < 0.5, row

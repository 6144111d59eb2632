"""The stored diagnoses of campaigns whose answers are not known here: whole, and in the format."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from plant.effects import CATALOGUE

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

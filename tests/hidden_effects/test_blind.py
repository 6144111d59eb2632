"""The diagnoses kept of campaigns whose answers are not known here: whole, and in the format."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from plant.effects import CATALOGUE

KEPT = Path(__file__).resolve().parents[1] / "data" / "blind"


def test_there_are_twelve() -> None:
    assert sorted(p.name for p in KEPT.iterdir()) == [f"blind_{k:02d}" for k in range(1, 13)]


@pytest.mark.parametrize("number", range(1, 13))
def test_a_kept_diagnosis_is_in_the_format(number: int) -> None:
    name = f"blind_{number:02d}"
    told = json.loads((KEPT / name / "diagnosis.json").read_text(encoding="utf-8"))
    assert told["format"] == 1 and told["campaign"] == name
    assert told["verdict"] in ("consistent", "named", "ambiguous", "unnamed")
    assert bool(told["causes"]) == (told["verdict"] != "consistent")
    assert (told["extended_model"] is None) == (not told["causes"])
    order = [cause["probability"] for cause in told["causes"]]
    assert order == sorted(order, reverse=True) and all(0.0 < p <= 1.0 for p in order)
    for cause in told["causes"]:
        assert cause["id"] in CATALOGUE
        for item in cause["parameters"].values():
            assert item["low"] <= item["value"] <= item["high"]
    standard = told["gain"]["standardised"]
    assert standard["after"] <= standard["before"] and standard["after"] < 1.1

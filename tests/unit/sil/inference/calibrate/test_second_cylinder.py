"""A drawn cylinder by a simulator that shares no equation with the plant: calibrated, then diagnosed."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from sil.cli import main
from tests.support.second_cylinder import drawn, faulty, write_campaign, write_sheet


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

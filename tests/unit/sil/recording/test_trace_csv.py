"""trace.csv."""

from __future__ import annotations

import csv
import math
from pathlib import Path

import numpy as np
import pytest

from sil.recording.trace_csv import TraceCsv, held
from tests.support import made_run


def test_held_values() -> None:
    at = np.array([0.0, 1.0, 1.5, 2.0, 3.0])
    values = held(np.array([1.0, 2.0]), np.array([10.0, 20.0]), at)
    assert math.isnan(values[0]) and values[1:].tolist() == [10.0, 10.0, 20.0, 20.0]


def test_trace_csv_begins_like_a_measured_stroke_and_keeps_every_bit(tmp_path: Path) -> None:
    record = made_run.made()
    truth = record.truth
    with (tmp_path / "trace.csv").open("wb") as file:
        TraceCsv(file).add(record)
    rows = list(csv.DictReader((tmp_path / "trace.csv").read_text().splitlines()))
    assert list(rows[0])[:9] == [
        "time_s",
        "position_m",
        "pressure_B_pa",
        "pressure_N_pa",
        "pressure_F_pa",
        "cmd_B",
        "cmd_N",
        "cmd_F",
        "position_internal_m",
    ]
    assert [float(r["position_m"]) for r in rows] == truth["position_m"].tolist()
    assert rows[0]["position_internal_m"] == ""  # before the first status frame
    assert float(rows[-1]["position_internal_m"]) == pytest.approx(made_run.STROKE, abs=1e-7)

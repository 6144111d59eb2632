"""Weighing of assumptions: designs, indices of a function with known ones, one row, one turn of a sign."""

from __future__ import annotations

import math
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from can_dbc.errors import InputError
from sil.cli import main
from sil.studies.kinds.sensitivity import HEADLINES, holds, total_indices
from sil.studies.load_study import load_study
from sil.studies.rows import run_row
from sil.studies.study import Design, Row, Sweep, inside, radial_points
from sil.studies.summary import quantiles, share_interval


def test_a_radial_design_changes_one_value_at_a_time() -> None:
    points = radial_points(4, Design(kind="radial", samples=8, seed=3)).reshape(8, 5, 4)
    for block in points:
        assert [np.flatnonzero(row != block[0]).tolist() for row in block[1:]] == [
            [k] for k in range(4)
        ]


def test_total_indices_of_the_ishigami_function() -> None:
    """Known: 0.558, 0.442, 0.244; the first and third act together."""
    points = 2.0 * math.pi * radial_points(3, Design(kind="radial", samples=8192)) - math.pi
    x, y, z = points.T
    value = np.sin(x) + 7.0 * np.sin(y) ** 2 + 0.1 * z**4 * np.sin(x)
    found = total_indices(value, 3)
    for (index, low, high), known in zip(found, (0.558, 0.442, 0.244), strict=True):
        assert low <= index <= high and abs(index - known) < 0.05
        assert high - low < 0.2
    assert total_indices(x, 3)[1:, 0].tolist() == [0.0, 0.0]


def test_where_a_headline_holds() -> None:
    x = np.array([3.0, 1.0, 2.0, 4.0])
    assert holds(x, np.ones(4)) == "always"
    assert holds(x, -np.ones(4)) == "never"
    assert holds(x, np.array([-1.0, 1.0, 1.0, 1.0])) == "1 to 2, 4"


def test_one_at_a_time_begins_with_the_model_as_it_is() -> None:
    study = load_study("sensitivity")
    first, *others = study.rows()
    assert all(sweep.values and first.settings[sweep.path] == sweep.values[0] for sweep in study.study.sweep)  # fmt: skip
    for row in others:
        changed = [path for path, value in row.settings.items() if value != first.settings[path]]
        assert len(changed) == 1
    assert load_study("sensitivity_global").size == 40 * 10


def test_a_heavy_gearbox_turns_a_headline() -> None:
    """With 120 kg a stroke lasts longer than 48 ms after its release, or nearly."""
    study = load_study("sensitivity")
    nominal, heavy = (
        run_row(study, Row(0, (), {"truck.m_gearbox": mass})).figures for mass in (9.0, 160.0)
    )
    assert set(HEADLINES) < set(nominal)
    assert nominal["late_s"] > 0.02 > 0.0 > heavy["late_s"]
    assert nominal["damper_m_s"] > 0.7 > 0.3 > heavy["damper_m_s"]
    assert nominal["cushion_m_s"] == heavy["cushion_m_s"]
    with pytest.raises(InputError, match=r"factor\.frictions: unknown; expected one of"):
        run_row(study, Row(0, (), {"factor.frictions": 2.0}))


def test_a_normal_range_has_its_quantiles() -> None:
    sweep = Sweep(path="x", low=1.0, high=3.0, scale="normal")
    for share, value in ((0.025, 1.0), (0.5, 2.0), (0.975, 3.0)):
        assert inside(sweep, share) == pytest.approx(value)


def test_intervals_of_shares_and_quantiles() -> None:
    assert share_interval(0, 200) == pytest.approx([0.0, 0.0188], abs=1e-3)
    low, high = share_interval(50, 100)
    assert low == pytest.approx(0.404, abs=1e-3) and high == pytest.approx(0.596, abs=1e-3)
    found = quantiles(np.append(np.arange(1001.0), np.nan))
    for name, middle in (("p5", 50.0), ("p50", 500.0), ("p95", 950.0)):
        value, low, high = found[name]
        assert value == pytest.approx(middle) and low < value < high < value + 40.0
    assert quantiles(np.array([np.nan])) == {}
    covered = 0
    rng = np.random.default_rng(0)
    for _ in range(300):
        _, low, high = quantiles(rng.normal(size=200))["p95"]
        covered += low <= 1.6449 <= high
    assert 0.90 <= covered / 300 <= 0.99


def test_a_normal_range_in_a_grid_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "s.toml"
    file.write_text(
        'name = "s"\nscenario = "lab_n_b"\n[[sweep]]\npath = "valve.D_rise"\n'
        'low = 0.007\nhigh = 0.009\nsteps = 3\nscale = "normal"\n'
    )
    assert main(["whatif", str(file), "--out", str(tmp_path / "o")]) == 2
    assert "a normal range needs a design that draws" in capsys.readouterr().err


def test_the_indices_of_a_study_are_drawn_and_its_rows_sum_up(tmp_path: Path) -> None:
    file = tmp_path / "s.toml"
    file.write_text(
        'name = "s"\nscenario = "lab_n_b"\nreads = ["impact_worst_m_s"]\n'
        '[design]\nkind = "lhs"\nsamples = 6\n[[sweep]]\npath = "valve.D_rise"\n'
        'low = 0.007\nhigh = 0.009\nscale = "normal"\n'
        '[[load]]\nname = "lab"\nset = { duration_s = 0.4 }\n'
    )
    assert main(["whatif", str(file), "--out", str(tmp_path / "o"), "--quiet"]) == 0
    text = (tmp_path / "o" / "summary.json").read_text()
    assert '"p95"' in text and '"failed_interval"' in text
    assert all(a <= b for a, b in pairwise(share_interval(3, 6)))

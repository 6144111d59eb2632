"""A campaign drafted from files of a laboratory, then diagnosed as it is."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from sil.cli import main
from sil.diagnosis.new_campaign import guess, unit_of


@pytest.mark.parametrize(
    ("name", "unit"),
    [("x [mm]", "mm"), ("Kraft (kN)", "kN"), ("p1 / bar", "bar"), ("t_ms", "ms"), ("load", "")],
)
def test_units_are_found_in_names(name: str, unit: str) -> None:
    assert unit_of(name) == unit


def test_time_is_what_increases() -> None:
    columns = {"a [s]": np.zeros(3), "b [s]": np.arange(3.0), "Weg": np.ones(3)}
    assert guess(columns) == {"time_s": ("b [s]", 1.0, True), "position_m": ("Weg", 1.0, False)}


def test_a_draft_is_diagnosed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rng = np.random.default_rng(1)
    t = np.arange(8000) / 500.0
    x = 0.1 * np.sin(2.1 * t) + 0.04 * np.sin(5.7 * t)
    v = 0.21 * np.cos(2.1 * t) + 0.228 * np.cos(5.7 * t)
    a = -0.441 * np.sin(2.1 * t) - 1.2996 * np.sin(5.7 * t)
    f = 20.0 * a + 15.0 * np.sign(v) + 80.0 * v + rng.normal(0.0, 1.0, len(t))
    table = np.column_stack([1e3 * t, 1e3 * x + rng.normal(0.0, 1e-3, len(t)), 1e-3 * f])
    rows = ["; ".join(f"{value:.7f}".replace(".", ",") for value in row) for row in table]
    file = tmp_path / "bench.csv"
    file.write_text(
        "Zeit [ms];Weg [mm];Kraft [kN]\n" + "\n".join(rows) + "\n", encoding="utf-8-sig"
    )
    new = tmp_path / "new"
    assert main(["diagnose", "--new", str(new), str(file)]) == 0
    assert "push towards increasing position" in capsys.readouterr().out
    assert {"campaign.toml", "channels.png", "bench.csv"} <= {p.name for p in new.iterdir()}
    assert main(["diagnose", str(new), "--out", str(tmp_path / "out"), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["verdict"] == "consistent"
    assert "semicolon-separated, decimal comma, UTF-8 with byte order mark" in found["findings"][0]
    assert found["body"]["mass_kg"]["value"] == pytest.approx(20.0, rel=0.02)


def test_files_that_differ_and_several_campaigns_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in "ab":
        np.savetxt(
            tmp_path / f"{name}.csv",
            np.eye(9),
            header=",".join(f"{name}{k}" for k in range(9)),
            comments="",
            delimiter=",",
        )
    files = [str(tmp_path / "a.csv"), str(tmp_path / "b.csv")]
    assert main(["diagnose", "--new", str(tmp_path / "c"), *files]) == 2
    assert "other columns than" in capsys.readouterr().err
    assert main(["diagnose", str(tmp_path), str(tmp_path)]) == 2
    assert "several campaigns" in capsys.readouterr().err

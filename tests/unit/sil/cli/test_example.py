"""The shipped examples: listed, copied, and each does what its README says."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path

import pytest

import sil
from sil.cli import main
from tests.conftest import ROOT

EXAMPLES = Path(sil.__file__).parent / "examples"


@pytest.fixture
def copied(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> Path:
    """A folder that holds the example and nothing else, as the working folder."""
    assert main(["example", request.param, "--out", str(tmp_path)]) == 0
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_they_are_listed_copied_once_and_in_the_package(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["example"]) == 0
    lines = capsys.readouterr().out.splitlines()
    names = {path.name for path in EXAMPLES.iterdir() if path.is_dir()}
    listed = {line.split()[0] for line in lines}
    assert listed == names >= {"truck", "logger", "firmware", "scenario"}
    out = tmp_path / "mine"
    assert main(["example", "truck", "--out", str(out), "--json"]) == 0
    files = json.loads(capsys.readouterr().out)["files"]
    assert sorted(path.name for path in out.iterdir()) == files
    assert main(["example", "truck", "--out", str(out)]) == 2
    assert "exists; expected a new folder, or --force" in capsys.readouterr().err
    assert main(["example", "lorry"]) == 2
    data = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    assert "examples/*/*" in data["tool"]["setuptools"]["package-data"]["*"]


@pytest.mark.parametrize("copied", ["scenario"], indirect=True)
def test_the_scenario_passes(copied: Path) -> None:
    assert main(["run", "low_supply.toml", "--out", "low", "--no-report"]) == 0


@pytest.mark.parametrize("copied", ["firmware"], indirect=True)
def test_the_firmware_closes_the_valve_early(copied: Path) -> None:
    words = ["run", "lab_n_b", "--firmware", "short_push.py:ShortPush", "--out", "short"]
    assert main([*words, "--no-report"]) in (0, 1)
    result = json.loads((copied / "short" / "result.json").read_text(encoding="utf-8"))
    assert result["metrics"]["valve_switchings"] == 4


@pytest.mark.parametrize("copied", ["truck"], indirect=True)
def test_the_trucks_log_has_three_shifts(copied: Path) -> None:
    assert main(["replay", "truck.asc", "--summary", "--out", "day"]) == 0
    summary = json.loads((copied / "day" / "summary.json").read_text(encoding="utf-8"))
    assert len(summary["shifts"]) == 3


@pytest.mark.slow
@pytest.mark.parametrize("copied", ["logger"], indirect=True)
def test_the_loggers_files_are_diagnosed(copied: Path) -> None:
    files = sorted(map(str, copied.glob("Messung_*.csv")))
    assert main(["diagnose", "--new", "bench", "--rig", "actuator", *files]) == 0
    draft = copied / "bench" / "campaign.toml"
    text = draft.read_text(encoding="utf-8").replace('pressures = "?"', 'pressures = "gauge"')
    for regulator_pa in (8e5, 8e5, 6.5e5, 6.5e5, 5e5, 5e5):
        text = text.replace('supply_pressure_pa = "?"', f"supply_pressure_pa = {regulator_pa}", 1)
    draft.write_text(text, encoding="utf-8")
    assert main(["diagnose", "bench", "--out", "diagnosis"]) == 1
    result = json.loads((copied / "diagnosis" / "diagnosis.json").read_text(encoding="utf-8"))
    assert result["verdict"] == "named" and result["causes"][0]["id"] == "valve_open_delay"


@pytest.mark.slow
@pytest.mark.parametrize("copied", ["truck"], indirect=True)
def test_the_trucks_log_is_what_its_readme_makes(copied: Path) -> None:
    assert main(["run", "three_shifts.toml", "--out", "three", "--no-report"]) == 0
    ids = "0CF00203,18F00503,0CF00400,18FEAE30,18FECA03"
    assert main(["convert", "three/bus.log", "again.asc", "--id", ids]) == 0
    assert (copied / "again.asc").read_bytes() == (copied / "truck.asc").read_bytes()

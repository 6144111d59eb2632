"""The plugin as a user's project meets it: a pytest of its own, in a folder of its own."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from sil import pytest_plugin
from sil.simulation.load_scenario import shipped
from tests.conftest import ROOT

FIXTURE_TEST = """
def test_filter(opc4_run):
    slow = opc4_run("lab_n_b")
    fast = opc4_run("lab_n_b", "controller.filter=false")
    assert slow.passed
    lag = lambda run: run.shifts[0].position_lag_90_s
    assert lag(slow) > lag(fast) + 0.02
"""


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """A user's project with a scenario that passes and one that does not."""
    (tmp_path / "pytest.ini").write_text("[pytest]\nopc4_scenarios = scenarios/*.toml\n")
    (tmp_path / "scenarios").mkdir()
    good = tmp_path / "scenarios" / "good.toml"
    shutil.copy(shipped()["lab_n_b"], good)
    text = good.read_text().replace('final_gear = "backward"', 'final_gear = "forward"')
    (tmp_path / "scenarios" / "bad.toml").write_text(text)
    (tmp_path / "scenarios" / "broken.toml").write_text("name = 3\n")
    (tmp_path / "other.toml").write_text("[tool]\nx = 1\n")
    (tmp_path / "test_filter.py").write_text(FIXTURE_TEST)
    return tmp_path


def run(folder: Path, *arguments: str) -> tuple[int, str]:
    """Exit code and output of pytest in a folder, with the plugin."""
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", *PLUGIN, *arguments],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    return done.returncode, done.stdout + done.stderr


def _plugin() -> list[str]:
    """Nothing where the plugin is installed, else its name."""
    from importlib.metadata import entry_points

    known = [e.value for e in entry_points(group="pytest11") if e.name == "opc4"]
    return [] if known else ["-p", "sil.pytest_plugin"]


PLUGIN = _plugin()


def test_scenarios_and_the_fixture_are_tests(project: Path) -> None:
    code, output = run(project)
    assert code == 1 and "2 failed, 2 passed" in output
    assert "final gear: backward, expected forward" in output
    assert "broken.toml: name: 3 is wrong" in output or "broken.toml: name" in output
    assert "Traceback" not in output


def test_the_runs_are_kept(project: Path) -> None:
    code, output = run(project, "--opc4-out", "kept", "scenarios/good.toml")
    assert code == 0 and "1 passed" in output
    kept = {path.name for path in (project / "kept" / "scenarios" / "good").iterdir()}
    assert {"result.json", "bus.log", "trace.csv", "shift.png", "report.html"} <= kept


def test_nothing_is_collected_without_the_configuration(project: Path) -> None:
    (project / "pytest.ini").write_text("[pytest]\n")
    code, output = run(project, "scenarios")
    assert code == 5 and "no tests ran" in output


@pytest.mark.parametrize(
    ("patterns", "collected"),
    [
        ("scenarios/*.toml", ["scenarios/a.toml"]),
        ("*.toml", ["top.toml"]),
        ("scenarios/**/*.toml", ["scenarios/a.toml", "scenarios/deep/a.toml"]),
        ("**/a.toml", ["scenarios/a.toml", "scenarios/deep/a.toml"]),
        ("top.toml\n  scenarios/deep/*.toml", ["scenarios/deep/a.toml", "top.toml"]),
    ],
)
def test_a_pattern_names_files_from_the_root(
    tmp_path: Path, patterns: str, collected: list[str]
) -> None:
    (tmp_path / "scenarios" / "deep").mkdir(parents=True)
    for name in ("pyproject.toml", "top.toml", "scenarios/a.toml", "scenarios/deep/a.toml"):
        (tmp_path / name).touch()
    assert files_of(tmp_path, patterns) == {tmp_path / name for name in collected}


def files_of(root: Path, patterns: str) -> set[Path]:
    lines = [line.strip() for line in patterns.split("\n")]
    config: Any = SimpleNamespace(rootpath=root, getini=lambda name: lines, stash={})
    pytest_plugin.pytest_configure(config)
    files: set[Path] = config.stash[pytest_plugin.FILES]
    return files


@pytest.mark.parametrize("pattern", ["scenaros/*.toml", "/abs/*.toml"])
def test_a_pattern_that_matches_nothing_is_refused(tmp_path: Path, pattern: str) -> None:
    with pytest.raises(pytest.UsageError, match=f"opc4_scenarios: {re.escape(pattern)}: "):
        files_of(tmp_path, pattern)


def test_scenarios_of_one_name_are_kept_apart(project: Path) -> None:
    (project / "pytest.ini").write_text("[pytest]\nopc4_scenarios = s/**/good.toml\n")
    for folder in ("s/one", "s/two"):
        (project / folder).mkdir(parents=True)
        shutil.copy(project / "scenarios" / "good.toml", project / folder)
    code, output = run(project, "--opc4-out", "kept", "s")
    assert code == 0 and "2 passed" in output
    assert len(list((project / "kept").glob("s/*/good/result.json"))) == 2

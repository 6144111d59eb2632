"""The README's claims: its scenario runs, its commands exist, what it prints is what is printed."""

from __future__ import annotations

import re
import subprocess
import tomllib
from collections.abc import Callable
from pathlib import Path

import pytest

from sil import cli
from sil.simulation import runner, scenario
from tests.conftest import ROOT

README = (ROOT / "README.md").read_text(encoding="utf-8")
Run = Callable[..., subprocess.CompletedProcess[str]]


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", README, flags=re.DOTALL)


def test_the_scenario_in_the_readme_runs_and_passes(tmp_path: Path) -> None:
    (text,) = blocks("toml")
    finished = runner.run(scenario.from_table(tomllib.loads(text), "README"), tmp_path)
    assert finished.result.passed


def test_commands_in_the_readme_are_those_that_exist() -> None:
    table = README[README.index("## Commands") : README.index("## A scenario")]
    assert set(re.findall(r"^\| `opc4 (\w+)", table, flags=re.MULTILINE)) == set(cli.COMMANDS)


@pytest.mark.slow
@pytest.mark.parametrize(
    "line", [ln for b in blocks("sh") for ln in b.splitlines() if ln.startswith("opc4 run ")]
)
def test_runs_in_the_readme_pass_or_say_why_not(line: str, tmp_path: Path) -> None:
    """A changed delay may break an expectation of the scenario: exit 1 then, never an error."""
    words = line.split("#")[0].split()
    settings = [words[i + 1] for i, word in enumerate(words) if word == "--set"]
    finished = runner.run(scenario.load(words[2], settings=settings), tmp_path)
    assert finished.result.complete
    told = re.search(r"# (\d+) ms", line)
    if told is not None:
        lag_s = finished.result.metrics["position_lag_10_s"]
        assert 1e3 * lag_s == pytest.approx(float(told[1]), abs=0.6)


def test_what_a_run_prints_is_what_the_readme_shows(opc4: Run) -> None:
    (shown,) = blocks("text")
    command, *lines = shown.splitlines()
    arguments = command.removeprefix("$ opc4 ").split()
    assert opc4(*arguments).stdout.splitlines() == lines


def test_every_path_of_the_map_exists() -> None:
    table = README[README.index("## Map") :]
    paths = re.findall(r"`([\w./]+)`", table)
    assert len(paths) > 20
    for path in paths:
        places = [ROOT / path, ROOT / "sil" / path, *(ROOT / p / path for p in ("plant", "tests"))]
        places += [ROOT / "can_dbc" / path, ROOT / "controller" / path]
        assert any(p.exists() for p in places), path


def test_the_python_in_the_readme_prints_what_it_says(capsys: pytest.CaptureFixture[str]) -> None:
    (text,) = blocks("python")
    exec(compile(text, "README", "exec"), {})
    (told,) = re.findall(r"# ([0-9.]+)$", text, flags=re.MULTILINE)
    assert f"{float(capsys.readouterr().out):.3f}" == told

"""The command: starts fast, says what it can, and never shows a traceback."""

from __future__ import annotations

import importlib
import json
import subprocess
import sys
from collections.abc import Callable

import pytest

from sil import cli

Run = Callable[..., subprocess.CompletedProcess[str]]

HEAVY = (
    *("numpy", "numba", "scipy", "can", "cantools", "matplotlib", "jinja2", "msgspec", "e2e"),
    *("plant", "controller", "can_dbc.codec", "sil.simulation.scenario", "sil.simulation.runner"),
)


def test_help_lists_every_command_and_imports_nothing_heavy() -> None:
    program = (
        "import sys; from sil.cli import main; code = main(['--help']);"
        f"print([m for m in {HEAVY!r} if m in sys.modules], code)"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=60
    )
    assert done.stdout.endswith("[] 0\n")
    for name, summary in cli.COMMANDS.items():
        assert f"  {name:<10} {summary}\n" in done.stdout


@pytest.mark.parametrize("name", sorted(cli.COMMANDS))
def test_every_command_has_help_with_an_example(
    name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main([name, "--help"]) == 0
    told = capsys.readouterr().out
    assert f"opc4 {name} " in told[told.index("example:") :]
    assert importlib.import_module(f"sil.cli.{name}").__doc__


def test_no_command_and_unknown_command_are_bad_usage(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([]) == 2
    assert cli.main(["rnu"]) == 2
    assert "nearest: run" in capsys.readouterr().err


def test_bad_usage_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["run"]) == 2
    assert cli.main(["run", "lab_n_b", "--forc"]) == 2
    told = capsys.readouterr().err.splitlines()
    assert len(told) == 2 and "opc4 run --list" in told[0] and "--help" in told[1]


def test_a_place_for_junit_that_does_not_exist_is_bad_input(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert cli.main(["run", "lab_n_b", "--junit", "no/such/folder/junit.xml"]) == 2
    assert "--junit: no such folder" in capsys.readouterr().err


def test_bad_input_is_exit_2_and_one_json_object(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["run", "no_such_scenario", "--json"]) == 2
    told = capsys.readouterr()
    assert json.loads(told.out)["exit_code"] == 2
    assert told.err.count("\n") == 1 and "no_such_scenario" in told.err

"""The command: starts fast, says what it can, and never shows a traceback."""

from __future__ import annotations

import importlib
import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from sil import cli

Run = Callable[..., subprocess.CompletedProcess[str]]

HEAVY = (
    *("numpy", "numba", "scipy", "can", "cantools", "matplotlib", "jinja2", "msgspec", "e2e"),
    *(
        "plant",
        "controller",
        "can_dbc.codec",
        "sil.simulation.load_scenario",
        "sil.simulation.runner",
    ),
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


def test_a_run_in_one_process_imports_no_library_of_buses_and_logs() -> None:
    program = "import sys, sil.simulation.runner as r; print({'can', 'asammdf', 'pandas'} & set(sys.modules))"
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=60
    )
    assert done.stdout == "set()\n"


@pytest.mark.parametrize("name", sorted(cli.COMMANDS))
def test_every_command_has_help_with_an_example(
    name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main([name, "--help"]) == 0
    output = capsys.readouterr().out
    assert f"opc4 {name} " in output[output.index("example:") :]
    assert importlib.import_module(f"sil.cli.{name}").__doc__


def test_no_command_and_unknown_command_are_bad_usage(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([]) == 2
    assert cli.main(["rnu"]) == 2
    assert "expected one of run" in capsys.readouterr().err


def test_bad_usage_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["run"]) == 2
    assert cli.main(["run", "lab_n_b", "--forc"]) == 2
    output = capsys.readouterr().err.splitlines()
    assert len(output) == 2 and "opc4 run --list" in output[0] and "--help" in output[1]
    assert cli.main(["fmu", "plnt", "a.fmu"]) == 2
    found = "opc4 fmu: argument what: 'plnt'; expected 'plant', 'controller'; see opc4 fmu --help\n"
    assert capsys.readouterr().err == found


@pytest.mark.parametrize("words", [["run", "lab_n_b", "--forc"], ["diagnose"], ["rnu"], []])
def test_bad_usage_is_one_json_object(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([*words, "--json"]) == 2
    output = capsys.readouterr()
    found = json.loads(output.out)
    assert found["exit_code"] == 2 and output.err.endswith(f": {found['error']}\n")


def test_a_place_for_junit_that_does_not_exist_is_bad_input(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert cli.main(["run", "lab_n_b", "--junit", "no/such/folder/junit.xml"]) == 2
    assert "--junit: no such folder" in capsys.readouterr().err


def test_an_empty_argument_and_a_folder_for_junit_are_bad_input(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["run", "lab_n_b", "--out", ""]) == 2
    assert capsys.readouterr().err == "opc4: an empty argument; expected none\n"
    assert cli.main(["run", "lab_n_b", "--out", "", "--json"]) == 2
    found = json.loads(capsys.readouterr().out)
    assert found == {"error": "an empty argument; expected none", "exit_code": 2}
    assert cli.main(["run", "lab_n_b", "--junit", str(tmp_path)]) == 2
    assert "--junit: is a folder; expected a file" in capsys.readouterr().err


def test_bad_input_is_exit_2_and_one_json_object(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["run", "no_such_scenario", "--json"]) == 2
    output = capsys.readouterr()
    assert json.loads(output.out)["exit_code"] == 2
    assert output.err.count("\n") == 1 and "no_such_scenario" in output.err


def shell(line: str, **environment: str) -> subprocess.CompletedProcess[str]:
    opc4 = f"{sys.executable} -c 'from sil.cli import command; command()'"
    return subprocess.run(
        ["bash", "-c", line.replace("opc4", opc4)],
        env=os.environ | environment,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


@pytest.mark.parametrize(
    ("line", "code", "error"),
    [
        ("opc4 run --list >&-", 0, ""),
        ("opc4 --help >/dev/full", 3, "opc4: standard output: No space left on device\n"),
        ("opc4 bus --json >/dev/full", 3, "opc4: standard output: No space left on device\n"),
        ("opc4 run --list 2>&- >/dev/full", 3, ""),
    ],
)
def test_standard_output_that_cannot_be_written(line: str, code: int, error: str) -> None:
    done = shell(line)
    assert (done.returncode, done.stderr) == (code, error)


def test_a_terminal_that_knows_no_umlauts_gets_them_escaped(tmp_path: Path) -> None:
    done = shell(f"cd {tmp_path}; opc4 run Tür.toml --json", LC_ALL="C", PYTHONIOENCODING="ascii")
    assert done.returncode == 2 and done.stderr.startswith("opc4 run: T\\xfcr.toml: ")
    assert done.stdout.isascii() and json.loads(done.stdout)["error"].startswith("Tür.toml")


def test_without_compilation_the_plant_is_refused_in_one_line() -> None:
    done = shell("opc4 simulate none", NUMBA_DISABLE_JIT="1")
    assert done.returncode == 2 and done.stderr.count("\n") == 1
    assert "NUMBA_DISABLE_JIT is set; expected it unset" in done.stderr


def test_linear_algebra_has_one_thread_unless_the_user_says_otherwise() -> None:
    line = "import atexit, os; atexit.register(lambda: print(os.environ['OPENBLAS_NUM_THREADS']))"
    code = f"{line}; from sil.cli import command; command()"
    for given, used in ((None, "1"), ("3", "3")):
        own = {k: v for k, v in os.environ.items() if k != "OPENBLAS_NUM_THREADS"}
        done = subprocess.run(
            [sys.executable, "-c", code, "--version"],
            env=own | ({} if given is None else {"OPENBLAS_NUM_THREADS": given}),
            capture_output=True,
            text=True,
            timeout=120,
        )
        assert done.stdout.splitlines()[-1] == used

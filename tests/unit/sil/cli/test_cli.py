"""The command: starts fast, says what it can, and never shows a traceback."""

from __future__ import annotations

import errno
import importlib
import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from sil import cli
from sil.cli import main

Capture = pytest.CaptureFixture[str]

HEAVY = (
    *[
        "numpy",
        "numba",
        "scipy",
        "can",
        "cantools",
        "matplotlib",
        "jinja2",
        "msgspec",
        "e2e",
        "plant",
        "controller",
    ],
    *("can_dbc.codec", "sil.simulation.load_scenario", "sil.simulation.runner"),
)


def printed(program: str) -> str:
    """What a Python program of its own process prints."""
    command = [sys.executable, "-c", program]
    return subprocess.run(command, capture_output=True, text=True, check=True, timeout=60).stdout


def test_help_lists_every_command_and_imports_nothing_heavy() -> None:
    program = (
        "import sys; from sil.cli import main; code = main(['--help']);"
        f"print([m for m in {HEAVY!r} if m in sys.modules], code)"
    )
    shown = printed(program)
    assert shown.endswith("[] 0\n")
    for name, summary in cli.COMMANDS.items():
        assert f"  {name:<10} {summary}\n" in shown


def test_a_run_in_one_process_imports_no_library_of_buses_and_logs() -> None:
    program = "import sys, sil.simulation.runner as r; print({'can', 'asammdf', 'pandas'} & set(sys.modules))"
    assert printed(program) == "set()\n"


@pytest.mark.parametrize("name", sorted(cli.COMMANDS))
def test_every_command_has_help_with_an_example(name: str, capsys: Capture) -> None:
    assert cli.main([name, "--help"]) == 0
    output = capsys.readouterr().out
    assert f"opc4 {name} " in output[output.index("example:") :]
    assert importlib.import_module(f"sil.cli.{name}").__doc__


def test_no_command_and_unknown_command_are_bad_usage(capsys: Capture) -> None:
    assert cli.main([]) == 2
    assert cli.main(["rnu"]) == 2
    assert "expected one of run" in capsys.readouterr().err


def test_bad_usage_is_one_line(capsys: Capture) -> None:
    assert cli.main(["run"]) == 2
    assert cli.main(["run", "lab_n_b", "--forc"]) == 2
    output = capsys.readouterr().err.splitlines()
    assert len(output) == 2 and "opc4 run --list" in output[0] and "--help" in output[1]
    assert cli.main(["fmu", "plnt", "a.fmu"]) == 2
    found = "opc4 fmu: argument what: 'plnt'; expected 'plant', 'controller'; see opc4 fmu --help\n"
    assert capsys.readouterr().err == found


@pytest.mark.parametrize("words", [["run", "lab_n_b", "--forc"], ["diagnose"], ["rnu"], []])
def test_bad_usage_is_one_json_object(words: list[str], capsys: Capture) -> None:
    assert cli.main([*words, "--json"]) == 2
    output = capsys.readouterr()
    found = json.loads(output.out)
    assert found["exit_code"] == 2 and output.err.endswith(f": {found['error']}\n")


def test_a_place_for_junit_that_does_not_exist_is_refused(capsys: Capture) -> None:
    assert cli.main(["run", "lab_n_b", "--junit", "no/such/folder/junit.xml"]) == 2
    assert "--junit: no such folder" in capsys.readouterr().err


def test_an_empty_argument_and_a_folder_for_junit_are_bad_input(
    tmp_path: Path, capsys: Capture
) -> None:
    assert cli.main(["run", "lab_n_b", "--out", ""]) == 2
    assert capsys.readouterr().err == "opc4: an empty argument; expected none\n"
    assert cli.main(["run", "lab_n_b", "--out", "", "--json"]) == 2
    found = json.loads(capsys.readouterr().out)
    assert found == {"error": "an empty argument; expected none", "exit_code": 2}
    assert cli.main(["run", "lab_n_b", "--junit", str(tmp_path)]) == 2
    assert "--junit: is a folder; expected a file" in capsys.readouterr().err


def test_bad_input_is_exit_2_and_one_json_object(capsys: Capture) -> None:
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


@pytest.mark.parametrize(
    ("command", "name", "then"),
    [
        ("run", "my shift.toml", ["run", "my shift.toml", "--no-report"]),
        ("whatif", "study.toml", ["whatif", "study.toml"]),
        ("firmware", "own.py", ["run", "lab_n_b", "--firmware", "own.py", "--no-report"]),
    ],
)
def test_a_draft_runs_as_it_is(
    command: str,
    name: str,
    then: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: Capture,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main([command, "--new", name]) == 0
    assert f"{name}: a draft that runs as it is: opc4 " in capsys.readouterr().out
    assert main([*then, "--out", "out"]) == 0
    text = Path(name).read_text(encoding="utf-8")
    assert text.count("#") > 5 or '"""' in text
    Path(name).write_text("mine")
    assert main([command, "--new", name]) == 2
    assert Path(name).read_text() == "mine"
    assert main([command, "--new", name, "--force"]) == 0
    assert Path(name).read_text(encoding="utf-8") == text


def test_the_draft_of_a_firmware_changes_what_it_says(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["firmware", "--new", "own.py"]) == 0
    own = Path("own.py")
    own.write_text(own.read_text().replace("MAX_DUTY = 1.0", "MAX_DUTY = 0.3"))
    assert main(["run", "lab_n_b", "--firmware", "own.py", "--no-report", "--out", "out"]) == 1
    assert "lab_n_b with firmware=own.py: neutral to backward: never" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["run", "--new", "my.json"], "no draft of such a file; expected FILE.toml"),
        (["firmware", "--new", "own.cpp"], "expected FILE.c or FILE.py"),
        (["run", "--new", "nowhere/my.toml"], "no such folder; expected a file in one that exists"),
    ],
)
def test_what_is_no_draft_is_one_line(words: list[str], said: str, capsys: Capture) -> None:
    assert main(words) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert said in line


LOG = "(0000000000.001000) opc4 0CFF2091#0011223344556677\n"


def test_convert_writes_once_and_refuses_the_rest(tmp_path: Path, capsys: Capture) -> None:
    source, target = tmp_path / "bus.log", tmp_path / "bus.asc"
    source.write_text(LOG)
    assert cli.main(["convert", str(source), str(target), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["written"] == 1
    assert cli.main(["convert", str(source), str(target)]) == 2
    assert "exists; expected a new name" in capsys.readouterr().err
    assert cli.main(["convert", str(source), str(target), "--force"]) == 0
    assert cli.main(["convert", str(tmp_path / "no.log"), str(tmp_path / "x.asc")]) == 2
    assert cli.main(["convert", str(source), str(tmp_path / "x.wav")]) == 2
    assert "Traceback" not in capsys.readouterr().err


@pytest.mark.parametrize("command", ["run", "simulate", "diagnose", "whatif", "replay", "convert"])
@pytest.mark.parametrize("name", ["x" * 5000, "loop/campaign"])
def test_a_path_that_cannot_exist_is_bad_input(
    command: str, name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("loop").symlink_to("loop")
    assert cli.main([command, name, "out.log"] if command == "convert" else [command, name]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"opc4 {command}: ") and "expected" in line
    assert {path.name for path in tmp_path.iterdir()} == {"loop"}


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["run", "x", "--seed", "1.5"], "--seed: '1.5'; expected a whole number"),
        (["run", "x", "--speed", "fast"], "--speed: 'fast'; expected a number"),
        (["diagnose", "x", "--workers", "0"], "--workers 0: expected 1 or more"),
        (["whatif"], "no STUDY; expected a file or a shipped name"),
    ],
)
def test_a_wrong_option_is_one_line(words: list[str], line: str, capsys: Capture) -> None:
    assert cli.main(words) == 2
    (said,) = capsys.readouterr().err.splitlines()
    assert line in said


def test_a_path_without_permission_is_bad_input(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    out, report = tmp_path / "out", tmp_path / "a.xml"
    monkeypatch.setattr("os.access", lambda *_: False)
    assert cli.main(["run", "lab_n_b", "--junit", str(report), "--out", str(out)]) == 2
    line = f"opc4 run: {report}: --junit: no permission; expected a folder to write in\n"
    assert capsys.readouterr().err == line and not out.exists()


def test_a_folder_that_holds_a_run_is_refused_before_logs_are_judged(
    tmp_path: Path, capsys: Capture
) -> None:
    source, out = tmp_path / "bus.log", tmp_path / "out"
    source.write_text(LOG)
    assert cli.main(["diagnose", str(source), "--out", str(out)]) == 2
    assert "--out" not in capsys.readouterr().err  # the log is what is wrong
    assert not out.exists()
    out.mkdir()
    (out / "diagnosis.json").write_text("{}")
    assert cli.main(["diagnose", str(source), "--out", str(out)]) == 2
    assert "holds another run (diagnosis.json)" in capsys.readouterr().err
    assert (out / "diagnosis.json").read_text() == "{}"


READERS = {
    ".toml": ["run", "{}"],
    ".json": ["compare", "{}", "{}"],
    ".dbc": ["bus", "--dbc", "{}"],
    ".py": ["run", "lab_n_b", "--rules", "{}"],
    ".mat": ["diagnose", "--new", "out", "--rig", "actuator", "{}"],
    ".parquet": ["diagnose", "--new", "out", "--rig", "force", "{}"],
    ".h5": ["diagnose", "--new", "out", "--rig", "force", "{}"],
    ".tdms": ["diagnose", "--new", "out", "--rig", "force", "{}"],
    ".csv": ["diagnose", "--new", "out", "--rig", "fixed", "{}"],
    ".asc": ["convert", "{}", "out.log"],
    ".blf": ["convert", "{}", "out.log"],
    ".mf4": ["replay", "{}"],
    ".opc4": ["run", "--from", "{}"],
}
SPOILS: dict[str, Callable[[Path], object]] = {
    "empty": lambda path: path.write_bytes(b""),
    "null bytes": lambda path: path.write_bytes(b"\0" * 4096),
    "Latin-1": lambda path: path.write_bytes('name = "Gr\xf6\xdfe"\n'.encode("latin-1")),
    "nested": lambda path: path.write_bytes(b"[" * 100_000 + b"]" * 100_000),
    "folder": Path.mkdir,
    "circle": lambda path: path.symlink_to(path.name),
    "nowhere": lambda path: path.symlink_to("nowhere"),
    "/dev/zero": lambda path: path.symlink_to("/dev/zero"),
    "/proc/self/mem": lambda path: path.symlink_to("/proc/self/mem"),
    "pipe": os.mkfifo,
}
MAY_WAIT = (".asc", ".blf", ".mf4")
"""Logs may come from a pipe, whose writer is waited for."""


@pytest.mark.parametrize("spoil", SPOILS)
@pytest.mark.parametrize("suffix", READERS)
def test_a_bad_file_is_refused_in_one_line(
    suffix: str, spoil: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: Capture
) -> None:
    if suffix in MAY_WAIT and spoil == "pipe":
        return
    if suffix == ".py" and spoil == "empty":
        return  # is Python, without rules: test_user_file
    monkeypatch.chdir(tmp_path)
    path = Path(f"x{suffix}")
    SPOILS[spoil](path)
    assert cli.main([word.format(path) for word in READERS[suffix]]) == 2
    captured = capfd.readouterr()
    (line,) = captured.err.splitlines()
    assert captured.out == "" and str(path) in line
    assert [each.name for each in tmp_path.iterdir()] == [path.name]


def test_a_full_disk_is_told_with_the_file_that_it_has_no_room_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    monkeypatch.chdir(tmp_path)
    rows = "".join(f"{k / 1000},{k * 1e-4},{k}\n" for k in range(100))
    Path("x.csv").write_text(f"time_s,position_m,force_n\n{rows}")
    replace, reason = os.replace, (errno.ENOSPC, os.strerror(errno.ENOSPC))

    def full(source: str, target: Path) -> None:
        if target.name == "x.csv":
            raise OSError(*reason, str(source))
        replace(source, target)

    monkeypatch.setattr(os, "replace", full)
    assert cli.main(["diagnose", "--new", "out", "--rig", "force", "x.csv"]) == 3
    (line,) = capsys.readouterr().err.splitlines()
    assert line == f"opc4 diagnose: out/x.csv: {reason[1]}"
    assert not list(Path("out").glob("*x.csv*"))

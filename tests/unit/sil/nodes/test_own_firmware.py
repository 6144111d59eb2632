"""A user's firmware file: taken as it is, or refused in one line that names the place."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from can_dbc.errors import InputError, RunError
from sil.cli import main
from sil.simulation.in_memory import run_in_memory
from sil.simulation.scenario import load

SCENARIO = """
name = "own"
firmware = "{firmware}"
duration_s = 0.3
request = [{{ at_s = 0.1, gear = "backward" }}]
"""
OURS = "from controller.firmware import Firmware\nclass Mine(Firmware):\n    pass\n"


def scenario_with(folder: Path, program: str, firmware: str = "own.py") -> Path:
    (folder / "own.py").write_text(program)
    (folder / "own.toml").write_text(SCENARIO.format(firmware=firmware))
    return folder / "own.toml"


def test_our_own_program_in_a_file_gives_the_same_bits(tmp_path: Path) -> None:
    path = scenario_with(tmp_path, OURS, "own.py:Mine")
    mine = run_in_memory(load(str(path)))
    path.write_text(path.read_text().replace('firmware = "own.py:Mine"', ""))
    assert mine.trace_sha256 == run_in_memory(load(str(path))).trace_sha256


def test_it_is_found_beside_the_scenario_and_from_the_command_line(
    tmp_path: Path, monkeypatch: Any
) -> None:
    path = scenario_with(tmp_path, OURS, "own.py:Mine")
    assert load(str(path)).scenario.firmware == f"{tmp_path / 'own.py'}:Mine"
    monkeypatch.chdir(tmp_path)
    set_there = load("lab_n_b", settings=['firmware="own.py:Mine"'])
    assert set_there.scenario.firmware == f"{tmp_path / 'own.py'}:Mine"


@pytest.mark.parametrize(
    ("program", "firmware", "told"),
    [
        (OURS, "none.py", "no such file"),
        (OURS, "own.toml", "expected FILE.py"),
        (OURS, "own.py:Other", "no class 'Other'"),
        ("x = 1\nFirmware = 3\n", "own.py", "no class 'Firmware'"),
        ("x = 1\ny = (\n", "own.py", "own.py:2: SyntaxError"),
        ("\n\nimport not_there\n", "own.py", "own.py:3: ModuleNotFoundError"),
        ("class Firmware:\n def __init__(self, c):\n  1 / 0\n def step(self): ...\n", "own.py",
         "own.py:3: ZeroDivisionError"),
    ],
)  # fmt: skip
def test_bad_files_are_refused_in_one_line(
    program: str, firmware: str, told: str, tmp_path: Path, capsys: Any
) -> None:
    path = scenario_with(tmp_path, program, firmware)
    for transport in ("inproc", "local"):
        out = tmp_path / transport
        code = main(["run", str(path), "--transport", transport, "--out", str(out)])
        complaint = capsys.readouterr().err.strip().splitlines()
        assert code == 2, transport
        assert told in complaint[-1] and not any("Traceback" in line for line in complaint)


def test_a_program_that_fails_in_mid_run_ends_it_and_is_named(tmp_path: Path) -> None:
    program = OURS.replace(
        "pass", "def step(self, now_ns, inputs):\n        return 1 // (now_ns < 5)\n"
    )
    with pytest.raises((RunError, InputError), match="controller failed"):
        run_in_memory(load(str(scenario_with(tmp_path, program, "own.py:Mine"))))

"""The tutorial as a reader does it: every file written, every command run."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

from tests.conftest import ROOT, run_opc4

TUTORIAL = (ROOT / "docs" / "tutorial.md").read_text(encoding="utf-8")
STEP = re.compile(r"```(sh|toml|python|c)\n(.*?)```", re.DOTALL)
FILE = re.compile(r"(?:#|/\*) file: (\S+)")
ELSEWHERE = ("make demo", "export PATH")
"""Installing is what CI itself begins with."""

HAS_C = find_spec("wasmtime") is not None and find_spec("ziglang") is not None

pytestmark = pytest.mark.slow


def commands(text: str) -> Iterator[tuple[list[str], int]]:
    """The words of each command of a block, and the exit code that its remark tells."""
    for line in text.strip().splitlines():
        if not line.startswith(ELSEWHERE):
            command, _, remark = line.partition("#")
            output = re.search(r"exit (\d)", remark)
            yield command.split(), int(output[1]) if output else 0


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[str]]:
    """The folder after the whole tutorial, and the commands that were run."""
    folder = tmp_path_factory.mktemp("tutorial")
    output = []
    for language, text in STEP.findall(TUTORIAL):
        if language != "sh":
            named = FILE.match(text)
            assert named is not None, text
            path = folder / named.group(1)
            path.parent.mkdir(exist_ok=True)
            path.write_text(text, encoding="utf-8")
            continue
        for words, expected in commands(text):
            assert words[0] == "opc4"
            if "own.c" not in words or HAS_C:
                run = run_opc4(folder, *words[1:], timeout=1200.0)
                assert run.returncode == expected, run.stderr + run.stdout
            output.append(" ".join(words))
    return folder, output


def result(folder: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((folder / "result.json").read_text())
    return found


def test_every_step_was_run(done: tuple[Path, list[str]]) -> None:
    assert len(done[1]) == 13
    assert {words.split()[1] for words in done[1] if words.startswith("opc4")} == {
        *("run", "whatif", "simulate", "diagnose", "firmware")
    }


def test_the_first_shift_is_as_told(done: tuple[Path, list[str]]) -> None:
    lab = result(done[0] / "first")["metrics"]
    assert lab["impact_speed_m_s"] == pytest.approx(0.94, abs=0.01)
    assert lab["shift_time_s"] == pytest.approx(0.051, abs=0.0005)
    for name in ("shift.png", "shift.svg", "report.html"):
        assert (done[0] / "first" / name).stat().st_size > 10_000


def test_the_closing_delay_changes_nothing(done: tuple[Path, list[str]]) -> None:
    lines = (done[0] / "closing" / "results.csv").read_text().splitlines()
    assert len(lines) == 7
    column = lines[0].split(",").index("impact_speed_m_s")
    by_load: dict[str, set[str]] = {}
    for line in lines[1:]:
        by_load.setdefault(line.split(",")[1], set()).add(line.split(",")[column])
    assert all(len(found) == 1 for found in by_load.values())


def test_the_diagnosis_finds_the_late_valve(done: tuple[Path, list[str]]) -> None:
    found = json.loads((done[0] / "diagnosis" / "diagnosis.json").read_text())
    assert found["verdict"] == "named"
    (cause,) = found["causes"]
    assert cause["id"] == "valve_open_delay" and cause["probability"] > 0.9
    assert cause["parameters"]["delay_s"]["value"] == pytest.approx(0.005, abs=0.0002)
    late = result(done[0] / "as_it_is")["metrics"]["shift_time_s"]
    assert late - result(done[0] / "first")["metrics"]["shift_time_s"] == pytest.approx(
        0.005, abs=2e-4
    )


def test_own_controllers_shift_and_are_one(done: tuple[Path, list[str]]) -> None:
    runs = [result(done[0] / name) for name in ("own", "own_in_its_process")]
    assert all(run["passed"] for run in runs)
    assert len({run["trace_sha256"] for run in runs}) == 1
    assert not HAS_C or result(done[0] / "own_in_c")["passed"]


def test_the_cells_print_what_they_say(
    done: tuple[Path, list[str]],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    text = (ROOT / "docs" / "how-to" / "python.md").read_text(encoding="utf-8")
    cells = re.findall(r"```python\n(.*?)```\n\n```text\n(.*?)```", text, re.DOTALL)
    assert len(cells) == text.count("```python") >= 8
    monkeypatch.chdir(done[0])
    names: dict[str, Any] = {}
    for cell, printed in cells:
        exec(compile(cell, "python.md", "exec"), names)
        assert capsys.readouterr().out == printed, cell


def test_every_step_says_its_minutes() -> None:
    steps = re.findall(r"^## \d+\. (.*)$", TUTORIAL, re.MULTILINE)
    assert len(steps) == 7
    assert all(re.search(r"\(\d+ minutes\)$", step) for step in steps[:6])

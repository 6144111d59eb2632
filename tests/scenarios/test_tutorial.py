"""The tutorial, done as it stands there: every file written, every command run."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path

from tests.conftest import ROOT

TUTORIAL = (ROOT / "sil" / "docs" / "tutorial.md").read_text(encoding="utf-8")
STEP = re.compile(r"```(sh|toml|python)\n(.*?)```", re.DOTALL)
FILE = re.compile(r"# file: (\S+)\n")


def result(folder: Path) -> dict[str, object]:
    found: dict[str, object] = json.loads((folder / "result.json").read_text())
    return found


def test_the_tutorial(opc4: Callable[..., object], tmp_path: Path) -> None:
    commands = 0
    for language, text in STEP.findall(TUTORIAL):
        named = FILE.match(text)
        if language != "sh":
            assert named is not None
            (tmp_path / named.group(1)).write_text(text, encoding="utf-8")
            continue
        for line in text.strip().splitlines():
            command, _, remark = line.partition("#")
            expected = int(remark.split()[1]) if remark.strip().startswith("exit") else 0
            program, *arguments = command.split()
            assert program == "opc4"
            done = opc4(*arguments)
            assert done.returncode == expected, done.stderr + done.stdout  # type: ignore[attr-defined]
            commands += 1
    assert commands == 7
    own, apart = result(tmp_path / "own"), result(tmp_path / "own_in_its_process")
    assert own["passed"] and own["trace_sha256"] == apart["trace_sha256"]
    lab = result(tmp_path / "first")["metrics"]
    assert abs(lab["impact_speed_m_s"] - 0.94) < 0.01  # type: ignore[index]
    assert abs(lab["shift_time_s"] - 0.051) < 0.0005  # type: ignore[index]
    lines = (tmp_path / "closing" / "results.csv").read_text().splitlines()
    assert len(lines) == 7
    column = lines[0].split(",").index("impact_speed_m_s")
    speeds = {line.split(",")[1]: set() for line in lines[1:]}  # type: ignore[var-annotated]
    for line in lines[1:]:
        speeds[line.split(",")[1]].add(line.split(",")[column])
    assert all(len(found) == 1 for found in speeds.values())  # as the text says

"""Every command of the README's blocks, in their order, in one folder."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import pytest

from tests.conftest import ROOT, run_opc4
from tests.scenarios.test_readme import README

pytestmark = pytest.mark.slow

TUTORIAL = (ROOT / "docs" / "tutorial.md").read_text(encoding="utf-8")


def lines() -> list[str]:
    """The commands, without prompts."""
    blocks = re.findall(r"```(?:sh|text|console)\n(.*?)```", README, re.DOTALL)
    told = [line.removeprefix("$ ") for block in blocks for line in block.splitlines()]
    return [line for line in told if line.startswith(("opc4 ", "make "))]


def of_tutorial(name: str) -> str:
    """A file that the tutorial writes."""
    (found,) = re.findall(rf"```\w+\n(# file: {re.escape(name)}\n.*?)```", TUTORIAL, re.DOTALL)
    return str(found)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the README's reader stands: a firmware of their own and a measured campaign."""
    made = tmp_path_factory.mktemp("readme")
    (made / "own.py").write_text(of_tutorial("own.py"), encoding="utf-8")
    (made / "plan").mkdir()
    plan = of_tutorial("plan/campaign.toml")
    (made / "plan" / "campaign.toml").write_text(plan, encoding="utf-8")
    done = run_opc4(made, "simulate", "plan", "--set", "valve.D_rise=0.013", "--out", "measured")
    assert done.returncode == 0, done.stderr
    return made


@pytest.mark.parametrize("line", [line for line in lines() if line.startswith("opc4 ")])
def test_commands_do_what_is_said(line: str, folder: Path) -> None:
    command, _, remark = line.partition("#")
    words = command.split()[1:]
    if "truck.mf4" in words:
        log = sorted(folder.glob("runs/full_shift-*/bus.log"))[0]
        assert run_opc4(folder, "convert", str(log), "truck.mf4").returncode == 0
    done = run_opc4(folder, *words, timeout=1200.0)
    said = re.search(r"exit (\d)", remark)
    # what is changed may break an expectation of the scenario, but is never an error
    allowed = {int(said[1])} if said else {0, 1}
    assert done.returncode in allowed, done.stdout + done.stderr
    assert "Traceback" not in done.stderr


def test_make_demo(tmp_path: Path) -> None:
    """With what is installed as it is."""
    done = subprocess.run(
        ["make", "-o", ".venv/.run", "demo", f"DEMO={tmp_path / 'demo'}"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=600.0,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "demo" / "shift.png").exists() and "page:" in done.stdout


def test_there_are_commands() -> None:
    assert len(lines()) >= 15

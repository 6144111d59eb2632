"""Another commit's firmware: compared from a folder that is gone afterwards."""

from __future__ import annotations

import shutil
import subprocess
from contextlib import closing
from pathlib import Path

import pytest

from can_dbc.errors import InputError, RunError
from can_dbc.messages import ValveCommand
from controller.config import FirmwareConfig
from controller.node import ControllerNode
from sil.firmware.python_file import OwnController
from sil.log_replay.checkout import checkout
from sil.log_replay.executor import Unit
from sil.log_replay.recorded_frames import OWN_IDS
from sil.log_replay.replay import ReplayRequest, replay
from sil.simulation.in_memory import run_in_memory
from sil.simulation.load_scenario import load
from tests.conftest import ROOT
from tests.support.golden_logs import arrivals, golden


def git(folder: Path, *arguments: str) -> str:
    command = ["git", "-C", str(folder), "-c", "user.name=t", "-c", "user.email=t@t", *arguments]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout


@pytest.fixture
def repository(tmp_path: Path) -> Path:
    """Two commits of the firmware: as it is, and one that drives in every other period."""
    folder = tmp_path / "repository"
    folder.mkdir()
    for package in ("controller", "can_dbc"):
        shutil.copytree(
            ROOT / package, folder / package, ignore=shutil.ignore_patterns("__pycache__")
        )
    git(folder, "init", "--quiet", "--initial-branch=main")
    git(folder, "add", ".")
    git(folder, "commit", "--quiet", "-m", "as it is")
    strategy = folder / "controller" / "strategies" / "open_loop.py"
    text = strategy.read_text()
    duty = "self.config.duty if now_ns % 20_000_000 < 5_000_000 else 0.0"
    changed = text.replace("(shift.charged, self.config.duty)", f"(shift.charged, {duty})")
    assert changed != text
    strategy.write_text(changed)
    git(folder, "commit", "--quiet", "-a", "-m", "drives in every other period only")
    return folder


def test_two_commits_on_one_log(repository: Path) -> None:
    log = str(golden("lab_n_b"))
    with checkout("HEAD~1", repository) as tree:
        assert not replay(ReplayRequest(log, reference=(tree, "HEAD~1"))).differs
    with checkout("HEAD", repository) as tree:
        found = replay(ReplayRequest(log, reference=(tree, "HEAD")))
    assert found.differs and found.labels == ("HEAD", "here")
    assert found.comparison.first_command is not None
    assert found.comparison.first_command.signals[0][0] == "ValveCommand.duty_b"
    assert not tree.exists()


@pytest.mark.parametrize("name", ["no-such-commit", "--help", "", "HEAD~99"])
def test_a_commit_that_is_not_there_is_refused(repository: Path, name: str) -> None:
    with pytest.raises(InputError, match="--against"), checkout(name, repository):
        pass


def test_code_outside_of_a_repository_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no git repository"), checkout("HEAD", tmp_path):
        pass


def test_a_commit_without_a_firmware_is_refused(repository: Path) -> None:
    git(repository, "rm", "-r", "--quiet", "controller")
    git(repository, "commit", "--quiet", "-m", "no firmware")
    expected = r"--against HEAD: .*controller.*; expected a commit, tag or branch with a firmware"
    with pytest.raises(InputError, match=expected), checkout("HEAD", repository):
        pass


def test_the_controller_of_a_checkout_answers_as_our_own_does() -> None:
    log = [a for a in arrivals("lab_n_b") if a.kind is not None]
    own = Unit(lambda: ControllerNode(FirmwareConfig()))
    with closing(Unit(lambda: OwnController(str(ROOT), FirmwareConfig(), "here"))) as foreign:
        for tick in range(40):
            now = tick * 10_000_000
            heard = [(a.time_ns, a.frame) for a in log if now - 10_000_000 < a.time_ns <= now]
            if tick == 25:
                own.restart(now)
                foreign.restart(now)
            ours = own.step(now, heard)
            assert foreign.step(now, heard) == ours
            assert OWN_IDS[ours[0].can_id] is ValveCommand


def test_a_scenario_runs_with_the_firmware_of_a_checkout() -> None:
    ours, theirs = (
        run_in_memory(load("lab_n_b", settings=settings))
        for settings in ({}, {"firmware": str(ROOT)})
    )
    assert theirs.scenario.firmware == str(ROOT)
    assert theirs.trace_sha256 == ours.trace_sha256


def test_a_checkout_without_a_controller_is_refused(tmp_path: Path) -> None:
    package = tmp_path / "controller"
    package.mkdir()
    (package / "__init__.py").write_text("raise RuntimeError('an older world')\n")
    with pytest.raises(InputError, match=r"is a folder; expected .* or a checkout"):
        OwnController(str(tmp_path), FirmwareConfig())
    (package / "node.py").touch()
    with pytest.raises(InputError, match=r"^old: .*/__init__.py:1: RuntimeError: an older"):
        OwnController(str(tmp_path), FirmwareConfig(), "old")


def test_the_error_that_ends_a_checkouts_controller_is_named() -> None:
    with closing(OwnController(str(ROOT), FirmwareConfig(), "here")) as node:
        node.advance(0, [])
        with pytest.raises(RunError, match=r"here failed: .*skips the tick"):
            node.advance(10_000_001, [])

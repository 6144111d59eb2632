"""Where a replay's frames and settings are from; another commit's firmware."""

from __future__ import annotations

import json
import shutil
import subprocess
from contextlib import closing
from pathlib import Path

import pytest

from can_dbc.contract import DBC_PATH
from can_dbc.errors import InputError, RunError
from can_dbc.frame import Frame
from can_dbc.messages import PositionPulse, ShiftRequest, ValveCommand
from controller.config import FirmwareConfig
from controller.node import ControllerNode
from sil.files.overrides import Settings
from sil.firmware.python_file import OwnController
from sil.log_replay.checkout import checkout
from sil.log_replay.executor import Unit
from sil.log_replay.options import find_settings
from sil.log_replay.recorded_frames import (
    ID_OF,
    OWN_IDS,
    RecordedFrames,
    bare,
    ids_of_database,
    is_intact,
)
from sil.log_replay.replay import ReplayRequest, replay
from sil.log_replay.tick_grid import survey
from sil.logs import LogFrame
from sil.simulation import load_scenario, scenario
from sil.simulation.in_memory import run_in_memory
from sil.simulation.load_scenario import load
from tests.conftest import ROOT
from tests.support.golden_logs import arrivals, golden

FOUND = survey(arrivals("firmware_2500us"))


def result(folder: Path, name: str) -> Path:
    path = folder / "result.json"
    path.write_text(json.dumps({"scenario": scenario.expanded(load_scenario.load(name).scenario)}))
    return folder / "bus.log"


def test_without_a_run_the_periods_are_those_of_the_log(tmp_path: Path) -> None:
    found = find_settings(str(tmp_path / "a.log"), FOUND)
    config = found.loaded.scenario.controller
    assert (config.period_ns, config.sensor.period_s) == (2_500_000, 0.0025)
    assert config.filter.enabled and not found.own_run
    assert found.description == "defaults, period 2.5 ms and sensor period 2.5 ms from the log"


def test_the_run_beside_the_log_gives_its_settings(tmp_path: Path) -> None:
    log = result(tmp_path, "strategy_predictive")
    found = find_settings(str(log), FOUND, settings={"controller.period_s": 0.005})
    assert found.own_run
    assert found.loaded.scenario.controller.strategy == "predictive"
    assert found.loaded.scenario.controller.period_ns == 5_000_000
    assert found.description.endswith("result.json with controller.period_s=0.005")


@pytest.mark.parametrize(
    "text",
    [
        "filter = false\n",
        "[controller]\nfilter = false\n",
        "controller = { filter = { enabled = false } }",
    ],
)
def test_a_file_gives_the_settings_and_the_log_the_period(tmp_path: Path, text: str) -> None:
    file = tmp_path / "f.toml"
    file.write_text(text)
    config = find_settings(
        str(tmp_path / "a.log"), FOUND, firmware=str(file)
    ).loaded.scenario.controller
    assert not config.filter.enabled and config.period_ns == 2_500_000


def test_another_runs_result_gives_its_firmware(tmp_path: Path) -> None:
    result(tmp_path, "filter_off")
    found = find_settings("elsewhere/a.log", FOUND, firmware=str(tmp_path / "result.json"))
    config = found.loaded.scenario.controller
    assert not config.filter.enabled and config.period_ns == 10_000_000


@pytest.mark.parametrize(
    ("settings", "complaint"),
    [
        ({"valve.D_fall": 0.01}, "valve.D_fall: not of the firmware"),
        ({"controller.filtre": False}, "expected one of controller.filter"),
        ({"controller.period_s": 1.0}, "controller.period_s"),
    ],
)
def test_settings_that_cannot_be_are_refused(settings: Settings, complaint: str) -> None:
    with pytest.raises(InputError) as refused:
        find_settings("a.log", FOUND, settings=settings)
    assert complaint in str(refused.value)


def test_a_file_without_settings_is_refused(tmp_path: Path) -> None:
    (tmp_path / "f.json").write_text("[]")
    with pytest.raises(InputError, match="no firmware settings"):
        find_settings("a.log", FOUND, firmware=str(tmp_path / "f.json"))
    (tmp_path / "f.toml").write_text("controller = 1\n")
    with pytest.raises(InputError, match="not a table"):
        find_settings("a.log", FOUND, firmware=str(tmp_path / "f.toml"))
    (tmp_path / "g.toml").write_text("periode_s = 1\n")
    with pytest.raises(InputError, match="period_s"):
        find_settings("a.log", FOUND, firmware=str(tmp_path / "g.toml"))
    with pytest.raises(InputError, match=r"none\.toml"):
        find_settings("a.log", FOUND, firmware=str(tmp_path / "none.toml"))


REQUEST = ID_OF[ShiftRequest]
DBC = Path(DBC_PATH).read_text(encoding="ascii")


def request(time_ns: int, **changes: object) -> LogFrame:
    return LogFrame(time_ns, REQUEST, bytes(8))._replace(**changes)


def test_every_frame_is_passed_on_or_counted() -> None:
    log = [
        request(1),
        LogFrame(2, 0x123, b"\x01", extended=False),
        LogFrame(3, 0x1, b"", error=True),
        LogFrame(4, REQUEST, b"", remote=True),
        LogFrame(5, REQUEST, bytes(12), fd=True),
        LogFrame(6, 0x18FEF100, bytes(8)),
        request(7, channel="can1"),
    ]
    traffic = RecordedFrames(log, channel="")
    assert [(a.time_ns, a.kind) for a in traffic] == [(1, ShiftRequest), (6, None)]
    assert traffic.total == 7
    assert dict(traffic.counts) == {
        "frames with an 11-bit identifier": 1,
        "error frames": 1,
        "remote frames": 1,
        "CAN FD frames": 1,
        "on another channel": 1,
    }


def test_slightly_reordered_frames_are_taken_and_a_jump_back_is_refused() -> None:
    traffic = RecordedFrames([request(100_000_000), request(60_000_000), request(101_000_000)])
    assert [a.time_ns for a in traffic] == [100_000_000, 100_000_000, 101_000_000]
    assert traffic.reordered == 1
    with pytest.raises(
        InputError, match=r"log: frame 2: the clock steps back by 1\.000 s; expected"
    ):
        list(RecordedFrames([request(2_000_000_000), request(1_000_000_000)]))


def test_a_damaged_frame_is_not_intact() -> None:
    pulse = next(a.frame for a in arrivals("lab_n_b") if a.kind is PositionPulse)
    assert is_intact(PositionPulse, pulse)
    broken = Frame(pulse.can_id, pulse.data[:4] + bytes((pulse.data[4] ^ 1,)) + pulse.data[5:])
    assert not is_intact(PositionPulse, broken)
    assert not is_intact(PositionPulse, Frame(pulse.can_id, pulse.data[:7]))
    assert bare(PositionPulse, pulse.data)[2:] == pulse.data[2:]
    assert bare(PositionPulse, pulse.data)[:2] == bytes((0, pulse.data[1] & 0xF0))


def test_identifiers_of_another_database(tmp_path: Path) -> None:
    other = tmp_path / "other.dbc"
    moved = (ID_OF[ValveCommand] ^ 0x10) | 1 << 31
    other.write_text(DBC.replace(str(ID_OF[ValveCommand] | 1 << 31), str(moved)), encoding="ascii")
    ids = ids_of_database(str(other))
    assert ids[moved & ~(1 << 31)] is ValveCommand
    assert ID_OF[ValveCommand] not in ids


def test_a_database_with_another_layout_is_refused(tmp_path: Path) -> None:
    other = tmp_path / "other.dbc"
    wrong = DBC.replace("SG_ DutyB : 16|", "SG_ DutyB : 17|", 1)
    assert wrong != DBC
    other.write_text(wrong, encoding="ascii")
    with pytest.raises(InputError, match=r"other\.dbc.*DutyB"):
        ids_of_database(str(other))
    other.write_text('VERSION ""\nBU_: A\nBO_ 2566834709 Other: 8 A\n', encoding="ascii")
    with pytest.raises(InputError, match="no message of the control unit"):
        ids_of_database(str(other))


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

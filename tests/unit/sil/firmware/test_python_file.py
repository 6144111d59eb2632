"""A user's firmware file: taken as it is, or refused in one line that names the place."""

from __future__ import annotations

import gc
import json
import os
import signal
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from can_dbc.codec import decode, encode
from can_dbc.errors import RunError
from can_dbc.messages import DrivelineSpeeds, E2eState, Gear, PositionPulse, ShiftRequest
from controller.config import FirmwareConfig
from controller.firmware import Firmware, Inputs
from controller.node import ControllerNode
from sil.cli import main
from sil.firmware import python_file
from sil.firmware.frame_steps import FrameSteps
from sil.simulation.in_memory import run_in_memory
from sil.simulation.load_scenario import load

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


def test_a_process_that_died_between_two_runs_is_replaced_and_leaves_no_open_file(
    tmp_path: Path,
) -> None:
    server = tmp_path / "server"
    program = f"import os\nopen({str(server)!r}, 'w').write(str(os.getppid()))\n{OURS}"
    scenario = load(str(scenario_with(tmp_path, program, "own.py:Mine")))
    first = run_in_memory(scenario)
    number = int(server.read_text())
    os.kill(number, signal.SIGKILL)
    os.waitid(os.P_PID, number, os.WEXITED | os.WNOWAIT)
    assert run_in_memory(scenario).trace_sha256 == first.trace_sha256
    gc.collect()  # an open file would warn, and warnings are errors


def test_it_is_found_beside_the_scenario_and_from_the_command_line(
    tmp_path: Path, monkeypatch: Any
) -> None:
    path = scenario_with(tmp_path, OURS, "own.py:Mine")
    assert load(str(path)).scenario.firmware == f"{tmp_path / 'own.py'}:Mine"
    monkeypatch.chdir(tmp_path)
    set_there = load("lab_n_b", settings={"firmware": "own.py:Mine"})
    assert set_there.scenario.firmware == f"{tmp_path / 'own.py'}:Mine"


@pytest.mark.parametrize(
    ("program", "firmware", "reported"),
    [
        (OURS, "none.py", "no such file"),
        (OURS, ".", "is a folder; expected FILE.py"),
        (OURS, "own.toml", "expected FILE.py"),
        (OURS, "own.py:Other", "no class 'Other'"),
        ("x = 1\nFirmware = 3\n", "own.py", "no class 'Firmware'"),
        ("x = 1\ny = (\n", "own.py",
         "own.py:2: SyntaxError: '(' was never closed; expected valid Python"),
        ("x = 1\0\n", "own.py", "null bytes; expected valid Python"),
        ("\n\nimport not_there\n", "own.py", "own.py:3: ModuleNotFoundError"),
        ("class Firmware:\n def __init__(self, c):\n  1 / 0\n def step(self): ...\n", "own.py",
         "own.py:3: ZeroDivisionError"),
    ],
)  # fmt: skip
def test_bad_files_are_refused_in_one_line(
    program: str, firmware: str, reported: str, tmp_path: Path, capsys: Any
) -> None:
    path = scenario_with(tmp_path, program, firmware)
    for transport in ("inproc", "local"):
        out = tmp_path / transport
        code = main(["run", str(path), "--transport", transport, "--out", str(out)])
        complaint = capsys.readouterr().err.strip().splitlines()
        assert code == 2, transport
        assert reported in complaint[-1] and not any("Traceback" in line for line in complaint)


STEP = """
import dataclasses, math, os, sys
from controller.firmware import Firmware
class Mine(Firmware):
    def step(self, now_ns, inputs):
        out = super().step(now_ns, inputs)
        if now_ns == 140_000_000:
            {}
        return out
"""
INIT = """
import os, sys
from controller.firmware import Firmware
class Mine(Firmware):
    def __init__(self, config):
        {}
"""
NAN = "return out._replace(valves=dataclasses.replace(out.valves, duty_b=math.nan))"


def broken(folder: Path, program: str) -> Path:
    return scenario_with(folder, program, "own.py:Mine")


@pytest.mark.parametrize(
    ("statement", "reason"),
    [
        ("sys.exit(0)", "own.py:8: SystemExit: 0"),
        ("os._exit(0)", r"own.py:8: ProcessExit: os._exit\(0\)"),
        ("1 // 0", "own.py:8: ZeroDivisionError"),
        ('raise ValueError("first" + chr(10) + "second")', "own.py:8: ValueError: first second"),
        (NAN, "own.py:5: .*duty_b.*nan"),
        ("return None", "own.py:5: TypeError: step returned NoneType; expected .*Outputs"),
        ("os.kill(os.getpid(), 11)", "own.py:8: its process ended: killed by SIGSEGV"),
        ("while True: pass", "own.py:8: no answer within 0.5 s: it hangs"),
    ],
)
def test_what_fails_in_a_step_ends_the_run_with_file_line_and_time(
    statement: str, reason: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(python_file, "STEP_S", 0.5)
    loaded = load(str(broken(tmp_path, STEP.format(statement))))
    with pytest.raises(RunError, match=rf"failed: .*{reason}.* \(at 0.140000 s simulated\)"):
        run_in_memory(loaded)


@pytest.mark.parametrize(
    ("statement", "reason"),
    [
        ("sys.exit(0)", "own.py:6: SystemExit"),
        ("os._exit(0)", "own.py:6: ProcessExit"),
        ("while True: pass", "own.py:6: no answer within 2 s"),
    ],
)
def test_an_init_that_does_not_return_ends_the_run(
    statement: str, reason: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run_in_memory(load(str(broken(tmp_path, OURS))))  # now a process is there
    monkeypatch.setattr(python_file, "LOAD_S", 2.0)
    loaded = load(str(broken(tmp_path, INIT.format(statement))))
    with pytest.raises(RunError, match=rf"failed: .*{reason}.* \(at 0.000000 s simulated\)"):
        run_in_memory(loaded)


@pytest.mark.parametrize("transport", ["inproc", "local"])
def test_the_command_exits_with_3_and_prints_go_to_standard_error(
    transport: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    path = broken(tmp_path, STEP.format("print('printed'); sys.exit(0)"))
    words = ["run", str(path), "--out", str(tmp_path / "out"), "--transport", transport, "--json"]
    assert main(words) == 3
    shown = capfd.readouterr()
    result = json.loads(shown.out)
    assert result["why"].endswith("own.py:8: SystemExit: 0 (at 0.140000 s simulated)")
    assert "printed" in shown.err.splitlines() and result["why"] in shown.err


def test_a_replay_of_a_firmware_that_exits_is_exit_3(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    path = broken(tmp_path, STEP.format("sys.exit(0)"))
    assert main(["run", "lab_n_b", "--no-report", "--out", str(tmp_path / "run")]) == 0
    log, firmware = str(tmp_path / "run" / "bus.log"), f"{tmp_path / 'own.py'}:Mine"
    assert path.exists()
    assert main(["replay", log, "--firmware", firmware, "--out", str(tmp_path / "diff")]) == 3
    assert "own.py:8: SystemExit: 0 (at 0.14" in capfd.readouterr().err


def test_a_process_serves_one_run_after_the_other(tmp_path: Path) -> None:
    counts = "import sys\nsys.runs = getattr(sys, 'runs', 0) + 1\n"
    scenario = load(str(broken(tmp_path, counts + OURS))).scenario
    own = partial(python_file.OwnController, scenario.firmware, scenario.controller)
    first, second = own(), own()
    servers = {id(first._server), id(second._server)}
    first.close()
    third = own()
    assert len(servers) == 2 and id(third._server) in servers
    assert third.advance(0, [])[0] == second.advance(0, [])[0]
    second.close()
    third.close()


def test_a_name_that_is_not_utf8_is_refused(tmp_path: Path, capsys: Any) -> None:
    command = ["run", "lab_n_b", "--firmware", "\udcff.py", "--out", str(tmp_path / "out")]
    assert main(command) == 2
    assert "its name is not UTF-8" in capsys.readouterr().err


MS = 1_000_000


class Silent(ControllerNode):
    """A control unit that sends nothing."""

    def _step(self, now_ns: int) -> list:
        return []


def inputs(tick: int) -> Inputs:
    """What the sensor shows of a stay in neutral, and a request for backward from 0.2 s on."""
    state = E2eState.VALID if tick else E2eState.INIT
    pulse = decode(encode(PositionPulse(0.0009, 293.15, tick % 256)))
    target = Gear.BACKWARD if tick > 20 else Gear.NEUTRAL
    speeds = decode(encode(DrivelineSpeeds(100.0, 90.0)))
    return Inputs((pulse,) if tick else (), ShiftRequest(target), speeds, state, state, state)


def test_the_answers_are_those_of_the_program() -> None:
    program, unit = Firmware(FirmwareConfig()), FrameSteps(ControllerNode(FirmwareConfig()))
    unit.step(0, inputs(1)._replace(pulses=()))
    program.step(0, inputs(0))
    for tick in range(1, 60):
        expected = program.step(10 * MS * tick, inputs(tick))
        answer = unit.step(10 * MS * tick, inputs(tick))
        assert answer.valves.duty_b == pytest.approx(expected.valves.duty_b, abs=1e-4)
        assert answer.status.state == expected.status.state or tick < 8
    assert answer.valves.duty_b > 0.9


def test_a_unit_that_leaves_a_message_out_is_refused() -> None:
    with pytest.raises(ValueError, match="sent no ValveCommand"):
        FrameSteps(Silent(FirmwareConfig())).step(0, inputs(0))

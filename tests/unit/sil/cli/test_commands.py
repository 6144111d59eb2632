"""The smaller commands: bus, convert, node."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import pytest

from sil import cli
from sil.simulation import build, scenario

LOG = "(0000000000.001000) opc4 0CFF2091#0011223344556677\n"


def test_bus_tells_transports_load_and_worst_cases(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["bus", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["transports"]["inproc"] and told["transports"]["local"]
    assert [m["name"] for m in told["messages"]][:2] == ["ValveCommand", "SafetyBlow"]
    # The first waits for one frame under way and itself: two of the longest, 160 bits each.
    assert told["messages"][0]["worst_case_s"] == pytest.approx(2 * 160 * 2e-6)
    assert all(m["in_time"] for m in told["messages"])


def test_bus_at_half_the_rate_takes_twice_as_long(capsys: pytest.CaptureFixture[str]) -> None:
    loads = []
    for rate in ("500000", "250000"):
        assert cli.main(["bus", "--json", "--bitrate", rate]) == 0
        loads.append(json.loads(capsys.readouterr().out)["worst_case_load"])
    assert loads[1] == pytest.approx(2 * loads[0])


def test_bus_of_a_scenario_says_what_is_too_late(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["bus", "--scenario", "firmware_2500us"]) == 1
    assert "too late" in capsys.readouterr().out
    assert cli.main(["bus", "--scenario", "firmware_2500us", "--bitrate", "125000"]) == 2
    assert "unbounded" in capsys.readouterr().err


def test_bus_of_another_database(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "small.dbc"
    file.write_text(
        'VERSION ""\nBU_: A\nBO_ 256 First: 8 A\n SG_ S : 0|8@1+ (1,0) [0|0] "" Vector__XXX\n'
        'BA_DEF_ BO_ "GenMsgCycleTime" INT 0 65535;\nBA_DEF_DEF_ "GenMsgCycleTime" 0;\n'
        'BA_ "GenMsgCycleTime" BO_ 256 10;\n'
    )
    assert cli.main(["bus", "--dbc", str(file), "--json"]) == 0
    (message,) = json.loads(capsys.readouterr().out)["messages"]
    assert message["worst_case_s"] == pytest.approx(135 * 2e-6)  # standard frame, 8 bytes
    file.write_text("nonsense")
    assert cli.main(["bus", "--dbc", str(file)]) == 2
    assert cli.main(["bus", "--dbc", str(file), "--scenario", "lab_n_b"]) == 2
    assert cli.main(["bus", "--bitrate", "3"]) == 2
    told = capsys.readouterr().err.splitlines()
    assert len(told) == 3


def test_convert_writes_once_and_refuses_the_rest(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source, target = tmp_path / "bus.log", tmp_path / "bus.asc"
    source.write_text(LOG)
    assert cli.main(["convert", str(source), str(target), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["written"] == 1
    assert cli.main(["convert", str(source), str(target)]) == 2
    assert "stands there" in capsys.readouterr().err
    assert cli.main(["convert", str(source), str(target), "--force"]) == 0
    assert cli.main(["convert", str(tmp_path / "no.log"), str(tmp_path / "x.asc")]) == 2
    assert cli.main(["convert", str(source), str(tmp_path / "x.wav")]) == 2
    assert "Traceback" not in capsys.readouterr().err


def test_node_on_no_channel_and_over_records_of_another(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["node", "controller", "--channel", "nocan9"]) == 2
    assert "nocan9" in capsys.readouterr().err
    assert cli.main(["node", "driver", "--channel", "local:x"]) == 2
    out = tmp_path / "made"
    assert cli.main(["node", "plant", "--channel", "nocan9", "--out", str(out)]) == 2
    assert "nocan9" in capsys.readouterr().err and not out.exists()
    (tmp_path / "plant.trace").write_text("")
    assert cli.main(["node", "plant", "--channel", "local:x", "--out", str(tmp_path)]) == 2
    assert "plant.trace: stands there" in capsys.readouterr().err


def test_a_participants_process_runs_this_code_whatever_lies_around(tmp_path: Path) -> None:
    for name in ("sil", "controller", "can_dbc"):
        (tmp_path / f"{name}.py").write_text("raise SystemExit('another program')")
    (tmp_path / build.SCENARIO).write_text(
        json.dumps({"scenario": scenario.expanded(scenario.load("lab_n_b").scenario)})
    )
    command = build.node_command("controller", "nocan9", tmp_path)
    done = subprocess.run(
        command, cwd=tmp_path, capture_output=True, text=True, check=False, timeout=60
    )
    assert done.returncode == 2 and "nocan9" in done.stderr


@pytest.mark.parametrize("command", ["run", "simulate", "diagnose", "whatif", "replay", "convert"])
@pytest.mark.parametrize("name", ["x" * 5000, "loop/campaign"])
def test_a_path_that_cannot_exist_is_bad_input(
    command: str,
    name: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("loop").symlink_to("loop")
    words = [command, name, "out.log"] if command == "convert" else [command, name]
    assert cli.main(words) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"opc4 {command}: ") and ("expected" in line or "nearest" in line)
    assert {path.name for path in tmp_path.iterdir()} == {"loop"}

"""`opc4 bus`: transports, load and worst-case response times."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from can_dbc.contract import DBC_PATH
from sil import cli


def test_bus_prints_transports_load_and_worst_cases(capsys: pytest.CaptureFixture[str]) -> None:
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


def test_a_database_that_is_no_file_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    os.mkfifo(tmp_path / "pipe")
    for path in ("/dev/zero", str(tmp_path / "pipe")):
        assert cli.main(["bus", "--dbc", path]) == 2
        line = f"opc4 bus: {path}: is a device or pipe; expected a DBC file\n"
        assert capsys.readouterr().err == line


def test_the_database_is_printed_as_it_is(capsys: pytest.CaptureFixture[str]) -> None:
    text = Path(DBC_PATH).read_text()
    assert cli.main(["bus", "--dbc"]) == 0
    assert capsys.readouterr().out == text
    assert cli.main(["bus", "--dbc", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {"dbc": text}

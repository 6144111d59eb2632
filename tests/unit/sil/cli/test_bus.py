"""`opc4 bus`: transports, load and worst-case response times."""

from __future__ import annotations

import json
import os
import random
from pathlib import Path

import pytest

from can_dbc.contract import DBC_PATH
from sil import cli
from sil.logs import LogFrame, open_writer


def test_bus_prints_transports_load_and_worst_cases(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["bus", "--json"]) == 0
    output = json.loads(capsys.readouterr().out)
    assert output["transports"]["inproc"] and output["transports"]["local"]
    assert [m["name"] for m in output["messages"]][:2] == ["ValveCommand", "SafetyBlow"]
    # The first waits for one frame under way and itself: two of the longest, 160 bits each.
    assert output["messages"][0]["worst_case_s"] == pytest.approx(2 * 160 * 2e-6)
    assert all(m["in_time"] for m in output["messages"])


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
    assert cli.main(["bus", "--bitrate", "0"]) == 2
    assert cli.main(["bus", "--bitrate", "3"]) == 2
    assert cli.main(["bus", "--channel", "can0"]) == 2
    output = capsys.readouterr().err.splitlines()
    assert len(output) == 5 and output[4].endswith("--channel: given without --log; expected both")


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


def test_periods_and_jitter_measured_from_a_log(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    dbc = tmp_path / "truck.dbc"
    dbc.write_text(
        'VERSION ""\nBU_: A\nBO_ 2364540158 EEC1: 8 A\n SG_ S : 0|8@1+ (1,0) [0|0] "" A\n'
        'BO_ 256 Plain: 4 A\n SG_ T : 0|8@1+ (1,0) [0|0] "" A\n'
    )
    assert cli.main(["bus", "--dbc", str(dbc)]) == 2
    error = capsys.readouterr().err
    assert f"{dbc}: no message has a cycle time" in error and "--log" in error
    rng = random.Random(4)
    frames = [LogFrame(n * 20_000_000, 0x0CF00400, bytes(8)) for n in range(500)]
    frames += [
        LogFrame(n * 50_000_000 + rng.randrange(4_000_000), 0x100, b"ab", False) for n in range(200)
    ]
    frames += [LogFrame(rng.randrange(10**10), 0x18EF0003, bytes(8)) for _ in range(100)]
    frames += [LogFrame(5, 0x123, b"", False)]
    log = tmp_path / "a.log"
    with open_writer(log) as writer:
        for frame in sorted(frames, key=lambda frame: frame.time_ns):
            writer.write(frame._replace(channel="can0"))
    assert cli.main(["bus", "--dbc", str(dbc), "--log", str(log), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    by_name = {m["name"]: m for m in found["messages"]}
    assert set(by_name) == {"EEC1 of 00", "Plain", "18EF0003 ~"}
    assert by_name["EEC1 of 00"]["period_s"] == pytest.approx(0.02)
    assert by_name["EEC1 of 00"]["jitter_s"] == pytest.approx(0.0, abs=1e-6)
    assert by_name["Plain"]["period_s"] == pytest.approx(0.05, abs=3e-4)
    assert 0.002 < by_name["Plain"]["jitter_s"] < 0.0045
    assert by_name["18EF0003 ~"]["period_s"] == pytest.approx(0.1, rel=0.03)
    assert any("1 message too rare" in note for note in found["notes"])
    assert any("1 message not periodic" in note for note in found["notes"])


def test_the_period_of_intervals_that_alternate_is_their_mean(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = tmp_path / "a.log"
    with open_writer(log) as writer:
        for n in range(400):
            if n % 50:  # every 50th frame is lost
                late_ns = 190_000 * (n % 2)
                writer.write(LogFrame(n * 10_000_000 + late_ns, 0x100, b"", False, channel="can0"))
    assert cli.main(["bus", "--log", str(log), "--json"]) == 0
    (message,) = json.loads(capsys.readouterr().out)["messages"]
    assert message["period_s"] == pytest.approx(0.01, abs=1e-6)
    assert message["jitter_s"] == pytest.approx(190e-6, abs=1e-6)


def test_a_log_of_several_buses_needs_a_channel(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = tmp_path / "a.log"
    with open_writer(log) as writer:
        for n in range(100):
            writer.write(LogFrame(n * 10_000_000, 0x100 + n % 2, b"", False, channel=f"can{n % 2}"))
    assert cli.main(["bus", "--log", str(log)]) == 2
    assert "channels can0, can1; expected one bus, by --channel" in capsys.readouterr().err
    assert cli.main(["bus", "--log", str(log), "--channel", "can1", "--json"]) == 0
    (message,) = json.loads(capsys.readouterr().out)["messages"]
    assert (message["can_id"], message["period_s"]) == ("00000101", 0.02)

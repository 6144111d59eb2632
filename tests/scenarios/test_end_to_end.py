"""The loop closes: one command runs a gear shift over CAN and leaves everything on disk."""

from __future__ import annotations

import csv
import json
import subprocess
from collections.abc import Callable
from pathlib import Path

from sil.simulation import load_scenario, runner

Run = Callable[..., subprocess.CompletedProcess[str]]


def test_full_shift_from_the_command_line(opc4: Run, tmp_path: Path) -> None:
    done = opc4("run", "full_shift", "--out", "first", "--json", "--junit", "junit.xml")
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    assert result["passed"] is True
    assert result["complete"] is True
    assert result == json.loads((tmp_path / "first" / "result.json").read_text())

    shifts = result["metrics"]["shifts"]
    assert [(s["from_gear"], s["to_gear"]) for s in shifts] == [
        ("backward", "neutral"),
        ("neutral", "forward"),
    ]
    for shift in shifts:
        instants = [
            shift[f"{name}_s"]
            for name in (
                "requested",
                "commanded",
                "valve_open",
                "first_motion",
                "arrived",
                "confirmed",
            )
        ]
        assert instants == sorted(instants)
        assert 0.004 < shift["valve_open_s"] - shift["commanded_s"] < 0.0085
    assert all(check["passed"] for check in result["expectations"])

    with (tmp_path / "first" / "trace.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert float(rows[0]["position_m"]) == 0.01285
    assert float(rows[-1]["position_m"]) == -0.01285
    assert {r["valve_F"] for r in rows} == {"0", "1"}

    import can

    with can.LogReader(str(tmp_path / "first" / "bus.log")) as log:
        frames = list(log)
    assert len(frames) == result["metrics"]["frames"] > 500
    assert (tmp_path / "first" / "shift.png").read_bytes().startswith(b"\x89PNG")
    page = (tmp_path / "first" / "report.html").read_text()
    assert "http://" not in page and "https://" not in page
    assert (tmp_path / "junit.xml").read_text().count("<testcase") == len(result["expectations"])


def test_same_run_twice_gives_the_same_bits(tmp_path: Path) -> None:
    hashes = []
    for number in ("1", "2"):
        (tmp_path / number).mkdir()
        hashes.append(
            runner.run(load_scenario.load("full_shift"), tmp_path / number).result.trace_sha256
        )
    assert hashes[0] == hashes[1] and len(hashes[0] or "") == 64
    for file in ("bus.log", "trace.csv", "events.jsonl"):
        assert (tmp_path / "1" / file).read_bytes() == (tmp_path / "2" / file).read_bytes()

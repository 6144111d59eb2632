"""A truck's log through `opc4 replay`: each recorded shift next to ours, as a user calls it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from sil.cli import main
from tests.unit.sil.log_replay.truck_synthesis import (
    DRIVE,
    Truck,
    write_log,
)

Capture = pytest.CaptureFixture[str]


def replayed(log: Path, capsys: Capture, *options: str) -> dict[str, Any]:
    """What `opc4 replay LOG --json` prints; its exit code is in "code"."""
    code = main(
        ["replay", str(log), "--out", str(log.with_suffix("")), "--force", "--json", *options]
    )
    found: dict[str, Any] = json.loads(capsys.readouterr().out)
    return found | {"code": code}


ONE = Truck(drive=DRIVE[:1], end_ms=6_000)


def test_a_log_of_a_truck_gives_the_comparison_page(tmp_path: Path, capsys: Capture) -> None:
    log = write_log(tmp_path / "truck.asc", Truck().frames())
    assert main(["replay", str(log), "--out", str(tmp_path / "out")]) == 0
    printed = capsys.readouterr().out
    assert "3 shifts in" in printed and "2. 4 to 5: " in printed and " quicker: " in printed
    found = json.loads((tmp_path / "out/diff.json").read_text())
    for made, shift in zip(DRIVE, found["shifts"], strict=True):
        assert (shift["from_gear"], shift["to_gear"]) == (made.before, made.after)
        times = shift["recorded"]["times_s"]
        assert times["torque_cut"] == pytest.approx(made.cut_ms / 1e3, abs=0.025)
        assert 0.0 <= times["disengaged"] - made.out_ms / 1e3 <= 0.1
        assert times["synchronised"] == pytest.approx(made.fall_to_ms / 1e3, abs=0.06)
        assert 0.0 <= times["engaged"] - made.in_ms / 1e3 <= 0.1
        assert times["torque_back"] == pytest.approx(made.back_ms / 1e3, abs=0.05)
        assert shift["ours"][0]["reached"] and shift["in_statistics"]
    files = {path.name for path in (tmp_path / "out").iterdir()}
    assert {"diff.txt", "report.html", "shifts.png", "shift_1.png", "shift_3.svg"} <= files
    page = (tmp_path / "out/report.html").read_text()
    assert page.count("<img") == 4 and "odd gears forward" in page

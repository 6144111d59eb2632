"""`opc4 replay` as a user calls it: on the log of a run, as it was and with a changed firmware."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Callable
from pathlib import Path

Run = Callable[..., subprocess.CompletedProcess[str]]


def test_a_run_replayed_as_it_was_and_without_its_filter(opc4: Run, tmp_path: Path) -> None:
    assert opc4("run", "lab_n_b", "--out", "run", "--no-report").returncode == 0

    same = opc4("replay", "run/bus.log", "--out", "same")
    assert same.returncode == 0, same.stderr
    assert "no difference" in same.stdout
    told = json.loads((tmp_path / "same/diff.json").read_text())
    assert told["differs"] is False
    assert told["frames"]["accounted"] == told["frames"]["total"] > 500

    changed = opc4("replay", "run/bus.log", "--set", "controller.filter=false", "--out", "changed")
    assert changed.returncode == 1, changed.stderr
    assert "earlier" in changed.stdout and "samples" in changed.stdout
    for name in ("diff.json", "diff.txt", "report.html"):
        assert (tmp_path / "changed" / name).stat().st_size > 0
    assert "first difference" in (tmp_path / "changed/diff.txt").read_text()


def test_a_log_in_which_nothing_was_engaged_is_no_success(opc4: Run, tmp_path: Path) -> None:
    (tmp_path / "idle.log").write_text("(0000000000.000500) can0 123#00\n")
    refused = opc4("replay", "idle.log")
    assert refused.returncode == 2
    assert refused.stderr.count("\n") == 1 and "idle.log" in refused.stderr

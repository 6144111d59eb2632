"""`opc4 run` and `sil.run` judge a run alike: the same checks with the same values."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import msgspec
import pytest

import sil
from plant.integrator.hybrid import Balance
from plant.node import PlantNode
from sil.cli import main
from sil.files.overrides import setting_texts
from sil.recording import run_record
from sil.rules.shipped import RULES
from sil.simulation.load_scenario import read
from sil.swarm.hunt import attempt

LATE, BALANCES = "frames later than their worst case", "mass and energy balances"
CASES = (
    ("lab_n_b", {}, ""),
    ("full_shift", {}, ""),
    ("lost_frames", {}, ""),
    ("lab_n_b", {"duration_s": 0.15, "expect": {}}, "request for backward"),
    ("firmware_2500us", {"bus.bitrate": 250_000, "duration_s": 0.3}, LATE),
    ("lab_b_n", {}, BALANCES),
)


def leaking(node: PlantNode) -> Balance:
    return dataclasses.replace(node.stroke.balance(), energy_residual_j=1.0)


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("piece_s", [run_record.PIECE_S, 0.07])
def test_one_judgement(
    case: Any, piece_s: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    name, settings, fails = case
    if fails == BALANCES:
        monkeypatch.setattr(PlantNode, "balance", leaking)
    monkeypatch.setattr(run_record, "PIECE_S", piece_s)
    words = [word for text in setting_texts(settings) for word in ("--set", text)]
    main(["run", name, *words, "--strict", "--no-report", "--out", str(tmp_path / "r")])
    stored = json.loads((tmp_path / "r" / "result.json").read_text())
    run = sil.run(name, settings)
    failed = [check.name for check in run.checks if not check.passed]
    assert msgspec.to_builtins(run.checks) == stored["expectations"]
    assert fails in failed if fails else not failed
    for field in ("passed", "metrics", "balances", "warnings", "trace_sha256"):
        assert msgspec.to_builtins(getattr(run, field)) == stored[field], field
    assert run.bus.items() <= stored["bus"].items()


def test_the_swarm_finds_an_open_balance(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(PlantNode, "balance", leaking)
    (broken,) = attempt(read("lab_b_n")[0], RULES).violations
    assert broken.rule == "mass_and_energy_balances"

"""The list of claims: complete, honest, and its quick rows hold."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from can_dbc.errors import InputError
from sil.claims.claim import Claim, all_claims, check, chosen
from sil.cli import main

VERDICTS = {"met", "partly", "not met", "cannot be shown", "given"}
NEEDS_LOOP = {"F02", "F07", "F08", "F09", "F10", "F14", "F46", "F47", "F49", "F50"}
NOT_MET = {"F09", "F25", "F41", "F31", "F58", "F62"}


def test_every_number_from_1_to_64_has_a_row() -> None:
    numbers = [item.id for item in all_claims()]
    assert numbers == sorted(set(numbers), key=lambda n: (int(n[1:3]), n))
    assert {f"F{k:02d}" for k in range(1, 65)} <= set(numbers)
    assert "F34b" in numbers


def test_unknown_claim_names_the_nearest() -> None:
    with pytest.raises(InputError, match=r"F99.*expected one of F"):
        chosen(["F99"])


@pytest.fixture(scope="module")
def findings() -> dict[str, Claim]:
    return {item.id: check(item) for item in all_claims() if item.id not in NEEDS_LOOP}


def test_verdicts_are_those_of_a_careful_reader(findings: dict[str, Claim]) -> None:
    assert {f.verdict for f in findings.values()} <= VERDICTS
    assert {n for n, f in findings.items() if f.verdict == "not met"} == NOT_MET - NEEDS_LOOP
    met = [n for n, f in findings.items() if f.verdict == "met"]
    assert len(met) >= 35
    given = {n for n, f in findings.items() if f.verdict == "given"}
    assert given == {"F05", "F35", "F44", "F45"}


def test_what_is_not_met_says_why(findings: dict[str, Claim]) -> None:
    for finding in findings.values():
        assert finding.achieved
        if finding.verdict != "met":
            assert len(finding.reason) > 20, finding.id


def test_a_false_claim_is_not_met(monkeypatch: pytest.MonkeyPatch) -> None:
    """The check can fail: with half the friction, breakaway is not at 71 N."""
    from sil.claims import strokes

    weak = strokes.nominal().override({"friction_fixed.F_sf": 35.5, "friction_fixed.F_rf": 20.0})
    monkeypatch.setattr(strokes, "nominal", lambda: weak)
    (breakaway,) = chosen(["F26"])
    assert check(breakaway).verdict == "not met"


@pytest.mark.slow
def test_the_closed_loop_rows() -> None:
    found = {item.id: check(item) for item in all_claims() if item.id in NEEDS_LOOP}
    assert {n for n, f in found.items() if f.verdict == "not met"} == {"F09"}


def test_command_writes_a_table(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["claims", "F16", "F26", "--json", "--out", str(tmp_path / "c")]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert [row["verdict"] for row in printed["claims"]] == ["met", "met"]
    assert (tmp_path / "c" / "claims.md").read_text().count("\n") == 4


def test_the_quickest_soft_stop_is_bang_bang_only_if_the_signs_say_so() -> None:
    """A start far from the push ends at the same point; a control there that is half open costs time."""
    from sil.claims.optimal import INTERVALS, quickest

    u, late_ms, slope = quickest(np.concatenate([np.full(INTERVALS, 0.8), np.full(INTERVALS, 0.1)]))
    assert late_ms == pytest.approx(18.056, abs=2e-3)
    assert ((u < 0.02) | (u > 0.98))[:8].all() and u[:8].min() > 0.98
    assert slope[:8].max() < -0.1 and slope[INTERVALS : INTERVALS + 8].min() > 0.1


def test_judged_anew_says_what_changed(capsys: pytest.CaptureFixture[str]) -> None:
    changed = {item.id for item in all_claims() if item.changed}
    assert {"F05", "F32", "F41", "F49", "F64"} <= changed and len(changed) >= 12
    assert main(["claims", "F41"]) == 0
    assert "judged anew: " in capsys.readouterr().out

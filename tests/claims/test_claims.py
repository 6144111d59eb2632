"""The list of claims: complete, honest, and docs/claims.md is what the simulation gives now."""

from __future__ import annotations

import numpy as np
import pytest

from tests.claims import strokes
from tests.claims.claim import Claim, all_claims, check, markdown
from tests.claims.optimal import INTERVALS, quickest
from tests.conftest import ROOT

NOT_MET = {"F09", "F25", "F41", "F31", "F58", "F62"}
CLAIMS = {item.id: item for item in all_claims()}


def test_every_number_from_1_to_64_has_a_row() -> None:
    assert {f"F{k:02d}" for k in range(1, 65)} | {"F34b"} <= set(CLAIMS)


@pytest.fixture(scope="module")
def findings() -> dict[str, Claim]:
    return {name: check(item) for name, item in CLAIMS.items()}


def test_verdicts_are_those_of_a_careful_reader(findings: dict[str, Claim]) -> None:
    by_verdict: dict[str, set[str]] = {}
    for name, finding in findings.items():
        by_verdict.setdefault(finding.verdict, set()).add(name)
    assert set(by_verdict) <= {"met", "partly", "not met", "cannot be shown", "given"}
    assert by_verdict["not met"] == NOT_MET
    assert by_verdict["given"] == {"F05", "F35", "F44", "F45"}
    assert len(by_verdict["met"]) >= 35


def test_what_is_not_met_says_why(findings: dict[str, Claim]) -> None:
    for finding in findings.values():
        assert finding.achieved
        assert finding.verdict == "met" or len(finding.reason) > 20, finding.id


def test_a_false_claim_is_not_met(monkeypatch: pytest.MonkeyPatch) -> None:
    """The check can fail: with half the friction, breakaway is not at 71 N."""
    weak = strokes.nominal().override({"friction_fixed.F_sf": 35.5, "friction_fixed.F_rf": 20.0})
    monkeypatch.setattr(strokes, "nominal", lambda: weak)
    assert check(CLAIMS["F26"]).verdict == "not met"


def test_the_page_of_claims_is_up_to_date(findings: dict[str, Claim]) -> None:
    stored = (ROOT / "docs" / "claims.md").read_text(encoding="utf-8")
    assert stored == markdown(findings.values()), "run `python -m tests.claims`"
    assert stored.count("| not met |") == len(NOT_MET)


def test_the_quickest_soft_stop_is_bang_bang_only_if_the_signs_say_so() -> None:
    """A start far from the push ends at the same point; a control there that is half open costs time."""
    u, late_ms, slope = quickest(np.concatenate([np.full(INTERVALS, 0.8), np.full(INTERVALS, 0.1)]))
    assert late_ms == pytest.approx(18.056, abs=2e-3)
    assert ((u < 0.02) | (u > 0.98))[:8].all() and u[:8].min() > 0.98
    assert slope[:8].max() < -0.1 and slope[INTERVALS : INTERVALS + 8].min() > 0.1

"""What an extended model changes in the loop: as two runs say, or why it cannot be applied there."""

from __future__ import annotations

from pathlib import Path

import pytest

from sil import run
from sil.inference.campaign.consequence import SCENARIOS, consequence


def model(folder: Path, effect: str) -> Path:
    file = folder / "extended_model.toml"
    file.write_text(f'[base]\nmodel = "nominal"\n{effect}\n', encoding="utf-8")
    return file


def test_more_friction_makes_every_shift_later_and_softer(tmp_path) -> None:
    effect = '[effect.dynamic_friction]\nfactor = { value = 3.0, unit = "-", source = "made" }'
    found = consequence("nominal", model(tmp_path, effect))
    assert not found.refused and {item.scenario for item in found.shifts} == set(SCENARIOS)
    for item in found.shifts:
        before, after = item.shift_time_s
        assert before is not None and after is not None and before < after
        fast, slow = item.impact_speed_m_s
        assert fast is not None and slow is not None and slow < fast
    alone = run("lab_n_b").shifts[0]
    first = found.shifts[0]
    assert (first.scenario, first.shift) == ("lab_n_b", "neutral to backward")
    assert first.impact_speed_m_s[0] == alone.impact_speed_m_s
    assert first.impact_speed_m_s[1] == pytest.approx(0.552, abs=0.01)
    assert first.shift_time_s[0] == alone.shift_time_s


def test_what_belongs_to_the_instruments_says_so(tmp_path) -> None:
    effect = '[effect.gauge_line_lag]\nlag_s = { value = 0.002, unit = "s", source = "made" }'
    found = consequence("nominal", model(tmp_path, effect))
    assert not found.shifts and "instruments" in found.refused

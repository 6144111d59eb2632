"""From a campaign folder to verdict, extended model and page."""

from __future__ import annotations

import json
import os

import pytest

from plant.parameters import Parameter, ParameterSet, load
from sil.files.output_folder import finite
from sil.inference.campaign.diagnosis import diagnose
from sil.inference.campaign.page import write_report
from tests.support.cylinder_model import model as cylinder_model
from tests.support.made_campaign import made

pytestmark = pytest.mark.slow

KEYS = {
    "format",
    "campaign",
    "verdict",
    "causes",
    "rivals",
    "next_experiment",
    "gain",
    "false_alarm",
    "extended_model",
}


def test_a_clean_campaign_is_consistent(clean) -> None:
    found = diagnose(clean, load(), workers=1)
    plain = json.loads(json.dumps(found.as_json()))
    assert set(plain) >= KEYS
    assert plain["verdict"] == "consistent"
    assert plain["causes"] == [] and plain["extended_model"] is None
    assert plain["gain"]["standardised"]["before"] == pytest.approx(1.0, abs=0.12)


def test_a_hidden_effect_is_named_with_its_gain_and_model(tmp_path) -> None:
    base = load()
    hidden = {"exhaust_clog": {"factor": Parameter(0.75, "-", "hidden by the test")}}
    parameters = ParameterSet(base.name, base.entries, hidden)
    campaign = made(tmp_path / "campaign", parameters, seed=11, count=6)
    found = diagnose(campaign, base, workers=1)
    assert found.verdict.kind == "named"
    cause = found.causes[0]
    assert cause.id == "exhaust_clog" and cause.probability > 0.9
    factor = cause.parameters["factor"]
    assert factor.low < factor.value < factor.high < 0.85
    assert factor.value == pytest.approx(0.75, abs=0.03)
    assert found.gain.before > 1.5 and found.gain.after < 1.1
    assert found.extended is not None
    path = tmp_path / "extended_model.toml"
    path.write_text(found.extended, encoding="utf-8")
    extended = load(path)
    assert extended.effects["exhaust_clog"]["factor"].value == pytest.approx(factor.value)
    plain = json.loads(
        json.dumps(finite(write_report(found, tmp_path, "measured/ --model nominal")))
    )
    assert plain["explanations"][0]["behind"] == 0.0 and plain["explanations"][0]["left_over"] < 1.1
    assert plain["relative_errors"]["position_m"]["after"]["mean"] < 0.01
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert {"strokes.png", "strokes.svg"} <= set(os.listdir(tmp_path))
    assert "exhaust_clog" in text and "http://" not in text and "https://" not in text
    assert "opc4 diagnose measured/ --model nominal" in text
    again = diagnose(campaign, extended, workers=1)
    assert again.verdict.kind == "consistent"


FIXED = (("fixed", 900000.0), ("fixed", 600000.0), ("fixed", 750000.0), ("fixed", 900000.0))
LENGTH = (("N-B", 900000.0), ("B-N", 750000.0), ("N-F", 600000.0), ("F-N", 900000.0))


@pytest.mark.parametrize(
    ("rig", "delay_s", "closes"),
    [
        ("fixed", 0.003, False),
        ("fixed", 0.006, True),
        ("length", 0.006, False),
        ("length", 0.003, True),
        ("cylinder", 0.006, False),
        ("cylinder", 0.006, True),
    ],
)
def test_late_valves_are_named_or_rivals(tmp_path, rig: str, delay_s: float, closes: bool) -> None:
    base = load()
    if rig == "cylinder":
        base = load(cylinder_model(tmp_path))
    hidden = {"valve_open_delay": {"delay_s": Parameter(delay_s, "s", "hidden by the test")}}
    parameters = ParameterSet(base.name, base.entries, hidden)
    kinds = LENGTH if rig == "length" else FIXED
    campaign = made(tmp_path / "late", parameters, kinds=kinds, closes=closes)
    found = diagnose(campaign, base, workers=1)
    assert found.verdict.kind != "consistent"
    rivals = {name for group in found.verdict.rivals for name in group}
    assert "valve_open_delay" in {*found.verdict.claimed, *rivals}

"""The whole diagnosis of campaigns, with effects of one's own too."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from plant.effects import CATALOGUE, overridden
from plant.effects.user_file import _LOADED, load_effects
from plant.parameters import Parameter, ParameterSet, load
from sil.files.output_folder import finite
from sil.inference.campaign.diagnosis import diagnose
from sil.inference.campaign.page import write_report
from tests.physics.test_cylinder import proportional
from tests.support.cylinder_model import model as cylinder_model
from tests.support.made_campaign import made

pytestmark = pytest.mark.slow


def test_a_clean_campaign_is_consistent(clean) -> None:
    plain = json.loads(json.dumps(diagnose(clean, load(), workers=1).as_json()))
    assert plain.keys() >= {"format", "campaign", "verdict", "causes", "rivals"}
    assert plain.keys() >= {"next_experiment", "gain", "false_alarm", "extended_model"}
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
    assert diagnose(campaign, extended, workers=1).verdict.kind == "consistent"


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


SEAL = Path(__file__).resolve().parents[2] / "plant" / "effects" / "end_seal.py"
CYLINDER = tuple(("fixed", 1e5 * bar) for bar in (7, 5, 8, 6, 7, 5))


RUNAWAY = '''"""A force that grows so fast with speed that large values cannot be simulated."""

from plant.effects.added_term import Slot, added_term
from plant.effects.effect import EffectParameter, effect


@added_term(Slot.FORCE)
def push(speed_m_s, gain):
    """Return the force along the motion [N]."""
    return gain * speed_m_s**5


@effect(
    "runaway",
    "mechanics",
    "force",
    "a force that grows with the fifth power of the speed",
    EffectParameter("gain", "N s5/m5", neutral=0.0, low=0.0, high=2e4, typical=60.0, sign=1),
)
def runaway(setup, values):
    """Force gain v^5 along the motion."""
    push.add_to(setup, **values)
'''


@pytest.fixture
def own_effects():
    yield load_effects
    for _digest, names in _LOADED.values():
        for name in names:
            CATALOGUE.pop(name, None)
    _LOADED.clear()


@pytest.fixture
def seal(own_effects):
    return own_effects(str(SEAL))


@pytest.mark.parametrize(
    "hidden",
    [
        {"effect.end_seal.force_n": 80.0, "effect.end_seal.length_m": 0.002},
        {"effect.back_pressure.pressure_pa": 3e4},
        {"effect.end_cushion.stiffness_n_m": 1e5, "effect.end_cushion.thickness_m": 0.003},
    ],
    ids=lambda hidden: next(iter(hidden)).split(".")[1],
)
def test_a_hidden_effect_is_named(tmp_path, seal, hidden) -> None:
    campaign = made(tmp_path / "campaign", overridden(load(), hidden), seed=11, count=6)
    found = diagnose(campaign, load(), workers=1)
    assert found.verdict.kind == "named"
    cause = found.causes[0]
    assert cause.id == next(iter(hidden)).split(".")[1] and cause.probability > 0.9
    for path, value in hidden.items():
        item = cause.parameters[path.split(".")[2]]
        assert item.low - 0.2 * value < value < item.high + 0.2 * value
    assert found.gain.before > 1.2 and found.gain.after < 1.1


def test_values_that_cannot_be_simulated_are_reported(tmp_path, own_effects) -> None:
    (tmp_path / "runaway.py").write_text(RUNAWAY, encoding="utf-8")
    own_effects(str(tmp_path / "runaway.py"))
    hidden = overridden(load(), {"effect.runaway.gain": 4.0})
    found = diagnose(made(tmp_path / "campaign", hidden, seed=11, count=5), load(), workers=2)
    assert found.causes[0].id == "runaway"
    (reported,) = [text for text in map(str, found.findings) if "cannot be simulated" in text]
    tried = found.refusals["runaway"]
    assert reported == f"made: runaway: {tried}" and 0 < tried.refused < tried.tried
    plain = write_report(found, tmp_path, "measured/")
    assert reported in (tmp_path / "report.html").read_text(encoding="utf-8")
    by_name = {item["name"]: item for item in plain["explanations"]}
    first, healthy = by_name["runaway"], by_name["healthy"]
    assert (first["refused"], first["tried"]) == (tried.refused, tried.tried)
    counts = found.refusals["healthy"]
    assert (healthy["refused"], healthy["tried"]) == (counts.refused, counts.tried)


@pytest.mark.parametrize("valves", [cylinder_model, proportional])
def test_a_hidden_effect_of_a_users_cylinder_is_named(tmp_path, valves) -> None:
    base = load(valves(tmp_path, acting=2.0))
    hidden = overridden(base, {"effect.exhaust_clog.factor": 0.4})
    campaign = made(tmp_path / "campaign", hidden, seed=11, count=6, kinds=CYLINDER)
    found = diagnose(campaign, base, workers=1)
    assert found.verdict.kind == "named" and found.causes[0].id == "exhaust_clog"
    assert found.causes[0].parameters["factor"].value == pytest.approx(0.4, abs=0.1)


@pytest.mark.parametrize("valves", [cylinder_model, proportional])
def test_a_clean_campaign_of_a_users_cylinder_is_consistent(tmp_path, valves) -> None:
    base = load(valves(tmp_path))
    campaign = made(tmp_path / "campaign", base, seed=12, count=6, kinds=CYLINDER)
    assert diagnose(campaign, base, workers=1).verdict.kind == "consistent"

"""A user's effect, new effects of the catalogue and a user's cylinder: named where they are hidden."""

from __future__ import annotations

from pathlib import Path

import pytest

from plant.effects import CATALOGUE, overridden
from plant.effects.user_file import _LOADED, load_effects
from plant.parameters import load
from sil.inference.campaign.diagnosis import diagnose
from sil.inference.campaign.page import write_report
from tests.physics.test_cylinder import proportional
from tests.support.cylinder_model import model
from tests.support.made_campaign import made

pytestmark = pytest.mark.slow

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


EFFECTS = (runaway,)
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
    campaign = made(tmp_path / "campaign", hidden, seed=11, count=5)
    found = diagnose(campaign, load(), workers=2)
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


@pytest.mark.parametrize("valves", [model, proportional])
def test_a_hidden_effect_of_a_users_cylinder_is_named(tmp_path, valves) -> None:
    base = load(valves(tmp_path, acting=2.0))
    hidden = overridden(base, {"effect.exhaust_clog.factor": 0.4})
    campaign = made(tmp_path / "campaign", hidden, seed=11, count=6, kinds=CYLINDER)
    found = diagnose(campaign, base, workers=1)
    assert found.verdict.kind == "named" and found.causes[0].id == "exhaust_clog"
    assert found.causes[0].parameters["factor"].value == pytest.approx(0.4, abs=0.1)


@pytest.mark.parametrize("valves", [model, proportional])
def test_a_clean_campaign_of_a_users_cylinder_is_consistent(tmp_path, valves) -> None:
    base = load(valves(tmp_path))
    campaign = made(tmp_path / "campaign", base, seed=12, count=6, kinds=CYLINDER)
    assert diagnose(campaign, base, workers=1).verdict.kind == "consistent"

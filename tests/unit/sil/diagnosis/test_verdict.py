"""What is claimed, what is not, and who is a rival."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from plant.effects import CATALOGUE
from sil.diagnosis.judge import weigh
from sil.diagnosis.verdict import decide


def entry(
    score: float, held_chi2: float, *ids: str, beyond: float = 0.0, excess: float = 0.0
) -> SimpleNamespace:
    return SimpleNamespace(
        score=score,
        ids=ids,
        name="+".join(ids) or "healthy",
        prior=0.1 if len(ids) > 1 else 1.0,
        whole=SimpleNamespace(beyond=beyond, excess=excess, count=10000),
        held=SimpleNamespace(chi2=held_chi2),
        training=SimpleNamespace(candidates=[], scaled=[]),
        probability=0.0,
    )


def named(name: str) -> SimpleNamespace:
    """A candidate of a named effect with one fitted parameter."""
    return SimpleNamespace(id=name, parameters=(None,), is_term=False, effect=CATALOGUE[name])


def verdict(*entries: SimpleNamespace):
    weigh(entries)
    return decide(list(entries), 10)


def test_chance_gains_are_consistent() -> None:
    found = verdict(entry(1000.0, 500.0), entry(994.0, 495.0, "stribeck"))
    assert found.kind == "consistent" and found.claimed == ()


def test_a_clear_cause_is_named() -> None:
    found = verdict(
        entry(3000.0, 1500.0),
        entry(1000.0, 500.0, "exhaust_clog"),
        entry(1400.0, 700.0, "piston_leak"),
    )
    assert found.kind == "named" and found.claimed == ("exhaust_clog",)
    assert found.probabilities["exhaust_clog"] == pytest.approx(0.98, abs=0.02)
    assert found.gains["exhaust_clog"] == pytest.approx(2000.0)
    assert found.rivals == ()


def test_look_alikes_are_rivals_and_the_verdict_ambiguous() -> None:
    found = verdict(
        entry(3000.0, 1500.0),
        entry(1000.0, 500.0, "inlet_clog"),
        entry(1000.4, 500.0, "supply_low"),
    )
    assert found.kind == "ambiguous"
    assert found.rivals == (("inlet_clog", "supply_low"),)
    assert 0.5 < found.probabilities["inlet_clog"] < 0.7


def test_no_gain_on_held_out_strokes_is_no_cause() -> None:
    found = verdict(entry(3000.0, 500.0), entry(1000.0, 501.0, "stribeck"))
    assert found.kind == "consistent"


def test_a_second_cause_must_earn_its_place() -> None:
    single = entry(1000.0, 500.0, "dynamic_friction")
    assert verdict(
        entry(3000.0, 1500.0), single, entry(992.0, 495.0, "dynamic_friction", "stribeck")
    ).claimed == ("dynamic_friction",)
    assert verdict(
        entry(3000.0, 1500.0),
        entry(1000.0, 500.0, "dynamic_friction"),
        entry(600.0, 300.0, "dynamic_friction", "free_play"),
    ).claimed == ("dynamic_friction", "free_play")


def test_a_second_cause_must_explain_a_share_of_what_is_left() -> None:
    blip = verdict(
        entry(3000.0, 1500.0, excess=1e6),
        entry(1200.0, 500.0, "dynamic_friction", beyond=4000.0),
        entry(1100.0, 450.0, "dynamic_friction", "free_play", beyond=3900.0),
    )
    assert blip.claimed == ("dynamic_friction",)


def test_a_cause_that_leaves_much_is_doubted() -> None:
    found = verdict(
        entry(9000.0, 4500.0, excess=16000.0),
        entry(4000.0, 2000.0, "stribeck", beyond=6000.0),
    )
    assert found.claimed == ("stribeck",)
    assert found.probabilities["stribeck"] < 0.5 and found.kind == "ambiguous"


def test_a_tiny_second_cause_is_doubted_while_something_is_left() -> None:
    def training(*sizes: float) -> SimpleNamespace:
        ids = ("alpha_speed", "dead_volume_passive")
        return SimpleNamespace(
            candidates=[named(name) for name in ids],
            scaled=sizes,
        )

    def found(beyond: float):
        pair = entry(400.0, 200.0, "alpha_speed", "dead_volume_passive", beyond=beyond, excess=9.0)
        pair.training = training(0.16, 0.03)
        return verdict(entry(3000.0, 1500.0, excess=1e5), entry(1500.0, 700.0, "alpha_speed"), pair)

    assert found(50.0).probabilities["dead_volume_passive"] == pytest.approx(0.45)
    assert found(50.0).probabilities["alpha_speed"] > 0.9
    assert found(50.0).kind == "ambiguous"
    assert found(0.0).probabilities["dead_volume_passive"] > 0.9


def test_a_tiny_second_cause_that_gains_next_to_nothing_is_not_claimed() -> None:
    def found(size: float):
        pair = entry(900.0, 440.0, "seal_pressure_friction", "external_force")
        ids = ("seal_pressure_friction", "external_force")
        pair.training = SimpleNamespace(
            candidates=[named(name) for name in ids],
            scaled=(1.0, size),
        )
        return verdict(
            entry(100000.0, 50000.0, excess=2e5),
            entry(1000.0, 480.0, "seal_pressure_friction"),
            pair,
        )

    assert found(0.01).claimed == ("seal_pressure_friction",)
    assert "external_force" in found(0.3).claimed

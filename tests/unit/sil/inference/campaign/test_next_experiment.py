"""The strokes to measure next: what they can be, what they are worth, and the campaign file of them."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from can_dbc.errors import InputError
from plant.effects.stroke_conditions import StrokeConditions
from plant.parameters import load
from sil.campaign.campaign import ColumnMap, Recorder, campaign_toml, joined, load_campaign
from sil.inference.campaign.designs import described, designs, imagined
from sil.inference.campaign.diagnosis import available
from sil.inference.campaign.figures import next_figure
from sil.inference.campaign.model import CampaignModel
from sil.inference.campaign.next_experiment import (
    MOST,
    HypothesisInformation,
    Question,
    added,
    distances_of,
    healthy_with,
    information,
    next_experiment,
    separation_by,
)
from sil.inference.fit import Fitter
from sil.inference.thresholds import LIMITS
from sil.inference.verdict import Verdict, judge
from tests.support.made_campaign import made, model_of


def question(*probabilities: float) -> Question:
    numbers = range(len(probabilities))
    pairs = tuple((i, j) for i in numbers for j in numbers if i != j)
    return Question(tuple(numbers), np.array(probabilities), pairs)


# --- information ---------------------------------------------------------------------------------
def test_information_lies_between_nothing_and_the_entropy() -> None:
    asked = question(0.7, 0.2, 0.1)
    entropy = -sum(p * math.log(p) for p in (0.7, 0.2, 0.1))
    assert information(asked, dict.fromkeys(asked.pairs, 0.0)) == pytest.approx(0.0, abs=1e-12)
    assert information(asked, dict.fromkeys(asked.pairs, 1e6)) == pytest.approx(entropy)
    one_apart = {pair: 1e6 if 2 in pair else 0.0 for pair in asked.pairs}
    apart = -(0.9 * math.log(0.9) + 0.1 * math.log(0.1))
    assert information(asked, one_apart) == pytest.approx(apart)


def test_what_separates_another_pair_is_worth_more_than_the_same_again() -> None:
    asked = question(0.4, 0.3, 0.3)
    same = {pair: 2 * LIMITS.min_gain if 0 in pair else 0.0 for pair in asked.pairs}
    other = dict.fromkeys(asked.pairs, LIMITS.min_gain)
    assert information(asked, other) > information(asked, same)


# --- what a stroke tells --------------------------------------------------------------------------
def test_evidence_of_strokes_together_is_that_of_one_fit_to_all_of_them() -> None:
    rng = np.random.default_rng(5)
    prior = np.diag(rng.uniform(1.0, 3.0, 2))
    strokes = [(rng.normal(size=6), rng.normal(size=(6, 2))) for _ in range(3)]
    sums = {(0, 1): np.pad(prior, (0, 1))}
    for r, j in strokes:
        rows = np.column_stack([j, r])
        sums = added(sums, {(0, 1): rows.T @ rows})
    j = np.vstack([*(j for _r, j in strokes), np.sqrt(prior)])
    r = np.concatenate([*(r for r, _j in strokes), np.zeros(2)])
    left = r - j @ np.linalg.lstsq(j, r, rcond=None)[0]
    assert distances_of(sums)[0, 1] == pytest.approx(0.5 * left @ left)


def test_a_cause_that_a_tolerance_imitates_tells_less_than_one_that_none_does(clean_model) -> None:
    healthy = HypothesisInformation.of(Fitter(clean_model).fit(iterations=4))
    causes = {item.name: item for item in available(clean_model.strokes)}

    def distance(name: str) -> float:
        start = {(1, 0): np.pad(np.eye(len(healthy.shared)), (0, 1))}
        both = [healthy, healthy_with(healthy, causes[name], 0.25)]
        asked = [Question((1, 0), np.array([0.5, 0.5]), ((1, 0),))]
        model = CampaignModel(clean_model.strokes, clean_model.spread)
        separation = separation_by(Fitter(model), 0, both, asked)
        assert separation is not None
        return distances_of(added(start, separation))[1, 0]

    delay, leak = distance("valve_open_delay"), distance("piston_leak")
    # 0.45 ms is what a tolerance of 0.3 ms and scatter of 0.2 ms make: some two in squared deviations
    assert 0.0 < delay < 5.0
    assert leak > 20.0


# --- designs ---------------------------------------------------------------------------------------
def test_designs_vary_what_was_measured_and_nothing_else(clean_model) -> None:
    strokes = clean_model.strokes
    conditions = [entry.conditions for entry in designs(strokes, "next")]
    assert len(set(conditions)) == len(conditions) > 50
    assert {c.kind for c in conditions} == {s.conditions.kind for s in strokes}
    assert {c.load for c in conditions} == {"none"}
    assert {c.supply_pressure_pa for c in conditions} == {6e5, 7.5e5, 9e5}
    assert {c.rest_s for c in conditions} == {60.0}
    assert any(c.charged_before for c in conditions)
    assert set(conditions) >= {replace(s.conditions, progress=1.0) for s in strokes}


def test_one_supply_is_varied_downwards(tmp_path) -> None:
    model = model_of(made(tmp_path, count=1))
    supplies = {entry.conditions.supply_pressure_pa for entry in designs(model.strokes, "next")}
    low, high = sorted(supplies)
    assert high == 9e5
    assert low - 101325.0 == pytest.approx(2.0 / 3.0 * (high - 101325.0))


def test_the_figure_begins_just_before_the_first_command(clean_model) -> None:
    late = [e for e in designs(clean_model.strokes, "next") if e.conditions.commands[0][0] > 2.0]
    (stroke,) = imagined(late[:1], clean_model.strokes, load(), 1e4)
    numbers = np.zeros(stroke.total)
    entry = SimpleNamespace(entry=late[0])
    experiment = SimpleNamespace(
        shown=stroke, predicted={"a": numbers, "b": numbers + 1.0}, strokes=[entry]
    )
    (stack,) = next_figure(experiment).stacks
    low_ms, high_ms = stack.limits
    assert low_ms == pytest.approx(1e3 * late[0].conditions.commands[0][0] - 20.0)
    assert low_ms < high_ms == 1e3 * stroke.time_s[-1]
    titles = [panel.title for panel in stack.panels if panel.title != "apart"]
    assert titles[0] == "position"
    assert titles[1:] and all(title.endswith(", absolute") for title in titles[1:])


def test_a_stroke_that_does_not_arrive_is_not_proposed(clean_model) -> None:
    entries = designs(clean_model.strokes, "next")
    found = imagined(entries, clean_model.strokes, load(), 1e4)
    assert 0 < len(found) < len(entries)
    # 20 ms of the driving valve against a charged chamber: the stay stays where it is
    stuck = [
        e for e in entries if e.conditions.kind == "B-N" and "valve N open for 20 ms" in e.label
    ]
    left = {stroke.entry.file for stroke in found}
    against = [entry for entry in stuck if entry.conditions.charged_before]
    assert against and not left & {entry.file for entry in against}
    channels = {c.name: c.noise for s in clean_model.strokes for c in s.channels}
    assert all(c.noise == channels[c.name] for stroke in found for c in stroke.channels)


def test_conditions_in_words() -> None:
    commands = ((0.01, "N", 0.98), (0.01, "B", 0.0), (0.06, "N", 0.0))
    c = StrokeConditions("B-N", 7.5e5, commands, charged_before=("B",), load="damper", rest_s=2.0)
    text = "B-N, 7.5 bar, damper, B charged before, valve N open for 50 ms, after 2 s"
    assert described(c) == text


# --- the choice --------------------------------------------------------------------------------------
def test_causes_that_one_supply_hides_ask_for_another_one(tmp_path) -> None:
    kinds = [(kind, 9e5) for kind in ("fixed", "N-B", "B-N", "N-F")]
    campaign = made(tmp_path / "measured", kinds=kinds)
    model = model_of(campaign)
    (healthy,) = judge(Fitter(model), [Fitter(model).fit(iterations=4)], ())
    causes = {item.name: item for item in available(model.strokes)}
    asked = [causes["valve_delay_pressure"], causes["piston_leak"]]
    verdict = Verdict("consistent", healthy, healthy)
    found = next_experiment(model, load(), campaign, verdict, [healthy], asked)
    assert found is not None and found.separated
    # a leak of typical size would have been seen; a slope over the supply cannot be at one supply
    assert len(found.separates) == 2 and found.separates[1].startswith("valve_delay_pressure")
    assert len(found.strokes) <= MOST
    assert found.strokes[0].entry.conditions.supply_pressure_pa < 9e5
    assert "would not have been noticed" in found.why
    again = next_experiment(model, load(), campaign, verdict, [healthy], asked, workers=2)
    assert again is not None and again.as_json() == found.as_json()

    following = replace(campaign, recorder=Recorder({"time_s": ColumnMap("t [ms]", 1e-3)}))
    folder = tmp_path / "next"
    folder.mkdir()
    text = campaign_toml(following, found.entries)
    (folder / "campaign.toml").write_text(text, encoding="utf-8")
    read = load_campaign(folder)
    assert [entry.label for entry in read.strokes] == [p.entry.label for p in found.strokes]
    assert read.recorder.columns == {"time_s": ColumnMap("t [ms]", 1e-3)}


def test_nothing_is_asked_where_nothing_is_open(clean_model, clean) -> None:
    (healthy,) = judge(Fitter(clean_model), [Fitter(clean_model).fit(iterations=2)], ())
    verdict = Verdict("consistent", healthy, healthy)
    assert next_experiment(clean_model, load(), clean, verdict, [healthy]) is None


# --- several campaigns of one unit -------------------------------------------------------------------
def test_joined_campaigns_share_the_unit_and_not_the_zeros_of_the_gauges(tmp_path) -> None:
    first = made(tmp_path / "first", count=2)
    second = made(tmp_path / "second", count=1)
    both = joined([first, second])
    assert both.name == "made + made" and len(both.strokes) == 3
    assert len(both.record(both.strokes[2])) == len(second.record(second.strokes[0]))
    model = model_of(both)
    one, two = (f"position_m of {folder}" for folder in (first.folder, second.folder))
    assert {one, two} <= set(model.offsets)
    columns = model.offset_columns[2]
    assert np.any(columns[:, model.offsets.index(two)])
    assert not np.any(columns[:, model.offsets.index(one)])
    assert joined([first]) is first


def test_a_campaign_given_twice_and_unlike_columns_are_refused(tmp_path) -> None:
    first = made(tmp_path / "first", count=1)
    with pytest.raises(InputError, match="the same campaign twice"):
        joined([first, first])
    other = replace(first, folder=tmp_path / "x", recorder=Recorder({"time_s": ColumnMap("t")}))
    with pytest.raises(InputError, match=r"x.campaign.toml: columns: not those of"):
        joined([first, other])

"""Campaigns that are not what they claim: refused in one line, or reported."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from can_dbc.errors import InputError
from plant.parameters import Parameter, ParameterSet, load
from sil.campaign.campaign import CampaignStroke, Record, load_campaign, write_record
from sil.cli import main
from sil.inference.campaign.checks import check_record, observed, time_shift
from tests.support.made_campaign import conditions_of, made

ENTRY = CampaignStroke("stroke_001.csv", "fixed", conditions_of("fixed", 900000.0))


def columns(clean) -> dict[str, np.ndarray]:
    record = clean.record(clean.strokes[0])
    return {name: record[name].copy() for name in record.columns}


def checked(changed: dict[str, np.ndarray]):
    return check_record(ENTRY, Record(Path("stroke_001.csv"), changed), load())


def test_a_good_stroke_has_nothing_odd(clean) -> None:
    assert checked(columns(clean)) == []


@pytest.mark.parametrize(
    ("column", "change", "hint"),
    [
        ("position_m", lambda x: x * 1e3, "in mm?"),
        ("position_m", lambda x: x * 1e2, "in cm?"),
        ("pressure_1_pa", lambda x: x * 1e-5, "bar"),
        ("pressure_1_pa", lambda x: x * 1e-3, "in kPa?"),
        ("pressure_2_pa", lambda x: x * 1e3, "expected at most the supply"),
        ("pressure_2_pa", lambda x: x - 101325.0, "absolute"),
        ("pressure_1_pa", lambda x: 0.0 * x + 101325.0, "constant"),
        ("position_m", lambda x: 0.0 * x, "does not move"),
    ],
)
def test_wrong_units_and_dead_channels_are_named(clean, column, change, hint) -> None:
    changed = columns(clean)
    changed[column] = change(changed[column])
    with pytest.raises(InputError) as caught:
        checked(changed)
    text = str(caught.value)
    assert column in text and hint in text and "\n" not in text


def test_a_start_beyond_the_stroke_is_named_with_its_file(clean) -> None:
    entry = replace(ENTRY, conditions=replace(ENTRY.conditions, start_offset_m=0.02))
    with pytest.raises(InputError, match=r"stroke_001\.csv: start_offset_m 0\.02: expected 0 to"):
        check_record(entry, Record(Path("stroke_001.csv"), columns(clean)), load())


def test_a_misspelt_column_is_named(clean, tmp_path, capsys) -> None:
    folder = shutil.copytree(clean.folder, tmp_path / "misspelt")
    for stroke in clean.strokes:
        path = folder / stroke.file
        head, body = path.read_text().split("\n", 1)
        path.write_text(
            head.replace("position_m", "pos") + ",marker\n" + body.replace("\n", ",0\n")
        )
    what = "column not used, and position_m is missing; expected that name, or a map in [columns]"
    more = f"and {len(clean.strokes) - 1} more: pos: {what}"
    _strokes, findings = observed(load_campaign(folder), load())
    assert [str(item) for item in findings] == [f"stroke_001.csv {more}"]
    assert main(["simulate", str(folder), "--out", str(tmp_path / "out"), "--quiet"]) == 0
    assert capsys.readouterr().err.splitlines()[0] == (
        f"opc4 simulate: {folder}/stroke_001.csv {more}"
    )
    with (folder / "campaign.toml").open("a") as table:
        table.write('[columns]\nposition_m = "pos"\n')
    assert observed(load_campaign(folder), load())[1] == []


def test_a_short_record_and_a_gap_are_named(clean) -> None:
    short = {name: values[:120] for name, values in columns(clean).items()}
    with pytest.raises(InputError, match=r"expected a whole stroke|first command"):
        checked(short)
    gap = columns(clean)
    gap["time_s"] = gap["time_s"] + np.where(np.arange(len(gap["time_s"])) > 1000, 0.01, 0.0)
    with pytest.raises(InputError, match="line 1003: time_s jumps"):
        checked(gap)


def test_saturation_is_a_finding(clean) -> None:
    changed = columns(clean)
    changed["pressure_1_pa"] = np.minimum(changed["pressure_1_pa"], 500000.0)
    found = checked(changed)
    assert [item.channel for item in found] == ["pressure_1_pa"]
    assert "saturated" in str(found[0])


@pytest.mark.parametrize("shift", [-0.01, 0.004])
def test_a_shifted_time_base_is_measured(shift: float) -> None:
    time_s = np.linspace(0.0, 0.3, 1500)
    predicted = 1e5 + 7e5 / (1.0 + np.exp(-(time_s - 0.1) / 0.01))
    found = time_shift({"p": (np.interp(time_s - shift, time_s, predicted), predicted, time_s)})
    assert found == pytest.approx(shift, abs=2e-4)
    assert time_shift({"p": (predicted + 50.0, predicted, time_s)}) == 0.0


def late(parameters: ParameterSet, delay_s: float) -> ParameterSet:
    effect = {"valve_open_delay": {"delay_s": Parameter(delay_s, "s", "hidden by the test")}}
    return ParameterSet(parameters.name, parameters.entries, effect)


def test_what_all_strokes_share_is_not_taken_off_as_a_shift_of_records(tmp_path) -> None:
    fixed = (("fixed", 900000.0), ("fixed", 600000.0), ("fixed", 750000.0))
    campaign = made(tmp_path / "late", late(load(), 0.006), kinds=fixed, closes=False)
    assert observed(campaign, load())[1] == []


def test_a_record_shifted_unlike_the_others_is_put_right(tmp_path) -> None:
    fixed = (("fixed", 900000.0), ("fixed", 600000.0), ("fixed", 750000.0))
    campaign = made(tmp_path / "shifted", kinds=fixed)
    record = campaign.record(campaign.strokes[1])
    shifted = {
        name: np.concatenate([np.full(60, record[name][0]), record[name][:-60]])
        for name in record.columns
        if name != "time_s"
    }
    write_record(campaign.folder / "stroke_002.csv", {"time_s": record.time_s, **shifted})
    texts = [str(item) for item in observed(load_campaign(campaign.folder), load())[1]]
    assert len(texts) == 1 and texts[0].startswith("stroke_002.csv: time_s: the record runs +6.")

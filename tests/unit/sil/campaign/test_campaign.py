"""Campaign folders: conditions that are read, kept and refused."""

from __future__ import annotations

import tomllib
from dataclasses import replace
from pathlib import Path

import pytest

from can_dbc.errors import InputError
from plant.parameters import load
from sil.campaign.campaign import campaign_toml, load_campaign
from sil.campaign.simulate import simulate_campaign, write_campaign
from sil.cli import main

Capture = pytest.CaptureFixture[str]

TEXT = """
name = "one"
rig = "fixed"
atmosphere_pa = 101325.0
temperature_k = 293.15
sample_rate_hz = 10000.0

[[stroke]]
file = "stroke_001.csv"
kind = "fixed"
supply_pressure_pa = 900000.0
commands = [[0.01, "1", 0.98]]
"""


def written(folder: Path, more: str = "") -> Path:
    folder.mkdir()
    (folder / "campaign.toml").write_text(TEXT + more, encoding="utf-8")
    return folder


def test_the_theoretical_flow_can_be_chosen_and_is_kept(tmp_path: Path) -> None:
    mapped = load_campaign(str(written(tmp_path / "mapped")))
    chosen = load_campaign(str(written(tmp_path / "chosen", 'flow_model = "theoretical"\n')))
    strokes = [next(iter(simulate_campaign(campaign, load()))) for campaign in (mapped, chosen)]
    arrivals = [stroke.arrival_s for stroke in strokes]
    assert arrivals[1] - arrivals[0] == pytest.approx(1.26e-3, rel=0.1)
    again = tmp_path / "again"
    again.mkdir()
    (again / "campaign.toml").write_text(campaign_toml(chosen, chosen.strokes), encoding="utf-8")
    assert load_campaign(str(again)).strokes[0].conditions.theoretical_flow
    assert not mapped.strokes[0].conditions.theoretical_flow
    odd = replace(strokes[0], entry=replace(strokes[0].entry, file='a"b\\c.csv'))
    write_campaign(mapped, [odd], again, lambda _: None)
    reference = tomllib.loads((again / "reference.toml").read_text(encoding="utf-8"))
    assert [entry["file"] for entry in reference["stroke"]] == ['a"b\\c.csv']
    assert load_campaign(str(again)).strokes[0].file == 'a"b\\c.csv'


def test_an_unknown_flow_model_is_refused(tmp_path: Path) -> None:
    folder = written(tmp_path / "wrong", 'flow_model = "guessed"\n')
    with pytest.raises(
        InputError, match=r"stroke\[0\].flow_model: 'guessed' is unknown; expected one of"
    ):
        load_campaign(str(folder))


@pytest.mark.parametrize("name", ["../stroke.csv", "a/b.csv", "stroke\\u0000.csv", "stroke\\n.csv"])
def test_a_file_that_is_no_plain_name_is_refused(tmp_path: Path, name: str) -> None:
    folder = tmp_path / "wrong"
    folder.mkdir()
    text = TEXT.replace("stroke_001.csv", name)
    (folder / "campaign.toml").write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match="expected the name of a file next to"):
        load_campaign(str(folder))


def test_a_file_of_two_strokes_is_refused(tmp_path: Path) -> None:
    folder = written(tmp_path / "twice", TEXT[TEXT.index("[[stroke]]") :])
    with pytest.raises(InputError, match=r"stroke\[1\]\.file: 'stroke_001.csv' twice"):
        load_campaign(str(folder))


def test_a_scale_of_zero_is_refused(tmp_path: Path) -> None:
    folder = written(tmp_path / "flat", '[columns]\nposition_m = { column = "x", scale = 0 }\n')
    with pytest.raises(InputError, match=r"columns.position_m.scale: 0 makes every value the same"):
        load_campaign(str(folder))


@pytest.mark.parametrize(
    ("record", "wrong"),
    [
        ("time_s,position_m\n0.0,0.0\n0.0,0.0\n", "line 3: time_s does not increase; expected"),
        ("time_s,x,x\n0.0,0.0,1.0\n0.1,0.0,1.0\n", "line 1: column 'x' twice; expected each name"),
        (
            "time,position_m\n0.0,0.0\n0.1,0.0\n",
            "no column time_s among time, position_m; expected",
        ),
        ("", "line 1: empty; expected a header row"),
        (None, "is a folder; expected a table with a header row"),
    ],
)
@pytest.mark.parametrize("command", [["simulate"], ["diagnose"], ["identify", "flow"]])
def test_a_wrong_record_is_one_line_and_leaves_no_output(
    command: list[str], record: str | None, wrong: str, tmp_path: Path, capsys: Capture
) -> None:
    folder = written(tmp_path / "campaign", TEXT[TEXT.index("[[stroke]]") :].replace("001", "002"))
    (folder / "stroke_001.csv").write_text("time_s,position_m\n0.0,0.0\n0.1,0.0\n")
    file = folder / "stroke_002.csv"
    file.mkdir() if record is None else file.write_text(record)
    out = tmp_path / "out"
    assert main([*command, str(folder), "--out", str(out), "--quiet"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"opc4 {command[0]}: {file}: {wrong}") and not out.exists()


def test_a_campaign_is_not_replaced_by_its_simulation(tmp_path: Path, capsys: Capture) -> None:
    folder = written(tmp_path / "campaign")
    (folder / "stroke_001.csv").write_text("time_s,position_m\n0.0,0.0\n0.1,0.0\n")
    assert main(["simulate", str(folder), "--out", str(folder / "."), "--force"]) == 2
    what = "--out: is the campaign that is simulated; expected another folder"
    assert capsys.readouterr().err == f"opc4 simulate: {folder}: {what}\n"
    assert (folder / "stroke_001.csv").exists()


def test_options_of_a_truck_log_are_refused_for_a_campaign(tmp_path: Path, capsys: Capture) -> None:
    folder = written(tmp_path / "campaign")
    for option in ("--map", "--dbc"):
        assert main(["diagnose", str(folder), option, "x"]) == 2
        what = "not together with a campaign; expected CAN logs"
        assert capsys.readouterr().err == f"opc4 diagnose: {option}: {what}\n"
    (folder / "campaign.toml").write_text(TEXT.replace('"fixed"', '"force"'), encoding="utf-8")
    assert main(["diagnose", str(folder), "--model", "truck_40ms"]) == 2
    what = '--model: not together with rig = "force"; expected none'
    assert capsys.readouterr().err == f"opc4 diagnose: {what}\n"

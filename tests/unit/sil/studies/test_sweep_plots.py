"""The plots of a study: medians over what was swept, points where nothing repeats, strokes over time."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from sil.studies.load_study import load_study
from sil.studies.plots import MOST_ROWS, study_plots
from sil.studies.study import LoadedStudy
from sil.studies.table import Table

LOOP = """
name = "loop"
scenario = "lab_n_b"
reads = ["impact_speed_m_s", "shift_time_s"]
[[sweep]]
path = "valve.D_rise"
low = 0.001
high = 0.1
steps = 3
scale = "log"
unit = "s"
[[sweep]]
path = "bus.bitrate"
values = [250000, 500000]
[[load]]
name = "soft"
[[load]]
name = "hard"
"""


def study(folder: Path, text: str = LOOP) -> LoadedStudy:
    (folder / "study.toml").write_text(text, encoding="utf-8")
    return load_study(str(folder / "study.toml"))


def made_table(rises: np.ndarray, rates: np.ndarray, loads: list[str], speeds: np.ndarray) -> Table:
    numbers = {
        "valve.D_rise": rises,
        "bus.bitrate": rates,
        "impact_speed_m_s": speeds,
        "shift_time_s": speeds / 10.0,
    }
    return Table({"load": loads}, numbers, len(loads))


def test_each_swept_number_is_an_axis_and_each_choice_a_line(tmp_path: Path) -> None:
    rises = np.repeat([0.001, 0.01, 0.1], 4)
    rates = np.tile([250e3, 250e3, 500e3, 500e3], 3)
    speeds = np.arange(12.0)
    speeds[0] = np.nan
    table = made_table(rises, rates, ["soft", "hard"] * 6, speeds)
    groups = study_plots(study(tmp_path), table)
    assert [group.title for group in groups] == ["Over valve.D_rise", "Over bus.bitrate"]
    over, rate = (json.loads(group.numbers) for group in groups)
    assert over["x"] == [0.001, 0.01, 0.1] and over["log"] and not rate["log"]
    speed, time = over["panels"]
    assert [line["label"] for line in speed["series"]] == ["soft", "hard"]
    assert speed["series"][0]["y"] == [2.0, 5.0, 9.0]  # medians; a row without one does not count
    assert speed["series"][1]["y"] == [2.0, 6.0, 10.0]
    assert not speed["series"][0]["dotted"] and speed["title"] == "impact speed, median"
    assert time["unit"] == "ms" and time["series"][1]["y"] == [200.0, 600.0, 1000.0]


def test_rows_of_a_design_are_points_and_not_all_of_a_large_one(tmp_path: Path) -> None:
    count = 3 * MOST_ROWS
    rises = np.geomspace(0.001, 0.1, count)
    table = made_table(rises, np.full(count, 250e3), ["soft"] * count, rises * 7.0)
    (over,) = study_plots(study(tmp_path), table)  # the other value is the same in all rows
    told = json.loads(over.numbers)
    assert len(told["x"]) == MOST_ROWS and told["panels"][0]["series"][0]["dotted"]
    assert told["panels"][0]["title"] == "impact speed"


def test_strokes_of_a_small_study_lie_over_one_time(tmp_path: Path) -> None:
    text = (
        'name = "mass"\n[stroke]\nkind = "N-B"\ncommands = [[0.01, "B", 0.98]]\nuntil_s = 0.1\n'
        '[[sweep]]\npath = "length.m_s"\nvalues = [0.9, 1.8]\n'
    )
    loaded = study(tmp_path, text)
    numbers = {"length.m_s": np.array([0.9, 1.8])}
    known = {n: np.array([1.0, 0.9]) for n in ("impact_speed_m_s", "arrival_s")}
    strokes, _over = study_plots(loaded, Table({}, numbers | known, 2))
    told = json.loads(strokes.numbers)
    position = told["panels"][0]["series"]
    assert [panel["unit"] for panel in told["panels"]] == ["mm", "bar", "bar"]
    assert position[0]["y"][-1] == position[1]["y"][-1] == pytest.approx(12.85)
    assert sum(position[0]["y"]) > sum(position[1]["y"])  # the lighter one is there first

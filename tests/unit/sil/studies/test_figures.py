"""The figures of a study: medians over what was swept, dots where nothing repeats, strokes over time."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sil.report.figure import Panel
from sil.studies.design import SweptValue
from sil.studies.figures import MAX_DOTS, sweep_metric, swept_figures
from sil.studies.load_study import load_study
from sil.studies.study import Study, Table

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


def study(folder: Path, text: str = LOOP) -> Study:
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
    figures = swept_figures(study(tmp_path), table)
    assert set(figures) == {"map", "lines"}
    over, rate = figures["lines"].stacks
    assert [over.title, rate.title] == ["Over valve.D_rise", "Over bus.bitrate"]
    assert over.axis == "valve.D_rise, ms" and over.logarithmic and not rate.logarithmic
    speed, time = over.panels
    soft, hard = speed.series
    assert (soft.label, hard.label) == ("soft", "hard")
    assert soft.x.tolist() == [1.0, 10.0, 100.0] and soft.style == "marked"
    assert soft.y.tolist() == [2.0, 5.0, 9.0]  # medians; a row without one does not count
    assert hard.y.tolist() == [2.0, 6.0, 10.0]
    assert speed.bands[1].low.tolist() == [1.0, 5.0, 9.0]
    assert speed.bands[1].high.tolist() == [3.0, 7.0, 11.0]
    assert speed.title == "impact speed, median"
    assert time.unit == "ms" and time.series[1].y.tolist() == [200.0, 600.0, 1000.0]


def test_a_map_shows_the_greatest_value_of_each_cell(tmp_path: Path) -> None:
    rises = np.repeat([0.001, 0.01, 0.1], 4)
    rates = np.tile([250e3, 250e3, 500e3, 500e3], 3)
    table = made_table(rises, rates, ["soft", "hard"] * 6, np.arange(12.0))
    soft, hard = swept_figures(study(tmp_path), table)["map"].stacks
    assert (soft.title, hard.title) == ("soft", "hard")
    texts = {(span.start + 0.5, span.low + 0.5): span.label for span in hard.panels[0].spans}
    assert texts[0.0, 0.0] == "1.00" and texts[2.0, 1.0] == "11.00" and len(texts) == 6
    assert [name for _at, name in hard.ticks] == ["1", "10", "100"]


def test_rows_of_a_design_are_points_and_not_all_of_a_large_one(tmp_path: Path) -> None:
    count = 3 * MAX_DOTS
    rises = np.geomspace(0.001, 0.1, count)
    table = made_table(rises, np.full(count, 250e3), ["soft"] * count, rises * 7.0)
    (over,) = swept_figures(study(tmp_path), table)["lines"].stacks  # the other value never changes
    dots = over.panels[0].series[0]
    assert len(dots.x) == MAX_DOTS and dots.style == "dots"
    assert over.panels[0].title == "impact speed"


def test_strokes_of_a_small_study_lie_over_one_time(tmp_path: Path) -> None:
    text = (
        'name = "mass"\n[stroke]\nkind = "N-B"\ncommands = [[0.01, "B", 0.98]]\nuntil_s = 0.1\n'
        '[[sweep]]\npath = "length.m_s"\nvalues = [0.9, 1.8]\n'
    )
    loaded = study(tmp_path, text)
    numbers = {"length.m_s": np.array([0.9, 1.8])}
    figures = {n: np.array([1.0, 0.9]) for n in ("impact_speed_m_s", "arrival_s")}
    panels: list[Panel] = list(
        loaded.file.draw(loaded, Table({}, numbers | figures, 2))["curves"].stacks[0].panels
    )
    assert [panel.unit for panel in panels] == ["mm", "bar", "bar"]
    light, heavy = (line.y for line in panels[0].series)
    assert light[-1] == heavy[-1] == pytest.approx(12.85)
    assert light.sum() > heavy.sum()  # the lighter one is there first


@pytest.mark.parametrize(
    ("sweep", "label"),
    [
        (SweptValue(path="valve.D_fall"), ("valve.D_fall, ms", 1e3)),
        (SweptValue(path="controller.period_s"), ("controller.period_s, ms", 1e3)),
        (SweptValue(path="plant.mesh_force_n"), ("plant.mesh_force_n, N", 1.0)),
        (SweptValue(path="effect.inlet_clog.factor"), ("effect.inlet_clog.factor", 1.0)),
        (SweptValue(path="valve.D_fall", label="share"), ("share", 1.0)),
    ],
)
def test_an_axis_has_the_unit_of_what_is_swept(sweep: SweptValue, label: tuple[str, float]) -> None:
    metric = sweep_metric(sweep)
    assert (metric.axis, metric.factor) == label

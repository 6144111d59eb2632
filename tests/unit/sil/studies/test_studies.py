"""Studies: designs, order, resuming, the same bytes whoever runs them, rows that `opc4 run` repeats."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest

from can_dbc.errors import InputError
from sil.cli import main
from sil.files.overrides import setting_texts
from sil.studies import executor
from sil.studies.executor import run_study
from sil.studies.figures import choices_figure
from sil.studies.load_study import load_study, shipped
from sil.studies.study import Study
from sil.studies.table import RESULTS, read_table

GRID = """
name = "grid"
[stroke]
kind = "fixed"
commands = [[0.01, "1", 0.98]]
until_s = 0.1
[[sweep]]
path = "supply.P_s"
values = [1.0]
[[sweep]]
path = "fixed.V10"
low = 1e-5
high = 4e-5
steps = 20
[[variant]]
name = "plain"
[[variant]]
name = "heavy, very"
set = { "fixed.m_s" = 3.0 }
"""

LOOP = """
name = "loop"
scenario = "lab_n_b"
[[sweep]]
path = "valve.D_rise"
values = [0.006, 0.010]
[[load]]
name = "9 bar"
[[load]]
name = "6 bar"
set = { "plant.supply_pressure_pa" = 600000.0 }
"""


def study_file(folder: Path, text: str = GRID) -> Path:
    path = folder / "study.toml"
    path.write_text(
        text.replace(
            'path = "supply.P_s"\nvalues = [1.0]', 'path = "fixed.m_p"\nvalues = [0.1, 0.2]'
        )
    )
    return path


def table(folder: Path) -> list[dict[str, str]]:
    with open(folder / RESULTS, newline="") as file:
        return list(csv.DictReader(file))


def ran(folder: Path, text: str = GRID) -> tuple[Study, Path]:
    """A study that has been run, and the folder of its results."""
    study, out = load_study(str(study_file(folder, text))), folder / "out"
    out.mkdir()
    assert run_study(study, out) == study.size
    return study, out


def test_grid_runs_every_combination_in_order(tmp_path: Path) -> None:
    rows = table(ran(tmp_path)[1])
    assert [int(r["row"]) for r in rows] == list(range(80))
    assert len({(r["variant"], r["fixed.m_p"], r["fixed.V10"]) for r in rows}) == 80
    heavy = [float(r["impact_speed_m_s"]) for r in rows if r["variant"] == "heavy, very"]
    plain = [float(r["impact_speed_m_s"]) for r in rows if r["variant"] == "plain"]
    assert all(slow < fast for slow, fast in zip(heavy, plain, strict=True))


def test_workers_and_resuming_give_the_same_bytes(tmp_path: Path) -> None:
    study = load_study(str(study_file(tmp_path)))
    folders = [tmp_path / name for name in ("one", "two", "cut")]
    for folder in folders:
        folder.mkdir()
    run_study(study, folders[0])
    run_study(study, folders[1], workers=2)
    run_study(study, folders[2])
    whole = (folders[0] / RESULTS).read_bytes()
    (folders[2] / RESULTS).write_bytes(whole[: int(len(whole) * 0.47)])
    assert 0 < run_study(study, folders[2], resume=True) < 80
    assert [(f / RESULTS).read_bytes() == whole for f in folders] == [True, True, True]


def test_resuming_another_study_is_refused(tmp_path: Path) -> None:
    _, out = ran(tmp_path)
    other = load_study(str(study_file(tmp_path, GRID.replace("steps = 20", "steps = 21"))))
    with pytest.raises(InputError, match="another study"):
        run_study(other, out, resume=True)


def test_a_row_is_what_the_run_gives(tmp_path: Path) -> None:
    study, out = ran(tmp_path, LOOP)
    rows = table(out)
    assert len(rows) == 4
    last = list(study.rows())[-1]
    settings = [part for text in setting_texts(last.settings) for part in ("--set", text)]
    assert main(["run", "lab_n_b", *settings, "--out", str(tmp_path / "run")]) in (0, 1)
    metrics = json.loads((tmp_path / "run" / "result.json").read_text())["metrics"]
    for name in ("shift_time_s", "impact_speed_m_s", "air_used_kg"):
        assert float(rows[-1][name]) == metrics[name]
    assert float(rows[0]["shift_time_s"]) < float(rows[-1]["shift_time_s"])


@pytest.mark.parametrize("kind", ["lhs", "sobol"])
def test_space_filling_designs_repeat_and_fill(kind: str, tmp_path: Path) -> None:
    text = GRID.split("[[sweep]]")[0] + (
        '[[sweep]]\npath = "fixed.V10"\nlow = 1e-5\nhigh = 1e-3\nscale = "log"\n'
        f'[design]\nkind = "{kind}"\nsamples = 64\nseed = 3\n'
    )
    study = load_study(str(study_file(tmp_path, text)))
    values = np.array([p[0] for p in study.points])
    assert len(values) == 64
    shares = np.sort(np.log10(values / 1e-5) / 2.0)
    assert np.max(np.abs(shares - (np.arange(64) + 0.5) / 64)) < 1.0 / 64
    assert load_study(str(study_file(tmp_path, text))).points == study.points


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("name = 1", "name"),
        (GRID.replace('kind = "fixed"', 'kind = "bent"'), "bent"),
        (GRID.replace("steps = 20", "steps = 1"), "steps"),
        (GRID.replace("low = 1e-5", "low = 1"), "low < high"),
        (GRID + '\nscenario = "lab_n_b"\n', "variant"),
        ('name = "x"\nscenario = "lab_n_b"\n' + GRID.split("\n", 2)[2], "exactly one"),
        (GRID.replace('name = "heavy, very"', 'name = "plain"'), "same name"),
        (GRID.replace("steps = 20", "steps = 99999999999"), r"sweep\[\d\].steps"),
        (GRID.replace("steps = 20", "steps = 4000000"), "rows; expected at most"),
        (GRID.replace("low = 1e-5", "low = nan"), "finite"),
        ('name = "../x"\n' + GRID.split("\n", 2)[2], "not a path"),
        ('name = "a\\nb"\n' + GRID.split("\n", 2)[2], "printable"),
        (GRID + '[design]\nkind = "lhs"\nsamples = -1\n', "design.samples"),
        (
            GRID.replace(
                '"heavy, very"\nset = { "', '"heavy, very"\nset = { "fixed.V10" = 1e-4, "'
            ),
            "swept, too",
        ),
        ('reads = ["speed"]\n' + GRID, r"reads\[0\]"),
        (GRID + '[each]\n"a b" = [[1, 2], [3]]\n', "each.a b: expected 2 values"),
    ],
)
def test_bad_studies_are_one_line(text: str, message: str, tmp_path: Path) -> None:
    path = study_file(tmp_path, text)
    with pytest.raises(InputError, match=message) as raised:
        load_study(str(path))
    assert "\n" not in str(raised.value)
    assert str(path) in str(raised.value)


def test_unknown_path_names_the_row_and_the_nearest(tmp_path: Path) -> None:
    path = study_file(tmp_path, GRID.replace("fixed.V10", "fixed.V1"))
    assert main(["whatif", str(path), "--out", str(tmp_path / "o")]) == 2
    with pytest.raises(InputError, match=r"row 0.*fixed\.V10"):
        executor.run_chunk(load_study(str(path)), (0, 1))


def test_every_shipped_study_reads() -> None:
    names = shipped()
    assert {"piston_radius", "initial_volume", "final_volume", "closed_chamber"} <= set(names)
    for path in names.values():
        assert load_study(str(path)).size > 0


def test_a_choice_with_placeholders_is_one_for_each_combination(tmp_path: Path) -> None:
    """Values that are named together go together, and keep their type; other choices stay as they are."""
    text = GRID.replace('"plain"', '"{k} at {where}"\nset = { "fixed.m_s" = "{mass}" }')
    each = '[each]\n"k mass" = [["light", 0.5], ["heavy", 2.0]]\nwhere = ["front", "rear"]\n'
    study = load_study(str(study_file(tmp_path, text + each)))
    assert [(choice.name, choice.set["fixed.m_s"]) for choice in study.file.variant] == [
        ("light at front", 0.5),
        ("light at rear", 0.5),
        ("heavy at front", 2.0),
        ("heavy at rear", 2.0),
        ("heavy, very", 3.0),
    ]


def test_chapter_five_studies_show_their_trend(tmp_path: Path) -> None:
    assert main(["whatif", "final_volume", "--out", str(tmp_path / "o")]) == 0
    rows = {r["variant"]: r for r in table(tmp_path / "o")}
    speeds = {name: float(row["impact_speed_m_s"]) for name, row in rows.items()}
    assert speeds["final volume / 10"] < 0.6 * speeds["as it is"]
    for name in ("curves.png", "report.html", "summary.json"):
        assert (tmp_path / "o" / name).stat().st_size > 500


def test_what_is_no_number_is_drawn_by_name(tmp_path: Path) -> None:
    """The kind with the most options along the axis, the others by colour, medians over repetitions."""
    path = tmp_path / "study.toml"
    path.write_text(
        """
        name = "named"
        reads = ["arrival_s"]
        [stroke]
        kind = "N-B"
        commands = [[0.01, "B", 0.98], [0.01, "N", 0.0]]
        until_s = 0.2
        [[sweep]]
        path = "stroke.charged_before"
        label = "charged"
        values = ["", "N"]
        [[load]]
        name = "9 bar"
        [[load]]
        name = "7 bar"
        set = { "stroke.supply_pressure_pa" = 700000.0 }
        [[load]]
        name = "6 bar"
        set = { "stroke.supply_pressure_pa" = 600000.0 }
        """
    )
    study = load_study(str(path))
    assert run_study(study, tmp_path) == 6
    rows = table(tmp_path)
    (stack,) = choices_figure(study, read_table(study, tmp_path)).stacks
    loads = [name for _at, name in stack.ticks]
    assert (stack.title, loads) == ("By load", ["9 bar", "7 bar", "6 bar"])
    assert [line.label for line in stack.panels[0].series] == ['""', '"N"']
    for line in stack.panels[0].series:
        expected = [
            1e3 * float(row["arrival_s"])
            for name in loads
            for row in rows
            if row["load"] == name and row["stroke.charged_before"] == line.label
        ]
        assert len(expected) == 3
        np.testing.assert_allclose(line.y, expected, rtol=1e-5)


def test_a_study_of_one_row_has_a_picture_without_a_choice(tmp_path: Path) -> None:
    path = tmp_path / "study.toml"
    path.write_text(
        """
        name = "one"
        reads = ["arrival_s"]
        [stroke]
        kind = "N-B"
        commands = [[0.01, "B", 0.98]]
        until_s = 0.2
        [[sweep]]
        path = "stroke.supply_pressure_pa"
        values = [9e5]
        """
    )
    assert main(["whatif", str(path), "--out", str(tmp_path / "out")]) == 0
    study = load_study(str(path))
    (stack,) = choices_figure(study, read_table(study, tmp_path / "out")).stacks
    assert stack.title == ""
    page = (tmp_path / "out" / "report.html").read_text()
    assert ">row<" in page and ">group<" in page

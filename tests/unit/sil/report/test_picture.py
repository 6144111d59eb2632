"""The matplotlib backend: every kind of content, PNG and SVG of the same bytes for the same figure."""

from __future__ import annotations

from itertools import combinations
from math import nan
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from matplotlib.image import imread
from numpy.typing import NDArray

from sil.report.figure import ColourScale, Figure, Note, Panel, Series, Stack, Zoom, spans_of
from sil.report.picture import MOST_ZOOMS, draw, save
from sil.report.theme import SERIES, THEMES
from tests.support.figures import everything


def texts(figure: Figure) -> set[str]:
    return {text.get_text() for axes in draw(figure).axes for text in axes.texts}


def test_both_kinds_are_written_and_repeat_to_the_byte(tmp_path: Path) -> None:
    first, second = tmp_path / "1", tmp_path / "2"
    for folder in (first, second):
        folder.mkdir()
        assert save(everything(), folder, "f", 40) == (folder / "f.png").read_bytes()
        assert (folder / "f.png").read_bytes().startswith(b"\x89PNG")
    for name in ("f.png", "f.svg"):
        assert (first / name).read_bytes() == (second / name).read_bytes()
    svg = (first / "f.svg").read_text(encoding="utf-8")
    assert ElementTree.fromstring(svg).tag.endswith("}svg")
    assert "<dc:date>" not in svg


def test_all_content_is_drawn() -> None:
    assert {"inside", "level", "a note"} <= texts(everything())
    names = [axes.get_ylabel() for axes in draw(everything()).axes]
    assert "Position, mm" in names and "Page only, m" not in names


def test_zooms_are_columns_below_an_overview() -> None:
    x = np.linspace(0.0, 10.0, 11)
    panel = Panel("p", "m", [Series("a", x, x, "truth")])
    zooms = [Zoom(str(k), 2.0 * k, 2.0 * k + 1.0) for k in range(5)]
    overview = Panel("whole", series=panel.series, limits=(0.0, 10.0))
    axes = draw(Figure([Stack("t, s", [panel], zooms=zooms, overview=overview)])).axes
    assert [a.get_xlim() for a in axes] == [(0.0, 10.0), (0.0, 1.0), (2.0, 3.0), (4.0, 5.0)]
    assert len(axes) == 1 + MOST_ZOOMS
    assert axes[1].get_ylim()[1] < 1.5 < axes[2].get_ylim()[0]  # each column its own scale


@pytest.mark.parametrize("up", [7.0, -7.0])
def test_a_note_on_a_line_at_the_edge_is_inside_of_the_panel(up: float) -> None:
    x = np.array([0.0, 1.0])
    panel = Panel(
        "p", "m", [Series("a", x, x, "truth")], notes=[Note(0.5, float(up > 0), "n", up=up)]
    )
    drawing = draw(Figure([Stack("x", [panel])]))
    drawing.draw_without_rendering()
    (axes,) = drawing.axes
    (text,) = axes.texts
    box, outer = text.get_window_extent(), axes.bbox
    assert outer.y0 <= box.y0 and box.y1 <= outer.y1


def test_limits_that_fall_turn_the_axis_over() -> None:
    panel = Panel("p", "", ticks=[(0.0, "first"), (3.0, "last")], limits=(3.6, -0.6))
    (axes,) = draw(Figure([Stack("x", [panel])])).axes
    assert axes.get_ylim() == (3.6, -0.6)


def test_long_names_of_ticks_are_not_cut(tmp_path: Path) -> None:
    ticks = [(float(k), 2 * "no filter, every 2.5 ms, opens in 2 ms, ") for k in range(9)]
    save(Figure([Stack("x", [Panel("p", "", ticks=ticks, limits=(-0.6, 8.6))])]), tmp_path, "f")
    image = imread(tmp_path / "f.png")
    assert (image[:, :2] == image[0, 0]).all() and not (image[:, :20] == image[0, 0]).all()


def test_the_same_scale_for_all_stacks_of_a_figure() -> None:
    def stack(top: float) -> Stack:
        x = np.array([0.0, 1.0])
        return Stack("x", [Panel("p", "m", [Series("a", x, top * x, "truth")])])

    for same in (True, False):
        axes = draw(Figure([stack(1.0), stack(5.0)], same_scale=same)).axes
        assert (axes[0].get_ylim() == axes[1].get_ylim()) is same


def test_letters_outside_the_font_do_not_warn(tmp_path: Path) -> None:
    series = [Series("変速", np.arange(3.0), np.arange(3.0), "truth")] * 2
    save(Figure([Stack("t, s", [Panel("p", "m", series)])], "変速"), tmp_path, "f", 40)


def test_a_multiplier_does_not_lie_over_the_legend() -> None:
    x = np.linspace(0.0, 1e-8, 5)
    panel = Panel("flow", "kg", [Series("a", x, x, "truth"), Series("b", x, x, "after")])
    drawing = draw(Figure([Stack("t, s", [panel])]))
    drawing.draw_without_rendering()
    (axes,) = drawing.axes
    multiplier, legend = axes.yaxis.get_offset_text(), axes.get_legend()
    assert multiplier.get_text() and legend is not None
    assert not multiplier.get_window_extent().overlaps(legend.get_window_extent())


def test_values_of_another_length_are_refused() -> None:
    with pytest.raises(ValueError, match="a: 3 values for 2 points"):
        Series("a", np.zeros(2), np.zeros(3), "truth")


def test_ends_of_an_axis() -> None:
    left, right = everything().stacks
    assert left.ends() == (0.0, 2.0)
    assert right.ends() == (-0.5, 1.5)
    assert Stack("t", []).ends() == (0.0, 1.0)
    assert Stack("t", [], limits=(3.0, 4.0)).ends() == (3.0, 4.0)


def test_heights_are_those_in_the_view() -> None:
    x = np.array([0.0, 1.0, 2.0])
    panel = Panel("p", "m", [Series("a", x, np.array([5.0, nan, 1.0]), "truth")])
    assert list(panel.heights()) == [1.0, 5.0]
    assert list(panel.heights((0.5, 2.0))) == [1.0, 1.0]
    assert list(panel.heights((0.5, 1.5))) == []


def test_a_scale_has_a_colour_for_each_value_and_a_cell_for_each_known_one() -> None:
    scale = ColourScale("m/s", 0.0, 2.0, ("#000000", "#ff0000", "#ffffff"))
    assert [scale.colour(v) for v in (-1.0, 0.0, 0.5, 1.0, 2.0, 9.0)] == [
        "#000000", "#000000", "#800000", "#ff0000", "#ffffff", "#ffffff"
    ]  # fmt: skip
    cells = scale.cells(np.array([[0.0, nan], [1.0, 2.0]]), "{:g}".format)
    assert [(c.start, c.low, c.label) for c in cells] == [
        (-0.5, -0.5, "0"), (-0.5, 0.5, "1"), (0.5, 0.5, "2")
    ]  # fmt: skip


def test_spans_of_a_switch() -> None:
    assert spans_of([0.0, 1.0, 2.0, 3.0], [True, False, True, True], 5.0) == [
        (0.0, 1.0),
        (2.0, 5.0),
    ]
    assert spans_of([], [], 1.0) == []


# Machado, Oliveira, Fernandes 2009, severity 1; on linear light
VISION = {
    "normal": [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
    "protanopia": [
        [0.152286, 1.052583, -0.204868],
        [0.114503, 0.786281, 0.099216],
        [-0.003882, -0.048116, 1.051998],
    ],
    "deuteranopia": [
        [0.367322, 0.860646, -0.227968],
        [0.280085, 0.672501, 0.047413],
        [-0.011820, 0.042940, 0.968881],
    ],
    "tritanopia": [
        [1.255528, -0.076749, -0.178779],
        [-0.078411, 0.930809, 0.147602],
        [0.004733, 0.691367, 0.303900],
    ],
}
TO_XYZ = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
LEAST_APART = 10.0
"""CIE 1976 colour difference; one of 2.3 is just seen."""


def lab(colour: str, vision: str) -> NDArray[np.float64]:
    """CIELAB of an sRGB colour as it is seen."""
    coded = np.array([int(colour[i : i + 2], 16) / 255.0 for i in (1, 3, 5)])
    light = np.where(coded <= 0.04045, coded / 12.92, ((coded + 0.055) / 1.055) ** 2.4)
    seen = np.clip(np.array(VISION[vision]) @ light, 0.0, 1.0)
    x, y, z = TO_XYZ @ seen / np.array([0.9505, 1.0, 1.089])
    fx, fy, fz = (np.cbrt(v) if v > 0.008856 else 7.787 * v + 16.0 / 116.0 for v in (x, y, z))
    return np.array([116.0 * fy - 16.0, 500.0 * (fx - fy), 200.0 * (fy - fz)])


@pytest.mark.parametrize("vision", VISION)
@pytest.mark.parametrize("theme", THEMES.values(), ids=list(THEMES))
def test_lines_that_share_a_panel_stay_apart(theme: dict[str, str], vision: str) -> None:
    panels = (
        ["truth", "estimate", "alarm"],
        list("BNF"),
        ["measured", "before", "after"],
        [f"series{k}" for k in range(SERIES)],
    )
    for roles in panels:
        colours = [theme[role] for role in roles]
        for one, other in combinations(colours, 2):
            apart = np.linalg.norm(lab(one, vision) - lab(other, vision))
            assert apart > LEAST_APART, (one, other)


def test_the_measure_sees_what_a_dichromat_does_not() -> None:
    red, green = "#c04040", "#6f7a00"
    normal, deutan = (
        np.linalg.norm(lab(red, v) - lab(green, v)) for v in ("normal", "deuteranopia")
    )
    assert deutan < 0.4 * normal
    assert lab("#ffffff", "normal") == pytest.approx([100.0, 0.0, 0.0], abs=0.1)

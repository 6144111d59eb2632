"""The matplotlib backend: every kind of content, PNG and SVG of the same bytes for the same figure."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from matplotlib.image import imread

from sil.report.figure import Figure, Note, Panel, Series, Stack, Zoom
from sil.report.picture import MOST_ZOOMS, draw, save
from tests.support.figures import everything


def texts(figure: Figure) -> set[str]:
    drawing = draw(figure)
    return {text.get_text() for axes in drawing.axes for text in axes.texts}


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
    panel = Panel("p", "", ticks=ticks, limits=(-0.6, 8.6))
    save(Figure([Stack("x", [panel])]), tmp_path, "f")
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

"""The matplotlib backend: every kind of content, PNG and SVG of the same bytes for the same figure."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from sil.report.figure import Figure, Panel, Series, Stack, Zoom
from sil.report.picture import MOST_ZOOMS, draw, save
from tests.unit.sil.report.test_figure import everything


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


def test_the_same_scale_for_all_stacks_of_a_figure() -> None:
    def stack(top: float) -> Stack:
        x = np.array([0.0, 1.0])
        return Stack("x", [Panel("p", "m", [Series("a", x, top * x, "truth")])])

    for same in (True, False):
        axes = draw(Figure([stack(1.0), stack(5.0)], same_scale=same)).axes
        assert (axes[0].get_ylim() == axes[1].get_ylim()) is same

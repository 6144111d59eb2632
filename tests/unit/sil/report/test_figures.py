"""Figures as files: PNG and SVG, the same bytes for the same figure."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

from matplotlib.figure import Figure

from sil.report.figures import save


def drawn() -> Figure:
    figure = Figure(figsize=(3.0, 2.0), facecolor="#ffeedd")
    axes = figure.add_subplot()
    axes.plot([0.0, 1.0], [1.0, 0.0], label="line")
    axes.legend()
    return figure


def test_both_kinds_are_written_and_repeat_to_the_byte(tmp_path: Path) -> None:
    first, second = tmp_path / "1", tmp_path / "2"
    for folder in (first, second):
        folder.mkdir()
        assert save(drawn(), folder, "f") == (folder / "f.png").read_bytes()
        assert (folder / "f.png").read_bytes().startswith(b"\x89PNG")
    for name in ("f.png", "f.svg"):
        assert (first / name).read_bytes() == (second / name).read_bytes()
    svg = (first / "f.svg").read_text(encoding="utf-8")
    assert ElementTree.fromstring(svg).tag.endswith("}svg")
    assert "#ffeedd" in svg and "<dc:date>" not in svg

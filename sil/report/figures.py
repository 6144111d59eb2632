"""Figures as files: PNG and SVG of each, the same bytes for the same figure.

Checked by: tests/unit/sil/report/test_figures.py
"""

from __future__ import annotations

from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DOTS_PER_INCH = 110


def save(figure: Figure, folder: Path, name: str, dots_per_inch: int = DOTS_PER_INCH) -> bytes:
    """Write `name`.png and `name`.svg into the folder and return the PNG's bytes."""
    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    FigureCanvasAgg(figure)
    image = BytesIO()
    paper = figure.get_facecolor()
    figure.savefig(image, format="png", dpi=dots_per_inch, facecolor=paper, metadata={"Software": None})
    (folder / f"{name}.png").write_bytes(image.getvalue())
    # identifiers that would be drawn at random, and the date, make each file another one
    with matplotlib.rc_context({"svg.hashsalt": name}):
        figure.savefig(folder / f"{name}.svg", format="svg", facecolor=paper, metadata={"Date": None})
    return image.getvalue()

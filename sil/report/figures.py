"""Figures as files: PNG and SVG of each, the same bytes for the same figure.

Checked by: tests/unit/sil/report/test_figures.py
"""

from __future__ import annotations

from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sil.files.atomic import write_atomically

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DOTS_PER_INCH = 110


def save(
    figure: Figure,
    folder: Path,
    name: str,
    dots_per_inch: int = DOTS_PER_INCH,
    trimmed: bool = False,
) -> bytes:
    """Write `name`.png and `name`.svg into the folder and return the PNG's bytes.

    trimmed: empty margins are cut off.
    """
    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    FigureCanvasAgg(figure)
    image = BytesIO()
    how: dict[str, Any] = {"facecolor": figure.get_facecolor()}
    if trimmed:
        how["bbox_inches"] = "tight"
    figure.savefig(image, format="png", dpi=dots_per_inch, metadata={"Software": None}, **how)
    write_atomically(folder / f"{name}.png", image.getvalue())
    # identifiers that would be drawn at random, and the date, make each file another one
    with matplotlib.rc_context({"svg.hashsalt": name}):
        vectors = BytesIO()
        figure.savefig(vectors, format="svg", metadata={"Date": None}, **how)
        write_atomically(folder / f"{name}.svg", vectors.getvalue())
    return image.getvalue()

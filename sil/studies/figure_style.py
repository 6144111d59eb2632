"""What all pictures of studies share: colours, units of metrics, how a figure is kept.

Checked by: tests/unit/sil/studies/test_whatif.py
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from sil.report.figures import save
from sil.report.theme import LIGHT

COLOURS = LIGHT.series

UNITS = {"_s": ("ms", 1e3), "_m_s": ("m/s", 1.0), "_m": ("mm", 1e3), "_pa": ("bar", 1e-5)}
UNITS |= {"_j": ("J", 1.0), "_kg": ("g", 1e3)}


def shown(name: str) -> tuple[str, float]:
    """Axis label and factor for a metric."""
    for suffix in ("_m_s", "_s", "_m", "_pa", "_j", "_kg"):
        if name.endswith(suffix):
            unit, factor = UNITS[suffix]
            return f"{name.removesuffix(suffix).replace('_', ' ')}, {unit}", factor
    return name.replace("_", " "), 1.0


def saved(figure: Any, path: Path, trimmed: bool = False) -> Path:
    """Write a figure as PNG, as SVG beside it, and close it; `trimmed` has its own layout."""
    from matplotlib import pyplot

    if not trimmed:
        figure.tight_layout()
    save(figure, path.parent, path.stem, trimmed=trimmed)
    pyplot.close(figure)
    return path

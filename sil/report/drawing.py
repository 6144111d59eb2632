"""What the panels of a picture share: units, windows, and letters that stay readable on lines."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from sil.recording.run_record import Floats, RunRecord
from sil.report.theme import Theme
from sil.simulation.metrics import Shift

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MM = 1e3
BAR = 1e-5
MS = 1e3


@dataclass(frozen=True)
class Window:
    """One column of the picture: a span of simulated time, and the shift in it if there is one."""

    start_s: float
    end_s: float
    shift: Shift | None


@dataclass(frozen=True)
class Drawing:
    """What all panels of a picture share."""

    record: RunRecord
    theme: Theme
    figure: Figure


def inside(window: Window, times: Floats, margin_s: float = 0.02) -> Any:
    """Return which instants lie in a window, or close enough for lines to reach its edges."""
    return (times >= window.start_s - margin_s) & (times <= window.end_s + margin_s)


def outline(theme: Theme) -> list[Any]:
    """Return text effects that keep letters readable on top of lines."""
    from matplotlib.patheffects import withStroke

    return [withStroke(linewidth=2.5, foreground=theme.paper)]

"""The figure model: `Figure` of stacks side by side, `Stack` of panels over one horizontal axis, `Panel`.

`sil.report.picture` draws it as PNG and SVG, `sil.report.plots` as interactive plots of a page.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from math import inf, isfinite
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from sil.recording.runs import true_runs

Floats = NDArray[np.float64]
MM, BAR, MS = 1e3, 1e-5, 1e3  # factors from SI units to the units of figures


@dataclass(frozen=True)
class Series:
    """A named line or set of points.

    x, y: [n] each (else ValueError), in the axes' units, x ascending; a NaN in y interrupts a line.
    role: a colour of the theme or "#rrggbb". width: of the line in points.
    style: "stepped" holds each value until the next x, "sampled" too, with a point at each x; "dots"
    has points only; "marked" has a line and points.
    """

    label: str
    x: Floats
    y: Floats
    role: str
    style: Literal["line", "stepped", "sampled", "dots", "marked"] = "line"
    dashed: bool = False
    width: float = 1.5

    def __post_init__(self) -> None:
        if len(self.x) != len(self.y):
            raise ValueError(f"{self.label}: {len(self.y)} values for {len(self.x)} points")


@dataclass(frozen=True)
class Band:
    """A shaded area between two lines. x, low, high: [n] each, in the axes' units."""

    x: Floats
    low: Floats
    high: Floats
    role: str


@dataclass(frozen=True)
class Span:
    """A rectangle, infinite: to the edge of the panel; the label is written inside if there is room."""

    start: float
    end: float
    role: str
    label: str = ""
    low: float = -inf
    high: float = inf
    style: Literal["solid", "pale", "hatched"] = "solid"


@dataclass(frozen=True)
class Rule:
    """A line across the panel at one value of an axis, with a text at its end."""

    at: float
    text: str = ""
    role: str = "faint"
    axis: Literal["x", "y"] = "x"
    style: Literal["solid", "dashed", "dotted"] = "dotted"


@dataclass(frozen=True)
class Note:
    """A text at a point of the panel, moved upwards by `up` points."""

    x: float
    y: float
    text: str
    role: str = "ink"
    align: Literal["left", "center", "right"] = "center"
    up: float = 0.0
    bold: bool = False


@dataclass(frozen=True)
class ColourScale:
    """Colours for values from low to high, with the text that names them."""

    label: str
    low: float
    high: float
    colours: Sequence[str] = (  # Viridis
        *("#440154", "#472d7b", "#3b528b", "#2c728e"),
        *("#21918c", "#28ae80", "#5ec962", "#fde725"),
    )

    def colour(self, value: float) -> str:
        """Return the colour of a value as "#rrggbb"; values outside have the colour of the end."""
        share = (value - self.low) / (self.high - self.low) if self.high > self.low else 0.5
        at = min(max(share, 0.0), 1.0) * (len(self.colours) - 1)
        k = min(int(at), len(self.colours) - 2)
        ends = [[int(c[i : i + 2], 16) for i in (1, 3, 5)] for c in self.colours[k : k + 2]]
        mixed = [round(a + (at - k) * (b - a)) for a, b in zip(*ends, strict=True)]
        return "#{:02x}{:02x}{:02x}".format(*mixed)

    def cells(self, values: Floats, text: Callable[[float], str] = lambda value: "") -> list[Span]:
        """Return one rectangle for each finite value [rows, columns], centred at (column, row)."""
        return [
            Span(j - 0.5, j + 0.5, self.colour(v), text(v), i - 0.5, i + 0.5)
            for (i, j), v in np.ndenumerate(values)
            if isfinite(v)
        ]


@dataclass(frozen=True)
class Panel:
    """What shares one vertical axis.

    height: in pixels on a page, in proportion in a picture. ticks: (value, name) instead of numbers.
    limits: ends of the vertical axis, the lower end first, even if reversed; None: found from the content.
    keys: (text, role) of further legend entries. page_only: pictures leave the panel out.
    """

    title: str
    unit: str = ""
    series: Sequence[Series] = ()
    bands: Sequence[Band] = ()
    spans: Sequence[Span] = ()
    rules: Sequence[Rule] = ()
    notes: Sequence[Note] = ()
    height: int = 170
    ticks: Sequence[tuple[float, str]] = ()
    limits: tuple[float, float] | None = None
    legend: bool = True
    keys: Sequence[tuple[str, str]] = ()
    scale: ColourScale | None = None
    page_only: bool = False

    def heights(self, view: tuple[float, float] = (-inf, inf)) -> Iterator[float]:
        """Yield the vertical extremes of the content whose x is inside a view."""
        for s in self.series:
            yield from _ends(s.y[(s.x >= view[0]) & (s.x <= view[1])])
        for b in self.bands:
            inside = (b.x >= view[0]) & (b.x <= view[1])
            yield from _ends(np.concatenate([b.low[inside], b.high[inside]]))
        yield from self.fixed_heights(view)

    def fixed_heights(self, view: tuple[float, float] = (-inf, inf)) -> Iterator[float]:
        """Yield the vertical extremes of spans in a view, and of horizontal rules that have a text."""
        spans = [s for s in self.spans if s.start <= view[1] and s.end >= view[0]]
        yield from (v for s in spans for v in (s.low, s.high) if isfinite(v))
        yield from (rule.at for rule in self.rules if rule.axis == "y" and rule.text)


@dataclass(frozen=True)
class Zoom:
    """A named part of the horizontal axis: a button on a page, a column of a picture."""

    name: str
    low: float
    high: float


@dataclass(frozen=True)
class Stack:
    """Panels one above the other over one horizontal axis.

    axis: its label with the unit. ticks: (value, name) instead of numbers. width: in inches in a picture.
    overview: a panel above all columns of a picture; the page needs none.
    """

    axis: str
    panels: Sequence[Panel]
    title: str = ""
    zooms: Sequence[Zoom] = ()
    ticks: Sequence[tuple[float, str]] = ()
    logarithmic: bool = False
    limits: tuple[float, float] | None = None
    overview: Panel | None = None
    width: float = 8.0

    def ends(self) -> tuple[float, float]:
        """Return the first and the last x of the content, or the limits."""
        if self.limits is not None:
            return self.limits
        ends: list[float] = []
        for panel in self.panels:
            for x in [*(s.x for s in panel.series), *(b.x for b in panel.bands)]:
                ends += _ends(x)
            ends += [v for s in panel.spans for v in (s.start, s.end) if isfinite(v)]
        if self.ticks:
            ends += [self.ticks[0][0] - 0.5, self.ticks[-1][0] + 0.5]
        low, high = (min(ends), max(ends)) if ends else (0.0, 1.0)
        return (low, high) if high > low else (low - 0.5, low + 0.5)


@dataclass(frozen=True)
class Figure:
    """Stacks side by side under a title; same_scale: with the same vertical limits in each row."""

    stacks: Sequence[Stack]
    title: str = ""
    subtitle: str = ""
    same_scale: bool = False


def _ends(values: Iterable[float]) -> list[float]:
    """Return the least and the greatest finite value, or nothing."""
    finite = np.asarray(values, dtype=np.float64)
    finite = finite[np.isfinite(finite)]
    return [float(finite.min()), float(finite.max())] if len(finite) else []


def spans_of(
    times: Sequence[float] | Floats, on: Sequence[Any], end: float
) -> list[tuple[float, float]]:
    """Return (start, end) of each time in which a switch is `on` [n] from `times` [n] on."""
    edges = [*times, end]
    return [(float(edges[a]), float(edges[b])) for a, b in true_runs(np.array(on, dtype=bool))]

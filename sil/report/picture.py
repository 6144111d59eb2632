"""The matplotlib backend: a figure as PNG and SVG, the same bytes for the same figure."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from io import BytesIO
from math import isfinite
from pathlib import Path
from textwrap import fill
from typing import TYPE_CHECKING, Any

from sil.files.atomic import write_atomically
from sil.report.figure import ColourScale, Figure, Note, Panel, Rule, Span, Stack
from sil.report.theme import colour_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Drawing

PIXELS_PER_INCH = 80.0  # of a panel's height
MOST_ZOOMS = 3
"""A picture shows this many parts of an axis side by side; a page has a button for each."""

LETTER = 0.6  # mean width of a letter over the size of its font

View = tuple[float, float]


def save(figure: Figure, folder: Path, name: str, dots_per_inch: int = 110) -> bytes:
    """Write `name`.png and `name`.svg into the folder and return the PNG's bytes."""
    logging.getLogger("matplotlib").setLevel(logging.ERROR)  # without a home it only takes longer
    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.backends.backend_svg import FigureCanvasSVG

    drawing = draw(figure)
    drawing.set_dpi(dots_per_inch)  # letters are not as wide at every resolution
    image, vectors = BytesIO(), BytesIO()
    with warnings.catch_warnings(), matplotlib.rc_context({"svg.hashsalt": name}):
        warnings.filterwarnings("ignore", "Glyph .* missing from")  # of a name: drawn as a box
        warnings.filterwarnings("ignore", "constrained_layout not")  # applied: a long name
        canvas = FigureCanvasAgg(drawing)
        layout: Any = drawing.get_layout_engine()
        layout.execute(drawing)
        drawing.set_layout_engine("none")
        for axes in drawing.axes:  # the solver's last digits are not the same in each process
            x, y, width, height = (round(each, 6) for each in axes.get_position(True).bounds)
            axes.set_position((x, y, width, height))
        # by the canvases, each drawing once: savefig draws twice. Without the date: same bytes again
        canvas.print_png(image, metadata={"Software": None})
        drawing.set_dpi(72)  # the unit of SVG is a point
        FigureCanvasSVG(drawing).print_svg(vectors, metadata={"Date": None})
    write_atomically(folder / f"{name}.png", image.getvalue())
    write_atomically(folder / f"{name}.svg", vectors.getvalue())
    return image.getvalue()


@dataclass(frozen=True)
class _Column:
    """A stack, or one zoom of it, as a column of panels."""

    stack: Stack
    view: View
    is_first: bool
    width: float

    @property
    def panels(self) -> list[Panel]:
        return [panel for panel in self.stack.panels if not panel.page_only]


def draw(figure: Figure) -> Drawing:
    """Return the figure drawn by matplotlib."""
    from matplotlib.figure import Figure as Drawing

    columns = [column for stack in figure.stacks for column in _columns(stack)]
    rows = max(len(column.panels) for column in columns)
    heights = [
        max(c.panels[row].height for c in columns if row < len(c.panels)) / PIXELS_PER_INCH
        for row in range(rows)
    ]
    overview = next((s.overview for s in figure.stacks if s.overview is not None), None)
    if overview is not None:
        heights.insert(0, overview.height / PIXELS_PER_INCH)
    head = (0.32 if figure.title else 0.08) + (0.2 if figure.subtitle or overview else 0.0)
    width = sum(column.width for column in columns) + 1.2
    height = head + sum(heights) + 0.16 * len(heights) + 0.5
    drawing = Drawing(figsize=(width, height), facecolor=colour_of("paper"), layout="constrained")
    layout: Any = drawing.get_layout_engine()
    below_head = (0.0, 0.0, 1.0, 1.0 - head / height)
    layout.set(rect=below_head, h_pad=0.03, w_pad=0.06, hspace=0.0, wspace=0.0)

    def write(x: float, below: float, text: str, size: float, role: str, **style: Any) -> None:
        """Write a text `below` the upper edge, in inches."""
        style |= {"fontsize": size, "color": colour_of(role), "va": "top"}
        drawing.text(x, 1.0 - below / height, text, **style)

    write(0.12 / width, 0.1, figure.title, 15, "ink", weight="bold")
    write(0.12 / width, 0.38, figure.subtitle, 9.5, "faint")
    ratios = {"height_ratios": heights, "width_ratios": [c.width for c in columns]}
    grid = drawing.add_gridspec(len(heights), len(columns), **ratios)
    if overview is not None:
        note = "top: the whole; shaded: enlarged below"
        write(1.0 - 0.12 / width, 0.38, note, 8.5, "faint", ha="right")
        _overview(drawing.add_subplot(grid[0, :]), overview, columns)
    for number, column in enumerate(columns):
        shown: set[str] = set()
        for row, panel in enumerate(column.panels):
            axes = drawing.add_subplot(grid[row + (overview is not None), number])
            limits = _vertical(figure, columns, column, row)
            is_lowest = row == len(column.panels) - 1
            _draw_panel(axes, panel, column, limits, is_lowest)
            names = {s.label for s in panel.series if s.label}
            legend_rows = 0
            if panel.legend and column.is_first and not (names and names <= shown):
                legend_rows = _legend(axes, panel, column.width)
            shown |= names
            is_repeated = figure.same_scale or (not column.is_first and panel.limits is not None)
            if number > 0 and is_repeated:
                axes.tick_params(labelleft=False)
            elif column.is_first:
                _name(axes, panel)
            if panel.scale is not None and number == len(columns) - 1:
                _colour_bar(drawing, axes, panel.scale)
            if row == 0 and column.stack.title and column.is_first:
                look: dict[str, Any] = {"fontsize": 10, "loc": "left", "color": colour_of("ink")}
                axes.set_title(column.stack.title, pad=6 + 14 * legend_rows, **look)
    return drawing


def _columns(stack: Stack) -> list[_Column]:
    """Return one column for each zoom that is drawn, or one for the whole stack."""
    zooms = stack.zooms[:MOST_ZOOMS]
    if stack.overview is None or not zooms:
        low, high = stack.ends()
        points = any(s.style in ("dots", "marked") for p in stack.panels for s in p.series)
        margin = 0.02 * (high - low)
        if stack.logarithmic:
            low, high = low / 1.05, high * 1.05
        elif points and stack.limits is None and not stack.ticks:
            low, high = low - margin, high + margin
        return [_Column(stack, (low, high), True, stack.width)]
    longest = max(zoom.high - zoom.low for zoom in zooms)
    weights = [max(zoom.high - zoom.low, 0.25 * longest) ** 0.6 for zoom in zooms]
    width = stack.width + 4.5 * len(zooms)
    return [
        _Column(stack, (zoom.low, zoom.high), k == 0, width * weight / sum(weights))
        for k, (zoom, weight) in enumerate(zip(zooms, weights, strict=True))
    ]


def _vertical(figure: Figure, columns: Sequence[_Column], column: _Column, row: int) -> View:
    """Return the vertical limits of a panel."""
    panel = column.panels[row]
    if panel.limits is not None:
        return panel.limits
    alike = [c for c in columns if row < len(c.panels)] if figure.same_scale else [column]
    heights = [v for c in alike for v in c.panels[row].heights(c.view)]
    low, high = (min(heights), max(heights)) if heights else (0.0, 1.0)
    room = 0.06 * (high - low) or abs(low) / 10 or 1.0
    low, high = low - room, high + room
    for note in panel.notes:  # a text stays inside of the panel
        share = (abs(note.up) + 13.0) / 72.0 * PIXELS_PER_INCH / panel.height
        if note.up and share < 0.5 and column.view[0] <= note.x <= column.view[1]:
            if note.up > 0.0:
                high = max(high, low + (note.y - low) / (1.0 - share))
            else:
                low = min(low, high - (high - note.y) / (1.0 - share))
    return low, high


def _style(axes: Axes) -> None:
    axes.set_facecolor(colour_of("paper"))
    axes.grid(True, color=colour_of("grid"), linewidth=0.6)
    axes.set_axisbelow(True)
    axes.tick_params(colors=colour_of("ink"), labelsize=8.5, length=0)
    for side, spine in axes.spines.items():
        spine.set_visible(side in ("left", "bottom"))
        spine.set_color(colour_of("grid"))


def _draw_panel(axes: Axes, panel: Panel, column: _Column, limits: View, is_lowest: bool) -> None:
    """Draw the content of one panel, with the axes' limits and ticks."""
    stack, view = column.stack, column.view
    _style(axes)
    if stack.logarithmic:
        axes.set_xscale("log")
    axes.set_xlim(*view)
    low, high = limits
    axes.set_ylim(low, high if high != low else low + 1.0)
    axes.yaxis.set_offset_position("right")  # a multiplier; on the left is the legend
    _spans(axes, panel.spans, column.width)
    for band in panel.bands:
        look: dict[str, Any] = {"color": colour_of(band.role), "alpha": 0.15, "lw": 0}
        axes.fill_between(band.x, band.low, band.high, **look)
    for rule in panel.rules:
        _rule(axes, rule)
    _series(axes, panel)
    for note in panel.notes:
        if view[0] <= note.x <= view[1]:
            _note(axes, note)
    if panel.ticks:
        axes.set_yticks([at for at, _ in panel.ticks], [name for _, name in panel.ticks])
        axes.tick_params(axis="y", labelsize=8.5 if len(panel.ticks) < 9 else 7.5)
        axes.grid(False, axis="y")
    if stack.ticks:
        names = [name for _, name in stack.ticks]
        crowded = sum(map(len, names)) * LETTER * 8.5 / 72 > column.width
        turn: dict[str, Any] = {"rotation": 30, "ha": "right"} if crowded else {}
        axes.set_xticks([at for at, _ in stack.ticks], names, **turn)
        axes.grid(False, axis="x")
    axes.tick_params(labelbottom=is_lowest)
    if is_lowest:
        axes.set_xlabel(stack.axis, color=colour_of("ink"), fontsize=9)


def _series(axes: Axes, panel: Panel) -> None:
    styles: dict[str, dict[str, Any]] = {
        "line": {},
        "stepped": {"drawstyle": "steps-post"},
        "sampled": {"drawstyle": "steps-post", "marker": "."},
        "dots": {"linestyle": "none", "marker": "o"},
        "marked": {"marker": "o"},
    }
    for order, s in enumerate(panel.series):
        style = {"linestyle": (0, (4, 2)) if s.dashed else "-"} | styles[s.style]
        axes.plot(
            s.x, s.y, color=colour_of(s.role), linewidth=s.width, markersize=2.0 + 1.2 * s.width,
            label=s.label or "_", zorder=3 + 0.01 * order, **style,
        )  # fmt: skip


def _spans(axes: Axes, spans: Sequence[Span], width: float) -> None:
    """Draw rectangles of one look together, then the labels that have room."""
    from matplotlib.collections import PolyCollection

    (left, right), (low, high) = axes.get_xlim(), sorted(axes.get_ylim())
    looks: dict[tuple[str, str, bool], list[Any]] = {}
    labels: list[tuple[Span, float, float]] = []
    for span in spans:
        if span.end < left or span.start > right:
            continue
        a, b = max(span.start, left), min(span.end, right)
        bottom, top = max(span.low, low), min(span.high, high)
        look = span.role, span.style, isfinite(span.low)
        looks.setdefault(look, []).append([(a, bottom), (a, top), (b, top), (b, bottom)])
        if span.label:
            labels.append((span, a, b))
    for (role, style, is_bounded), corners in looks.items():
        colour = colour_of(role)
        how: dict[str, Any] = {
            "solid": {"facecolors": colour, "edgecolors": colour, "linewidths": 0.7},
            "pale": {"facecolors": colour, "alpha": 0.35, "linewidths": 0},
            "hatched": {
                "facecolors": "none",
                "edgecolors": colour,
                "hatch": "////",
                "linewidths": 0,
            },
        }[style]
        order = 2 if is_bounded else 0.5
        axes.add_collection(PolyCollection(corners, zorder=order, **how), autolim=False)
    for span, a, b in labels:
        _span_label(axes, span, (a, b), 72.0 * 0.9 * width / (right - left))


def _span_label(axes: Axes, span: Span, view: View, points: float) -> None:
    """Write a label into a span, smaller or upright where room is little; points: per unit of the axis."""
    room = (view[1] - view[0]) * points
    size = 8.5 if LETTER * 8.5 * len(span.label) <= room else 6.5
    turned = LETTER * size * len(span.label) > room
    if turned and room < 6.5:
        return
    box = {"facecolor": colour_of("paper"), "edgecolor": "none", "pad": 0.8, "alpha": 0.8}
    axes.text(
        0.5 * (view[0] + view[1]), 0.5 * (span.low + span.high) if isfinite(span.low) else axes.get_ylim()[0],
        span.label, ha="center", va="center", fontsize=size, rotation=90 if turned else 0,
        color=_ink_on(span), clip_on=True, zorder=4, bbox=box if span.style == "hatched" else None,
    )  # fmt: skip


def _ink_on(span: Span) -> str:
    """Return black or white, whichever is easier to read on the span's colour."""
    if span.style != "solid":
        return colour_of("ink")
    colour = colour_of(span.role)
    red, green, blue = (int(colour[i : i + 2], 16) for i in (1, 3, 5))
    return "#1a1a1a" if 0.299 * red + 0.587 * green + 0.114 * blue > 110 else "#ffffff"


def _rule(axes: Axes, rule: Rule) -> None:
    across = rule.axis == "y"
    colour, width = colour_of(rule.role), 1.4 if rule.style == "solid" else 0.9
    line = axes.axhline if across else axes.axvline
    dashes: dict[str, Any] = {"solid": "-", "dashed": (0, (4, 2)), "dotted": ":"}
    line(rule.at, color=colour, linewidth=width, linestyle=dashes[rule.style], zorder=1)
    if not rule.text:
        return
    from matplotlib.patheffects import withStroke

    axes.annotate(
        rule.text, (0.005, rule.at) if across else (rule.at, 0.5),
        xycoords=("axes fraction", "data") if across else ("data", "axes fraction"),
        xytext=(0, -3) if across else (-4, 0), textcoords="offset points",
        ha="left" if across else "right", va="top" if across else "center",
        rotation=0 if across else 90, fontsize=8, color=colour, annotation_clip=True,
        path_effects=[withStroke(linewidth=2.5, foreground=colour_of("paper"))], zorder=6,
    )  # fmt: skip


def _note(axes: Axes, note: Note) -> None:
    from matplotlib.patheffects import withStroke

    axes.annotate(
        note.text, (note.x, note.y), xytext=({"left": 4, "center": 0, "right": -4}[note.align], note.up),
        textcoords="offset points", ha=note.align,
        va="center" if note.up == 0.0 else "bottom" if note.up > 0.0 else "top",
        fontsize=8.5, weight="bold" if note.bold else "normal", color=colour_of(note.role),
        path_effects=[withStroke(linewidth=2.5, foreground=colour_of("paper"))], zorder=7, annotation_clip=True,
    )  # fmt: skip


def _legend(axes: Axes, panel: Panel, width: float) -> int:
    """Put a legend above the panel if it has several things to name; return its rows."""
    from matplotlib.patches import Patch

    lines, _ = axes.get_legend_handles_labels()
    handles: list[Any] = list(lines)
    handles += [Patch(color=colour_of(role), label=text) for text, role in panel.keys]
    if len(handles) < 2 and not panel.keys:
        return 0
    longest = max(len(h.get_label()) for h in handles)
    fits = max(1, int(72 * width / (LETTER * 8 * longest + 40)))
    axes.legend(
        handles=handles, loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=min(fits, len(handles)),
        fontsize=8, frameon=False, labelcolor=colour_of("ink"), borderaxespad=0.1, handlelength=1.6, borderpad=0.2,
    )  # fmt: skip
    return -(-len(handles) // fits)


def _name(axes: Axes, panel: Panel) -> None:
    """Name the vertical axis; named ticks without a unit need no name."""
    if panel.ticks and not panel.unit:
        return
    text = f"{panel.title}, {panel.unit}" if panel.unit else panel.title
    axes.set_ylabel(fill(text, max(12, panel.height // 6)), color=colour_of("ink"), fontsize=9)


def _colour_bar(drawing: Drawing, axes: Axes, scale: ColourScale) -> None:
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import LinearSegmentedColormap, Normalize

    colours = LinearSegmentedColormap.from_list("scale", list(scale.colours))
    mappable = ScalarMappable(Normalize(scale.low, scale.high), colours)
    drawing.colorbar(mappable, ax=axes, label=scale.label)


def _overview(axes: Axes, panel: Panel, columns: Sequence[_Column]) -> None:
    """Draw the whole axis, with the parts that are enlarged below shaded."""
    stack = columns[0].stack
    whole = _Column(stack, stack.ends(), True, sum(column.width for column in columns))
    limits = panel.limits or (0.0, 1.0)
    _draw_panel(axes, panel, whole, limits, True)
    axes.set_xlabel("")
    for column in columns:
        axes.axvspan(*column.view, color=colour_of("band"), zorder=0)
    axes.tick_params(labeltop=True, labelbottom=False)

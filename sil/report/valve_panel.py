"""The valve panel: each coil as commanded above what its valve really did."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from can_dbc.messages import Chamber, SafetyBlow
from sil.recording.run_record import CHAMBERS, Floats, RunRecord
from sil.report.drawing import MS, Drawing, Window, outline
from sil.report.theme import Theme

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def _spans(times: Floats, on: Any, end: float) -> list[tuple[float, float]]:
    """Return the (start, length) of each run of True in a held boolean series."""
    spans = []
    begun: float | None = None
    for at, is_on in zip(times, on, strict=True):
        if is_on and begun is None:
            begun = float(at)
        elif not is_on and begun is not None:
            spans.append((begun, float(at) - begun))
            begun = None
    if begun is not None:
        spans.append((begun, end - begun))
    return spans


Span = tuple[float, float]


def valve_spans(record: RunRecord, chamber: str) -> tuple[list[Span], list[Span], list[Span]]:
    """Return (start, length) in s of a coil energised, a safety blow under way, a valve open.

    The coil is what commands and blows amount to at the valve driver, timeouts included.
    """
    end = float(record.truth["time_s"][-1])
    times, active = record.series(SafetyBlow, "active")
    _, chambers = record.series(SafetyBlow, "chamber")
    blowing = [a and c == Chamber[chamber] for a, c in zip(active, chambers, strict=True)]
    coil = _event_spans(record, f"coil_{chamber}_", ("on", "off"), False, end)
    is_open = bool(record.truth[f"valve_{chamber}"][0] > 0.5)
    valve = _event_spans(record, f"valve_{chamber}_", ("open", "close"), is_open, end)
    return coil, _overlap(_spans(times, blowing, end), coil), valve


def _event_spans(
    record: RunRecord, prefix: str, names: tuple[str, str], at_start: bool, end: float
) -> list[Span]:
    """Return the spans between a pair of plant events that switch something on and off."""
    moves = [(e.time_s, e.name) for e in record.events if e.name.startswith(prefix)]
    times = np.array([0.0, *(t for t, _ in moves)])
    return _spans(times, [at_start, *(n == prefix + names[0] for _, n in moves)], end)


def _overlap(spans: list[Span], others: list[Span]) -> list[Span]:
    """Return the parts of spans that lie within other spans."""
    pairs = [
        (max(a, c), min(a + b, c + d))
        for a, b in spans
        for c, d in others
        if a < c + d and c < a + b
    ]
    return [(start, stop - start) for start, stop in pairs]


def draw_valves(drawing: Drawing, axes: Axes, window: Window, is_first: bool) -> None:
    """Draw coil and valve of each chamber as bars, with the delays between them."""
    theme, record = drawing.theme, drawing.record
    ticks, names = [], []
    for lane, chamber in enumerate(reversed(CHAMBERS)):
        color = theme.chamber[chamber]
        commanded, blowing, actual = valve_spans(record, chamber)
        base = lane * 1.0
        for spans, offset, alpha in ((actual, 0.08, 1.0), (commanded, 0.52, 0.35)):
            axes.broken_barh(
                [(a * MS, b * MS) for a, b in spans],
                (base + offset, 0.36),
                facecolors=color,
                alpha=alpha,
                linewidth=0,
            )
            ticks.append(base + offset + 0.18)
        axes.broken_barh(
            [(a * MS, b * MS) for a, b in blowing],
            (base + 0.52, 0.36),
            facecolors="none",
            edgecolors=color,
            hatch="////",
            linewidth=0,
        )
        for start, length in blowing:
            if window.start_s <= start <= window.end_s:
                axes.text(
                    (start + 0.5 * length) * MS,
                    base + 0.70,
                    "safety blow",
                    ha="center",
                    va="center",
                    fontsize=8,
                    color=theme.ink,
                    clip_on=True,
                    bbox={"facecolor": theme.paper, "edgecolor": "none", "pad": 0.8, "alpha": 0.8},
                )
        names += [f"{chamber} valve", f"{chamber} command"]
        _delays(axes, theme, window, commanded, actual, base, color)
        axes.axhline(base, color=theme.grid, linewidth=0.8)
    axes.set_yticks(ticks, names)
    axes.set_ylim(-0.02, 3.0)
    axes.grid(False, axis="y")


def _delays(
    axes: Axes,
    theme: Theme,
    window: Window,
    commanded: list[tuple[float, float]],
    actual: list[tuple[float, float]],
    base: float,
    color: str,
) -> None:
    """Write the opening and closing delay beside each pair of bars."""
    for opened, length in actual:
        closed = opened + length
        before = [a for a, n in commanded if a <= opened <= a + n]
        after = [a + n for a, n in commanded if opened < a + n <= closed]
        for causes, reacted, side in ((before, opened, "left"), (after, closed, "right")):
            if not causes or not window.start_s <= reacted <= window.end_s:
                continue
            wanted = causes[-1]
            axes.plot(
                [wanted * MS, wanted * MS, reacted * MS, reacted * MS],
                [base + 0.52, base + 0.48, base + 0.48, base + 0.44],
                color=theme.ink,
                linewidth=1.0,
            )
            axes.annotate(
                f"{(reacted - wanted) * MS:.0f} ms",
                (reacted * MS, base + 0.25),
                xytext=(4 if side == "left" else -4, 0),
                textcoords="offset points",
                fontsize=8.5,
                ha=side,
                va="center",
                color=theme.ink,
                path_effects=outline(theme),
                clip_on=True,
            )

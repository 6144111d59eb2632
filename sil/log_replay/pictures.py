"""Pictures of a replay: a scene of both sides, and the plant's position beside the recorded one."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from sil.log_replay.excerpts import Row, Scene
from sil.log_replay.plant_side import Position
from sil.report.drawing import MM
from sil.report.theme import LIGHT, Theme

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

CHAMBERS = "BNF"
NS_PER_MS = 1e6


def draw_scene(
    scene: Scene,
    labels: tuple[str, str],
    base_ns: int,
    positions: Sequence[Position] = (),
    theme: Theme = LIGHT,
) -> Figure:
    """Draw a scene: estimate, coils and states of both sides on one time axis.

    Checked by: tests/unit/sil/log_replay/test_page.py
    """
    from matplotlib.figure import Figure

    rows = scene.rows
    figure = Figure(figsize=(12.0, 6.6), facecolor=theme.paper)
    grid = figure.add_gridspec(
        3,
        1,
        height_ratios=[3.0, 2.2, 0.9],
        left=0.085,
        right=0.985,
        top=0.93,
        bottom=0.08,
        hspace=0.12,
    )
    times_ms = [(row.time_ns + base_ns) / NS_PER_MS for row in rows]
    period_ms = times_ms[1] - times_ms[0] if len(rows) > 1 else 10.0
    end_ms = times_ms[-1] + period_ms
    estimate = figure.add_subplot(grid[0])
    _estimates(estimate, rows, times_ms, labels, theme)
    near = [p for p in positions if rows[0].time_ns <= p.time_ns <= rows[-1].time_ns]
    _positions(estimate, near, base_ns, theme)
    coils = figure.add_subplot(grid[1], sharex=estimate)
    _coils(coils, rows, times_ms, end_ms, labels, theme)
    states = figure.add_subplot(grid[2], sharex=estimate)
    _states(states, rows, times_ms, end_ms, labels, theme)
    for axes in (estimate, coils, states):
        _style(axes, theme)
        axes.tick_params(labelbottom=axes is states, length=0)
    estimate.legend(loc="best", fontsize=8.5, frameon=False, labelcolor=theme.ink)
    estimate.set_xlim(times_ms[0], end_ms)
    states.set_xlabel("time of the log, ms", color=theme.ink, fontsize=9)
    title = "the commands differ" if scene.differs else "the commands are equal"
    figure.text(0.085, 0.955, title, fontsize=12, weight="bold", color=theme.ink)
    return figure


def draw_positions(positions: Sequence[Position], base_ns: int, theme: Theme = LIGHT) -> Figure:
    """Draw recorded and replayed stay position, and their difference."""
    from matplotlib.figure import Figure

    both = [p for p in positions if p.recorded_m == p.recorded_m]
    figure = Figure(figsize=(12.0, 4.6), facecolor=theme.paper)
    grid = figure.add_gridspec(
        2, 1, height_ratios=[3.0, 1.2], left=0.085, right=0.985, top=0.95, bottom=0.11, hspace=0.12
    )
    times_ms = [(p.time_ns + base_ns) / NS_PER_MS for p in both]
    upper = figure.add_subplot(grid[0])
    upper.plot(
        times_ms, [p.recorded_m * MM for p in both], color=theme.truth, lw=2.4, label="recorded"
    )
    upper.plot(
        times_ms,
        [p.replayed_m * MM for p in both],
        color=theme.alarm,
        lw=1.2,
        label="plant replayed",
    )
    upper.set_ylabel("position, mm", color=theme.ink, fontsize=9)
    upper.legend(loc="best", fontsize=8.5, frameon=False, labelcolor=theme.ink)
    lower = figure.add_subplot(grid[1], sharex=upper)
    lower.plot(
        times_ms, [(p.replayed_m - p.recorded_m) * MM for p in both], color=theme.alarm, lw=1.0
    )
    lower.set_ylabel("apart, mm", color=theme.ink, fontsize=9)
    lower.set_xlabel("time of the log, ms", color=theme.ink, fontsize=9)
    for axes in (upper, lower):
        _style(axes, theme)
        axes.tick_params(labelbottom=axes is lower, length=0)
    return figure


def _style(axes: Axes, theme: Theme) -> None:
    axes.set_facecolor(theme.paper)
    axes.grid(True, axis="x", color=theme.grid, linewidth=0.6)
    axes.set_axisbelow(True)
    axes.tick_params(colors=theme.ink, labelsize=8.5)
    for side, spine in axes.spines.items():
        spine.set_visible(side in ("left", "bottom"))
        spine.set_color(theme.grid)


def _estimates(
    axes: Axes,
    rows: Sequence[Row],
    times_ms: Sequence[float],
    labels: tuple[str, str],
    theme: Theme,
) -> None:
    for side, color, width in ((0, theme.believed, 2.6), (1, theme.alarm, 1.2)):
        known = [
            (t, e * MM)
            for t, row in zip(times_ms, rows, strict=True)
            if (e := row.estimates_m[side]) is not None
        ]
        if known:
            axes.step(
                [t for t, _ in known],
                [e for _, e in known],
                where="post",
                color=color,
                linewidth=width,
                label=f"position believed, {labels[side]}",
            )
    axes.set_ylabel("position, mm", color=theme.ink, fontsize=9)


def _positions(axes: Axes, near: Sequence[Position], base_ns: int, theme: Theme) -> None:
    for name, style, values in (
        ("true position recorded", "-", [(p.time_ns, p.recorded_m) for p in near]),
        ("plant replayed", ":", [(p.time_ns, p.replayed_m) for p in near]),
    ):
        known = [(t, v) for t, v in values if v == v]
        if known:
            axes.plot(
                [(t + base_ns) / NS_PER_MS for t, _ in known],
                [v * MM for _, v in known],
                style,
                color=theme.truth,
                linewidth=1.2,
                label=name,
            )


def _coils(
    axes: Axes,
    rows: Sequence[Row],
    times_ms: Sequence[float],
    end_ms: float,
    labels: tuple[str, str],
    theme: Theme,
) -> None:
    ticks, names = [], []
    for lane, chamber in enumerate(reversed(CHAMBERS)):
        index = CHAMBERS.index(chamber)
        for side, offset in ((1, 0.08), (0, 0.52)):
            on = [row.coils[side][index] for row in rows]
            spans = spans_of(times_ms, on, end_ms)
            axes.broken_barh(
                spans,
                (lane + offset, 0.36),
                facecolors=theme.chamber[chamber],
                alpha=1.0 if side else 0.45,
                linewidth=0,
            )
            ticks.append(lane + offset + 0.18)
            names.append(f"{chamber} {labels[side]}")
        axes.axhline(lane, color=theme.grid, linewidth=0.8)
    axes.set_yticks(ticks, names)
    axes.set_ylim(-0.02, 3.0)


def spans_of(
    times_ms: Sequence[float], on: Sequence[bool], end_ms: float
) -> list[tuple[float, float]]:
    """Return (start, length) of each time in which a held switch is on."""
    spans: list[tuple[float, float]] = []
    begun: float | None = None
    for at, is_on in zip([*times_ms, end_ms], [*on, False], strict=True):
        if is_on and begun is None:
            begun = at
        elif not is_on and begun is not None:
            spans.append((begun, at - begun))
            begun = None
    return spans


def _states(
    axes: Axes,
    rows: Sequence[Row],
    times_ms: Sequence[float],
    end_ms: float,
    labels: tuple[str, str],
    theme: Theme,
) -> None:
    span_ms = end_ms - times_ms[0]
    for side, base in ((0, 1.0), (1, 0.0)):
        names = [row.states[side] for row in rows]
        for name in dict.fromkeys(names):
            spans = spans_of(times_ms, [n == name for n in names], end_ms)
            axes.broken_barh(
                spans,
                (base + 0.08, 0.84),
                facecolors=theme.state.get(name, theme.grid),
                linewidth=0,
            )
            for start, length in spans:
                if length > 0.055 * span_ms:
                    axes.text(
                        start + 0.5 * length,
                        base + 0.5,
                        name,
                        ha="center",
                        va="center",
                        fontsize=8,
                        color=theme.ink,
                        clip_on=True,
                    )
    axes.set_yticks([1.5, 0.5], [f"state {label}" for label in labels])
    axes.set_ylim(-0.02, 2.0)

"""The lower panels: states of the firmware, and every frame on the bus."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from can_dbc.messages import ControllerStatus
from sil.recording.run_record import NS, Floats
from sil.report.drawing import MS, Drawing, Window, outline

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def draw_states(drawing: Drawing, axes: Axes, window: Window, is_first: bool) -> None:
    """Draw what the firmware said it was doing, and where it said nothing."""
    theme, record = drawing.theme, drawing.record
    times, states = record.series(ControllerStatus, "state")
    axes.set_yticks([0.5], ["firmware state"])
    axes.set_ylim(0.0, 1.0)
    axes.grid(False)
    end = float(record.truth["time_s"][-1])
    span = window.end_s - window.start_s
    for since, until, name in state_spans(times, [state.name for state in states], end):
        color = theme.state.get(name, theme.paper)
        axes.axvspan(
            since * MS,
            until * MS,
            facecolor=color,
            edgecolor=theme.faint,
            linewidth=0,
            hatch=None if name in theme.state else "////",
        )
        left, right = max(since, window.start_s), min(until, window.end_s)
        for size in (8.5, 6.5):
            if right - left > 0.00135 * size * len(name) * span:
                axes.text(
                    0.5 * (left + right) * MS,
                    0.46,
                    name.lower(),
                    ha="center",
                    va="center",
                    fontsize=size,
                    color=theme.ink,
                    path_effects=outline(theme) if name not in theme.state else [],
                )
                break


SILENT = "SILENT"


def state_spans(times: Floats, names: Sequence[str], end: float) -> list[tuple[float, float, str]]:
    """Return (start, end, state) of each state reported, SILENT where three are missing."""
    if len(times) == 0:
        return [(0.0, end, SILENT)]
    step = float(np.median(np.diff(times))) if len(times) > 1 else end
    spans: list[tuple[float, float, str]] = []
    for i, name in enumerate(names):
        since = float(times[i])
        until = float(times[i + 1]) if i + 1 < len(times) else end
        heard = until if until - since < 3.5 * step else since + step
        if spans and spans[-1][2] == name and spans[-1][1] == since:
            spans[-1] = (spans[-1][0], heard, name)
        else:
            spans.append((since, heard, name))
        if heard < until:
            spans.append((heard, until, SILENT))
    return spans


def draw_bus(drawing: Drawing, axes: Axes, window: Window, is_first: bool) -> None:
    """One lane per message, lowest identifier (highest priority) on top: queued to arrived."""
    theme, record = drawing.theme, drawing.record
    lanes = sorted(
        ((entries[0][0].frame.can_id, kind, entries) for kind, entries in record.messages.items()),
        key=lambda lane: -lane[0],
    )
    sender_color = {"controller": theme.believed, "plant": theme.truth}
    names = []
    for lane, (_, kind, entries) in enumerate(lanes):
        names.append(kind.__name__)
        seen = [
            (e.released_ns / NS * MS, e.arrival_ns / NS * MS)
            for e, _ in entries
            if window.start_s - 0.01 <= e.arrival_ns / NS <= window.end_s + 0.01
        ]
        if not seen:
            continue
        color = sender_color.get(entries[0][0].sender, theme.chamber["B"])
        axes.broken_barh(
            [(a, max(b - a, 0.1)) for a, b in seen],
            (lane - 0.32, 0.64),
            facecolors=color,
            edgecolors=color,
            linewidth=0.7,
        )
    axes.set_yticks(range(len(names)), names)
    axes.tick_params(axis="y", labelsize=7.5)
    axes.set_ylim(-0.7, len(names) - 0.3)
    if is_first:
        handles = [
            ("driver", theme.chamber["B"]),
            ("controller", theme.believed),
            ("plant", theme.truth),
        ]
        for i, (name, color) in enumerate(handles):
            axes.annotate(
                f"■ {name}",
                (0.004 + 0.0, 1.0),
                xycoords="axes fraction",
                xytext=(62 * i, 2),
                textcoords="offset points",
                fontsize=7.5,
                color=color,
            )
